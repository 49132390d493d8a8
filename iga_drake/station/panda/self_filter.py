"""The Panda's self-filter."""

import numpy as np
from pydrake.planning import RobotDiagramBuilder

from iga_drake.demonstrations.demonstration import HAND_OPENING_MAX
from iga_drake.station.panda.model import add_panda
from iga_drake.systems.self_filter import SelfFilter


def make_panda_self_filter() -> SelfFilter:
    """The self-filter of arm and hand, from the URDF's collision shapes; its world is W."""
    builder = RobotDiagramBuilder(time_step=0.0)
    panda = add_panda(builder.plant(), visuals="none")
    builder.plant().Finalize()

    def positions(position: np.ndarray, opening: float) -> np.ndarray:
        finger = float(np.clip(opening, 0.0, HAND_OPENING_MAX)) / 2  # measured: slightly outside
        return np.array([*position, finger, finger])

    return SelfFilter(
        builder.Build(), instances=[panda.instance], frame_E=panda.frame_E, positions=positions
    )
