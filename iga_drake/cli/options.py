"""Options that several commands share."""

import argparse
import math
from collections.abc import Collection
from functools import partial
from typing import Any

import yaml

from iga_drake.cli.status import CommandError
from iga_drake.files import output_file


def seed(text: str) -> int:
    """A seed, as argparse takes it: NumPy knows none below 0."""
    number = int(text)
    if not 0 <= number < 2**31:
        raise argparse.ArgumentTypeError(f"{number} found, an integer from 0 to 2^31 - 1 expected")
    return number


def add_result_argument(parser: argparse.ArgumentParser) -> None:
    """Adds `--result`, a file for the result of one episode."""
    parser.add_argument(
        "--result", type=partial(output_file, begins=(b'{"task"',)), metavar="JSON",
        help="write the result as JSON",
    )  # fmt: skip


def seconds(text: str) -> float:
    """A finite number from 0 on, as argparse takes it."""
    number = float(text)
    if not 0.0 <= number < math.inf:
        raise argparse.ArgumentTypeError(f"{text} found, a number from 0 on expected")
    return number


def names(text: str) -> list[str]:
    """Names between commas, as argparse takes them."""
    return [name.strip() for name in text.split(",") if name.strip()]


def add_aligner_options(parser: argparse.ArgumentParser) -> None:
    """Adds `--option`, which `aligner_options` reads."""
    parser.add_argument(
        "--option", dest="aligner_options", action="append", default=[],
        metavar="[ALIGNER.]NAME=VALUE",
        help="option of an aligner, e.g. icp.starts=8, or of every one; may be repeated",
    )  # fmt: skip


def aligner_options(
    arguments: argparse.Namespace, aligners: Collection[str]
) -> dict[str, dict[str, Any]]:
    """Aligner -> the options given for it; values are read as YAML (numbers, true, null, text).

    Options of one aligner go before those of every one. Raises `CommandError` for an option of an
    aligner that isn't among `aligners`.
    """
    common: dict[str, Any] = {}
    own: dict[str, dict[str, Any]] = {name: {} for name in aligners}
    for given in arguments.aligner_options:
        key, separator, text = given.partition("=")
        aligner, dot, name = key.rpartition(".")
        if not separator or not name.isidentifier() or (dot and not aligner):
            raise CommandError(f"--option {given}: [ALIGNER.]NAME=VALUE is expected")
        if aligner and aligner not in own:
            raise CommandError(
                f"--option {given}: '{aligner}' is not among the aligners asked for: "
                f"{', '.join(aligners)}"
            )
        try:
            value = yaml.safe_load(text) if text else ""
        except yaml.YAMLError:
            value = text
        (own[aligner] if aligner else common)[name] = value
    return {name: common | options for name, options in own.items()}
