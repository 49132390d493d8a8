"""Joins an arm in a diagram and servers of the robot's own protocol in another process."""

from multiprocessing.context import BaseContext
from typing import Any

import numpy as np
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiscreteValues,
    EventStatus,
    LeafSystem,
)

from iga_drake.station.panda.fci import FciState
from iga_drake.systems.ports import PANDA_JOINTS

_NONE = float("nan")


class SharedFciPlant:
    """An `FciPlant` in memory that two processes share: one simulates it, the other one serves it.
    Pass it to both when they are started."""

    def __init__(self, context: BaseContext, *, position: np.ndarray, opening: float) -> None:
        """`position` (7,) (rad) at the start; `opening` (m): what the hand is told before the first
        command."""
        nothing = [0.0] * PANDA_JOINTS
        # Joint angles, velocities, torques (7 each) and opening; commanded angles and opening.
        self._measured: Any = context.Array("d", [*position, *nothing, *nothing, opening])
        self._commanded: Any = context.Array("d", [_NONE] * PANDA_JOINTS + [opening])

    def measure(
        self, position: np.ndarray, velocity: np.ndarray, torque: np.ndarray, opening: float
    ) -> None:
        """Tells what is measured now: (7,) each, rad, rad/s, N m with the robot's sign; m."""
        self._measured[:] = [*position, *velocity, *torque, opening]

    def commanded(self) -> tuple[np.ndarray, float]:
        """What is commanded now: joint angles (7,) (rad; NaN before the first command), opening."""
        values = np.array(self._commanded[:])
        return values[:PANDA_JOINTS], float(values[PANDA_JOINTS])

    def read(self) -> FciState:
        """See `FciPlant`."""
        values = np.array(self._measured[:])
        position, opening = self.commanded()
        return FciState(
            position=values[:7],
            velocity=values[7:14],
            torque_external=values[14:21],
            opening=float(values[21]),
            position_commanded=position if np.isfinite(position).all() else None,
            opening_commanded=opening,
        )

    def command(self, position: np.ndarray) -> None:
        """See `FciPlant`."""
        self._commanded[:PANDA_JOINTS] = [float(value) for value in position]

    def command_hand(self, opening: float) -> None:
        """See `FciPlant`."""
        self._commanded[PANDA_JOINTS] = opening


class FciPort(LeafSystem):
    """Passes what an `FciPlant`'s clients command on to an arm in this diagram, and what is
    measured back to them.

    .. pydrake_system::

        name: FciPort
        input_ports:
        - panda.position_measured
        - panda.velocity_measured
        - panda.torque_external
        - hand.opening_measured
        output_ports:
        - panda.position
        - hand.opening

    The ports are the port contract's, seen from the other side.
    """

    def __init__(self, plant: SharedFciPlant, *, period: float = 0.005) -> None:
        super().__init__()
        self.set_name("FciPort")
        self._plant = plant
        self._inputs = [
            self.DeclareVectorInputPort(f"panda.{name}", PANDA_JOINTS)
            for name in ("position_measured", "velocity_measured", "torque_external")
        ]
        self._inputs.append(self.DeclareVectorInputPort("hand.opening_measured", 1))
        self._state = self.DeclareDiscreteState(np.full(PANDA_JOINTS + 1, np.nan))
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)
        self.DeclarePeriodicPublishEvent(period, 0.0, self._measure)
        for name, size, rows in (
            ("panda.position", PANDA_JOINTS, slice(0, PANDA_JOINTS)),
            ("hand.opening", 1, slice(PANDA_JOINTS, None)),
        ):
            measured = self._inputs[0 if size > 1 else 3]

            def calc(
                context: Context, output: BasicVector, rows: slice = rows, measured: Any = measured
            ) -> None:
                values = context.get_discrete_state_vector().value()[rows]
                known = np.isfinite(values).all()
                output.SetFromVector(values if known else measured.Eval(context))

            tickets = {self.discrete_state_ticket(self._state), measured.ticket()}
            self.DeclareVectorOutputPort(name, size, calc, tickets)

    def _update(self, context: Context, values: DiscreteValues) -> EventStatus:
        position, opening = self._plant.commanded()
        if not np.isfinite(position).all():  # the arm stays where it was first
            before = context.get_discrete_state_vector().value()[:PANDA_JOINTS]
            known = np.isfinite(before).all()
            position = before if known else self._inputs[0].Eval(context)
        values.set_value(self._state, [*position, opening])
        return EventStatus.Succeeded()

    def _measure(self, context: Context) -> EventStatus:
        position, velocity, torque, opening = (port.Eval(context) for port in self._inputs)
        self._plant.measure(position, velocity, -torque, float(opening[0]))
        return EventStatus.Succeeded()
