"""Exit statuses of `iga`, and the error of a command that was asked for what it can't do."""

from iga_drake.errors import IgaDrakeError

# INTERNAL is a bug: the exception and its traceback are printed.
SUCCESS, FAILURE, BAD_INPUT, INTERNAL = 0, 1, 2, 3


class CommandError(IgaDrakeError):
    """A command was asked for something that it can't do."""
