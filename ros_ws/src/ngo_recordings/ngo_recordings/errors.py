"""What goes wrong with a recording."""


class RecordingError(ValueError):
    """A recording cannot be read or used: one line that says what was found, where, and what to do about it."""
