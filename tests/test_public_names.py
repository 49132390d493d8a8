"""Every public name of the package stands for one thing."""

import ast
from collections import defaultdict
from pathlib import Path

import iga_drake

# Functions that several modules have by agreement, always called through their module.
CONVENTIONS = {
    "add_arguments", "run", "main",  # of a command
    "sample_parameters", "profile", "draft", "build",  # of a task's own shape family
}  # fmt: skip


def _definitions() -> dict[str, list[str]]:
    """Public top-level class or function name -> the modules' files that define it."""
    folder = Path(iga_drake.__file__).parent
    found = defaultdict(list)
    for path in sorted(folder.rglob("*.py")):
        # A name that is defined twice in one file (an overload, say) counts once.
        names = {
            node.name
            for node in ast.parse(path.read_text(encoding="utf-8")).body
            if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
        }
        for name in names:
            if not name.startswith("_"):
                found[name].append(path.relative_to(folder).as_posix())
    return found


def test_a_public_name_is_defined_once() -> None:
    twice = {name: files for name, files in _definitions().items() if len(files) > 1}
    assert not {name: files for name, files in twice.items() if name not in CONVENTIONS}
    assert set(twice) == CONVENTIONS  # none is listed in vain
