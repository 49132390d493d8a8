"""IGA-Drake: few-shot manipulation of unseen objects as a Drake system.

What a notebook needs stands here; each name is loaded when it is first used.
"""

import importlib
from typing import TYPE_CHECKING, Any

from iga_drake.version import __version__

if TYPE_CHECKING:
    from iga_drake.aligners.registry import make_aligner as make_aligner
    from iga_drake.demonstrations.store import read_demonstrations as read_demonstrations
    from iga_drake.policy.iga_policy import IgaPolicy as IgaPolicy
    from iga_drake.station.scenario import load_scenario as load_scenario
    from iga_drake.tasks.episode import Episode as Episode
    from iga_drake.tasks.registry import make_task as make_task

_HOMES = {
    "Episode": "iga_drake.tasks.episode",
    "IgaPolicy": "iga_drake.policy.iga_policy",
    "load_scenario": "iga_drake.station.scenario",
    "make_aligner": "iga_drake.aligners.registry",
    "make_task": "iga_drake.tasks.registry",
    "read_demonstrations": "iga_drake.demonstrations.store",
}
__all__ = ["__version__", *_HOMES]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'iga_drake' has no attribute '{name}'")
    return getattr(importlib.import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
