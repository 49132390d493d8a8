"""The Panda's published meshes, converted once so that Drake can draw them.

They are looked at, and nothing else: no mass, contact or cloud depends on them.
"""

from pathlib import Path

_LINKS = (
    *(f"panda_link{i}" for i in range(8)),
    "panda_hand",
    "panda_leftfinger",
    "panda_rightfinger",
)


def mesh_visuals() -> dict[str, Path]:
    """Link name -> mesh file that Drake can draw; empty where the packages are missing."""
    return {}
