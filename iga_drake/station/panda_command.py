"""From the port contract's commands to the desired state of the Panda's actuators."""

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from iga_drake.station.ports import HAND_OPENING_MAX, PANDA_JOINTS

_ACTUATORS = PANDA_JOINTS + 2


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
      `time_constant`, with the velocity that belongs to it; the opening changes by at most
      `opening_speed`. While no command has been seen, it is the command itself at rest.
    - `hand.opening_commanded` (1, m): the opening that the fingers are told now.

    The fingers go on pressing against an object because their desired position moves on past it,
    up to their effort limit.
    """

    def __init__(
        self,
        *,
        time_step: float = 0.002,
        time_constant: float = 0.01,
        opening_speed: float = 0.1,
    ) -> None:
        """`time_step` (s) of the plant, `time_constant` (s), `opening_speed` (m/s)."""
        super().__init__()
        self.set_name("PandaCommand")
        self._time_step = time_step
        self._gain = 1.0 - np.exp(-time_step / time_constant)
        self._opening_step = opening_speed * time_step
        self._position_input = self.DeclareVectorInputPort("panda.position", PANDA_JOINTS)
        self._opening_input = self.DeclareVectorInputPort("hand.opening", 1)
        # Angles, angular velocities, opening, opening velocity; NaN until the first command.
        self._state = self.DeclareDiscreteState(np.full(2 * PANDA_JOINTS + 2, np.nan))
        self.DeclarePeriodicDiscreteUpdateEvent(time_step, 0.0, self._update)
        self.DeclareVectorOutputPort("desired_state", 2 * _ACTUATORS, self._calc_desired_state)
        self.DeclareVectorOutputPort("hand.opening_commanded", 1, self._calc_opening)

    def _read(self, context: Context) -> np.ndarray:
        """The state, or the commands at rest where there is no state yet."""
        state = context.get_discrete_state(self._state).value()
        if np.isfinite(state).all():
            return state.copy()
        return np.concatenate(
            [
                self._position_input.Eval(context),
                np.zeros(PANDA_JOINTS),
                np.clip(self._opening_input.Eval(context), 0.0, HAND_OPENING_MAX),
                np.zeros(1),
            ]
        )

    def _update(self, context: Context, values) -> None:
        state = self._read(context)
        position, opening = state[:PANDA_JOINTS], state[-2]
        change = self._gain * (self._position_input.Eval(context) - position)
        wanted = np.clip(self._opening_input.Eval(context)[0], 0.0, HAND_OPENING_MAX)
        step = np.clip(wanted - opening, -self._opening_step, self._opening_step)
        values.set_value(
            self._state,
            np.concatenate(
                [
                    position + change,
                    change / self._time_step,
                    [opening + step, step / self._time_step],
                ]
            ),
        )

    def _calc_desired_state(self, context: Context, output: BasicVector) -> None:
        state = self._read(context)
        half, half_rate = state[-2] / 2, state[-1] / 2
        output.SetFromVector(
            np.concatenate(
                [
                    state[:PANDA_JOINTS],
                    [half, half],
                    state[PANDA_JOINTS : 2 * PANDA_JOINTS],
                    [half_rate, half_rate],
                ]
            )
        )

    def _calc_opening(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector([self._read(context)[-2]])
