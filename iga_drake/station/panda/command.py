"""From the port contract's commands to the desired state of the Panda's actuators."""

import math
from dataclasses import dataclass

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from iga_drake.demonstrations.demonstration import HAND_OPENING_MAX
from iga_drake.errors import check_bounds, check_range
from iga_drake.systems.ports import PANDA_JOINTS

_ACTUATORS = PANDA_JOINTS + 2


@dataclass
class Panda:
    """The robot in simulation."""

    # Visual geometry: "primitives" (simple shapes), "meshes" (the published meshes, needs the extra
    # `visuals`), or "auto": primitives for the cameras, so that perception is the same on every
    # machine, and meshes for viewers where they can be had. Collisions are the same in all.
    visuals: str = "auto"
    # Time constant (s) with which a joint follows its command, and speed (m/s) of the opening.
    time_constant: float = 0.01
    opening_speed: float = 0.1

    def check(self, where: str) -> None:
        """Raises `ConfigError` for a value out of range."""
        looks = ("auto", "meshes", "primitives")
        check_range(self.visuals in looks, f"{where}.visuals", self.visuals, ", ".join(looks))
        check_bounds(self, where, {"time_constant": (1e-4, 10.0), "opening_speed": (1e-3, 1.0)})


class PandaCommand(LeafSystem):
    """Smooths position commands and gives each finger half of the opening.

    .. pydrake_system::

        name: PandaCommand
        input_ports:
        - panda.position
        - hand.opening
        output_ports:
        - desired_state
        - hand.opening_commanded

    - `panda.position` (7, rad), `hand.opening` (1, m): the contract's commands. The opening is
      clipped to what the hand can do.
    - `desired_state` (18): positions, then velocities of the nine actuators, for the plant's
      `get_desired_state_input_port`. A joint follows its command as a first-order lag of
      `Panda.time_constant`, with the velocity that belongs to it; the opening changes by at most
      `Panda.opening_speed`. While no command has been seen, it is the command itself at rest.
    - `hand.opening_commanded` (1, m): the opening that the fingers are told now.

    The fingers go on pressing against an object because their desired position moves on past it,
    up to their effort limit.
    """

    def __init__(
        self,
        panda: Panda | None = None,
        *,
        time_step: float,
    ) -> None:
        """`time_step` (s) is the plant's. Raises `ConfigError`."""
        super().__init__()
        panda = panda or Panda()
        panda.check("Panda")
        self.set_name("PandaCommand")
        self._time_step = time_step
        self._gain = 1.0 - np.exp(-time_step / panda.time_constant)
        self._opening_step = panda.opening_speed * time_step
        self._position_input = self.DeclareVectorInputPort("panda.position", PANDA_JOINTS)
        self._opening_input = self.DeclareVectorInputPort("hand.opening", 1)
        # The desired state; NaN until the first command.
        self._state = self.DeclareDiscreteState(np.full(2 * _ACTUATORS, np.nan))
        self.DeclarePeriodicDiscreteUpdateEvent(time_step, 0.0, self._update)
        self.DeclareVectorOutputPort("desired_state", 2 * _ACTUATORS, self._calc_desired_state)
        self.DeclareVectorOutputPort("hand.opening_commanded", 1, self._calc_opening)

    def _read(self, context: Context) -> np.ndarray:
        """The state, or the commands at rest where there is no state yet; not to be written to."""
        state = context.get_discrete_state_vector().value()
        if math.isfinite(state.sum()):
            return state
        state = np.zeros(2 * _ACTUATORS)
        state[:PANDA_JOINTS] = self._position_input.Eval(context)
        state[PANDA_JOINTS:_ACTUATORS] = self._read_opening(context) / 2
        return state

    def _read_opening(self, context: Context) -> float:
        """The opening commanded (m), as far as the hand can do it."""
        return min(max(float(self._opening_input.Eval(context)[0]), 0.0), HAND_OPENING_MAX)

    def _update(self, context: Context, values) -> None:
        # Runs at every step of the plant: plain floats and slices, which are quicker than arrays.
        state = self._read(context)
        new = np.empty(2 * _ACTUATORS)
        position = state[:PANDA_JOINTS]
        change = self._gain * (self._position_input.Eval(context) - position)
        new[:PANDA_JOINTS] = position + change
        new[_ACTUATORS:-2] = change / self._time_step
        opening = 2.0 * float(state[PANDA_JOINTS])
        step = self._read_opening(context) - opening
        step = min(max(step, -self._opening_step), self._opening_step)
        new[PANDA_JOINTS:_ACTUATORS] = (opening + step) / 2
        new[-2:] = step / self._time_step / 2
        values.set_value(self._state, new)

    def _calc_desired_state(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._read(context))

    def _calc_opening(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector([2.0 * self._read(context)[PANDA_JOINTS]])
