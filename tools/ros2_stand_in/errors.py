"""The one exception that becomes a line for the user instead of a traceback."""


class CommandError(Exception):
    """What the command cannot do, as one line; the command ends with exit code 1."""
