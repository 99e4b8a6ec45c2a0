"""The one exception that becomes a line for the user instead of a traceback."""


class CommandError(Exception):
    """An error with one line for the user; the command ends with exit code 1."""
