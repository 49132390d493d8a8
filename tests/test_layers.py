"""The order of the package: imports point only towards the data's source."""

import ast
import subprocess
import sys
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import iga_drake

PACKAGE = Path(iga_drake.__file__).parent

# The packages in order of the data's way: each may import from itself and from those before it.
ORDER = (
    "geometry", "shapes", "dataset", "demonstrations", "aligners", "training", "planning",
    "systems", "policy", "viewing", "station", "drivers", "tasks", "evaluation", "studies", "cli",
)  # fmt: skip
# Usable by every package.
ROOT_MODULES = {
    f"iga_drake.{name}"
    for name in (
        "checkpoint", "cluster", "errors", "files", "paths", "precision", "progress", "registry",
        "version",
    )
}  # fmt: skip
WITHOUT_DRAKE = ORDER[: ORDER.index("planning")]


def imported_modules(path: Path) -> set[str]:
    """Every module of this package that `path` imports, lazily or not."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative imports hide the layers"
            assert node.module
            candidates = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= {name for name in candidates if is_module(name)} or {node.module}
    return {name for name in found if name.split(".")[0] == "iga_drake"}


def is_module(name: str) -> bool:
    path = PACKAGE.parent.joinpath(*name.split("."))
    return path.with_suffix(".py").is_file() or (path / "__init__.py").is_file()


@pytest.mark.parametrize("package", ORDER)
def test_imports_point_upwards(package: str):
    allowed = set(ORDER[: ORDER.index(package) + 1])
    wrong = []
    for path in sorted((PACKAGE / package).rglob("*.py")):
        for module in imported_modules(path):
            if module not in ROOT_MODULES | {"iga_drake"} and module.split(".")[1] not in allowed:
                wrong.append(f"{path.relative_to(PACKAGE)} imports {module}")
    assert not wrong


def test_every_package_is_in_the_order():
    assert {path.parent.name for path in PACKAGE.glob("*/__init__.py")} == set(ORDER)


def test_no_modules_import_each_other_in_a_circle():
    """Lazy imports count as well."""
    graph = {}
    for path in PACKAGE.rglob("*.py"):
        parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
        name = ".".join(parts).removesuffix(".__init__")
        graph[name] = imported_modules(path) - {name, "iga_drake"}
    try:
        tuple(TopologicalSorter(graph).static_order())
    except CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))


def test_learning_needs_neither_drake_nor_open3d():
    """Imports every module of these packages in a fresh interpreter."""
    modules = [
        ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__")
        for package in WITHOUT_DRAKE
        for path in sorted((PACKAGE / package).rglob("*.py"))
        if path.name != "__main__.py"
    ]
    code = (
        "import importlib, sys\n"
        f"for module in {modules!r}:\n"
        "    importlib.import_module(module)\n"
        "    heavy = {name.split('.')[0] for name in sys.modules} & {'pydrake', 'open3d'}\n"
        "    assert not heavy, (module, heavy)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
