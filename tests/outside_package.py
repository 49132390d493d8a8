"""A package outside this one, as another project would install it: code and entry points."""

import sys
from pathlib import Path


def install(folder: Path, code: str, entry_points: dict[str, dict[str, str]]) -> str:
    """Writes the module `outside_NAME` and its distribution's entry points to `folder`.

    Args:
      folder: has to come on the import path, and its name makes the module's.
      code: of the module.
      entry_points: group -> name -> object in the module.

    Returns the module's name.
    """
    module = f"outside_{folder.name.replace('-', '_')}"
    sys.modules.pop(module, None)
    (folder / f"{module}.py").write_text(code, encoding="utf-8")
    described = folder / f"{module}-1.0.dist-info"
    described.mkdir()
    (described / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {module}\nVersion: 1.0\n")
    lines = []
    for group, objects in entry_points.items():
        lines += [f"[{group}]", *(f"{name} = {module}:{o}" for name, o in objects.items())]
    (described / "entry_points.txt").write_text("\n".join(lines) + "\n")
    return module
