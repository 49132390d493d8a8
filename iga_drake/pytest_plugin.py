"""A plugin that pytest finds by itself where this package is installed: tests of task success.

    def test_our_cell_still_stacks(assert_success):
        assert_success("cell.yaml", seeds=range(15), at_least=0.9)

Nothing else of the package is imported before a test asks for it.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

_RATES: pytest.StashKey[list[str]] = pytest.StashKey()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Adds the options that all tests with `assert_success` share."""
    group = parser.getgroup("iga-drake", "episodes of assert_success")
    group.addoption(
        "--iga-processes", type=int, metavar="N",
        help="episodes at a time (default: one for each processor)",
    )  # fmt: skip
    group.addoption(
        "--iga-replays", type=Path, metavar="DIR",
        help="folder for replays of episodes that fail (default: each test's own temporary one)",
    )  # fmt: skip


@pytest.fixture(name="assert_success")
def success_fixture(
    request: pytest.FixtureRequest, record_property: Callable[[str, object], None]
) -> Callable[..., Any]:
    """`iga_drake.testing.assert_success`, with pytest's options for processes and replays; failures
    leave a replay each. The rate goes into the terminal's summary and into pytest's own XML."""
    from iga_drake.evaluation.task_success import summarise_trials
    from iga_drake.testing import assert_success

    lines = request.config.stash.setdefault(_RATES, [])

    def checked(scenario: str | Path, **settings: Any) -> Any:
        settings.setdefault("processes", request.config.getoption("--iga-processes"))
        if "replays" not in settings:
            folder = request.config.getoption("--iga-replays")
            settings["replays"] = folder or request.getfixturevalue("tmp_path") / "replays"

        def tell(results: Any) -> None:
            for row in summarise_trials(results):
                low, high = row["wilson_95"]
                text = (
                    f"{row['successes']} of {row['trials']} "
                    f"(95 % interval {100 * low:.0f} to {100 * high:.0f} %)"
                )
                name = f"{row['scenario']} {row['aligner']}"
                lines.append(f"{request.node.nodeid}: {name}: {text}")
                record_property(name, text)

        return assert_success(scenario, on_results=tell, **settings)

    return checked


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    """Prints the rates of all tests that used `assert_success`."""
    lines = config.stash.get(_RATES, [])
    if lines:
        terminalreporter.section("task success")
        for line in lines:
            terminalreporter.write_line(line)
