"""The parser of every command: its help states all defaults and is shown whole where what is needed
was not given."""

import argparse
import sys
from pathlib import Path
from typing import Any, NoReturn


class CommandParser(argparse.ArgumentParser):
    """An `ArgumentParser` that adds defaults to the help of options."""

    def format_help(self) -> str:
        """The help, in which every option that has a default says it."""
        for action in self._actions:
            text = _default_text(action)
            if text and "default" not in (action.help or ""):
                action.help = f"{action.help or ''} (default: {text})".strip()
        return super().format_help()

    def error(self, message: str) -> NoReturn:
        """Ends with status 2: the message, below the whole help where an argument is missing."""
        if message.startswith("the following arguments are required"):
            self.print_help(sys.stderr)
            self.exit(2, f"\n{self.prog}: {message}\n")
        super().error(message)


def _default_text(action: argparse.Action) -> str:
    """An option's default in the words that a user would type; empty where there is none."""
    value: Any = action.default
    if not action.option_strings or action.required or isinstance(value, bool):
        return ""
    if isinstance(value, (list, tuple)):
        return ",".join(map(str, value)).replace("%", "%%")
    if not isinstance(value, (str, int, float, Path)) or value in ("", argparse.SUPPRESS):
        return ""
    return str(value).replace("%", "%%")
