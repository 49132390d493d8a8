"""Exit statuses of `iga`, and the error of a command that was asked for what it can't do."""

from iga_drake.errors import IgaDrakeError

# INTERNAL is a bug: one line says what and where the traceback is. INTERRUPTED is the shells' own.
SUCCESS, FAILURE, BAD_INPUT, INTERNAL, INTERRUPTED = 0, 1, 2, 3, 130


class CommandError(IgaDrakeError):
    """A command was asked for something that it can't do."""
