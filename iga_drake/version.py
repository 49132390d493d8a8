"""The version of the code, as results and demonstrations record it."""

import functools
import hashlib
from pathlib import Path

__version__ = "0.2.0"


@functools.cache
def code_version() -> str:
    """The package's version and a digest of its sources, the same for the same code wherever it is
    installed: "0.2.0+3f2a9c01"."""
    package = Path(__file__).resolve().parent
    digest = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        digest.update(str(path.relative_to(package)).encode())
        digest.update(path.read_bytes())
    return f"{__version__}+{digest.hexdigest()[:8]}"
