"""The README and the pages of docs/: short, without dead links, with commands that exist."""

import re
from pathlib import Path

import numpy as np
import pytest

from iga_drake import cli
from iga_drake.aligners.protocol import Aligner
from iga_drake.demonstrations.alignment import Alignment
from iga_drake.station.scenario import load_scenario

ROOT = Path(__file__).resolve().parents[1]
README = ROOT / "README.md"
PAGES = [README, *sorted((ROOT / "docs").glob("*.md"))]
README_BYTES = 7000
# Verbs whose next word names what is done; the others take a scenario.
VERBS_OF_PARTS = {
    "benchmark",
    "calibrate",
    "dataset",
    "drive",
    "evaluate",
    "export",
    "shapes",
    "train",
    "view",
}
MACHINE_PATH = re.compile(
    r"(?<![\w.~])/(?:data|home|mnt|opt|private|root|scratch|srv|tmp|usr|Users|var|work)/"
)

each_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)


def blocks(page: Path, language: str) -> list[str]:
    """The fenced blocks of a language."""
    text = page.read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.DOTALL | re.MULTILINE)


def anchors(page: Path) -> set[str]:
    """The headings as a browser names them."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def commands(page: Path) -> set[tuple[str, str | None]]:
    """First two words of every `iga ...` in an indented line or in backticks."""
    text = page.read_text(encoding="utf-8")
    command = r"(?:^    iga|`iga|-m iga_drake\.cli) ([a-z][a-z-]*)(?: ([^\s`]+))?"
    found = re.findall(command, text, re.MULTILINE)
    return {(verb, word or None) for verb, words in found for word in re.split(r"\\?\|", words)}


def names_listed(capsys: pytest.CaptureFixture, *arguments: str) -> set[str]:
    """What `iga` lists when it is asked for something that there isn't."""
    try:
        assert cli.main([*arguments, "no-such-thing"]) == cli.BAD_INPUT
    except SystemExit as stop:
        assert stop.code == cli.BAD_INPUT
    return set(re.findall(r"[a-z][a-z-]*", capsys.readouterr().err))


def test_the_readme_is_short() -> None:
    assert README.stat().st_size <= README_BYTES


@each_page
def test_links_lead_somewhere(page: Path) -> None:
    for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
        if re.match(r"[a-z]+:", link):
            continue
        name, _, anchor = link.partition("#")
        target = (page.parent / name).resolve() if name else page
        assert target.is_file() and target.is_relative_to(ROOT), f"{page.name}: {link}"
        assert not anchor or anchor in anchors(target), f"{page.name}: {link}"


@each_page
def test_no_page_names_a_path_of_a_machine(page: Path) -> None:
    assert not MACHINE_PATH.findall(page.read_text(encoding="utf-8"))


def test_commands_exist(capsys: pytest.CaptureFixture) -> None:
    documented = {command for page in PAGES for command in commands(page)}
    verbs = {verb for verb, _ in documented}
    assert verbs >= VERBS_OF_PARTS | {"simulate", "demonstrate"}
    assert verbs <= names_listed(capsys)
    for verb in VERBS_OF_PARTS:
        words = {word for of, word in documented if of == verb and word}
        assert words <= names_listed(capsys, verb), verb


@each_page
def test_examples_are_valid(page: Path, tmp_path: Path) -> None:
    for code in blocks(page, "python"):
        compile(code, page.name, "exec")
    for index, text in enumerate(blocks(page, "yaml")):
        if "task:" in text:  # a scenario
            path = tmp_path / f"{index}.yaml"
            path.write_text(text, encoding="utf-8")
            assert load_scenario(path).task.name


def test_the_example_of_an_aligner_aligns() -> None:
    (code,) = blocks(ROOT / "docs" / "add_an_aligner.md", "python")
    names: dict = {}
    exec(code, names)
    aligner = names["CentroidAligner"]()
    assert isinstance(aligner, Aligner)
    rng = np.random.default_rng(0)
    grasped, target = rng.normal(size=(2, 20, 3))
    estimate = aligner.align((Alignment(grasped, target),), grasped - 0.3, target)
    np.testing.assert_allclose(estimate.poses[0][:3, 3], 0.3)
