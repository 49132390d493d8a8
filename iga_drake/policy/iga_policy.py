"""The policy as a system: from clouds and demonstrations to end-effector targets."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform
from pydrake.perception import PointCloud
from pydrake.systems.framework import Context, InputPort, LeafSystem, State

from iga_drake.demonstrations.demonstration import ObservedRole
from iga_drake.policy.machine import PolicyMachine, PolicyMemory
from iga_drake.policy.motion import MotionStep, Phase
from iga_drake.systems.fusion import CameraCounts
from iga_drake.systems.messages import FollowerStatus, SupervisorStatus
from iga_drake.systems.ports import PANDA_JOINTS


class IgaPolicy(LeafSystem):
    """Observes, infers where the grasped objects have to go, and moves them there.

    All work is done in a periodic unrestricted update that writes one abstract state; every output
    only reads that state. Cloud inputs are pulled in the observing phases alone.

    .. pydrake_system::

        name: IgaPolicy
        input_ports:
        - target_cloud
        - grasped_cloud
        - camera_counts (optional)
        - cloud_losses (optional)
        - pose_measured
        - panda.position_measured
        - follower.status
        - supervisor.status (optional)
        output_ports:
        - target
        - status
        - observations
        - estimates
        - chosen
        - energies
        - steps
        - next_look

    - `target_cloud`, `grasped_cloud` (PointCloud, m in W): what the cameras see of each role.
    - `camera_counts` (dict of camera name -> `CameraCounts`): a camera with a problem is waited
      for. `cloud_losses` (dict of role -> words): where the pixels of a cloud got lost.
    - `pose_measured` (RigidTransform): X_WE. `panda.position_measured` (7, rad).
    - `target` (EndEffectorTarget): of sequence 0 while the arm has not been asked to move.
    - `status` (PolicyStatus): phase, timeline, reason.
    - `observations` (dict of name -> `Observation`): the clouds observed so far.
    - `estimates` (tuple of `PoseEstimate`): of each waypoint inferred so far.
    - `chosen` (tuple of `ReachablePose`): the pose settled on for each waypoint inferred so far.
    - `energies` (T): energy of the pose chosen for each waypoint; NaN before there is one.
    - `steps` (tuple of `MotionStep`): what is left of the motion under way, the present step first;
      empty while nothing moves.
    - `next_look` (1, s): when the policy looks at the cameras next; infinity while it has not to.
    """

    def __init__(self, machine: PolicyMachine) -> None:
        super().__init__()
        self._machine = machine
        cloud = Value[PointCloud]()
        self._cloud_inputs: dict[ObservedRole, InputPort] = {
            "target": self.DeclareAbstractInputPort("target_cloud", cloud),
            "grasped": self.DeclareAbstractInputPort("grasped_cloud", cloud),
        }
        self._counts_input = self.DeclareAbstractInputPort("camera_counts", AbstractValue.Make({}))
        self._losses_input = self.DeclareAbstractInputPort("cloud_losses", AbstractValue.Make({}))
        self._pose_input = self.DeclareAbstractInputPort("pose_measured", Value[RigidTransform]())
        self._position_input = self.DeclareVectorInputPort("panda.position_measured", PANDA_JOINTS)
        self._follower_input = self.DeclareAbstractInputPort(
            "follower.status", AbstractValue.Make(FollowerStatus())
        )
        self._supervisor_input = self.DeclareAbstractInputPort(
            "supervisor.status", AbstractValue.Make(SupervisorStatus())
        )
        start = machine.start()
        self._memory_index = self.DeclareAbstractState(AbstractValue.Make(start))
        state = {self.abstract_state_ticket(self._memory_index)}

        def declare(name: str, example: Any, read: Any) -> None:
            def calc(context: Context, output: AbstractValue) -> None:
                output.set_value(read(self.memory(context)))

            self.DeclareAbstractOutputPort(
                name, lambda: AbstractValue.Make(example), calc, prerequisites_of_calc=state
            )

        declare("target", start.target, lambda memory: memory.target)
        declare("status", start.status, lambda memory: memory.status)
        declare("observations", {}, lambda memory: dict(memory.observations))
        declare("estimates", (), lambda memory: memory.estimates)
        declare("chosen", (), lambda memory: memory.chosen)
        self.DeclareVectorOutputPort(
            "energies",
            len(machine.motion.waypoints),
            self._calc_energies,
            prerequisites_of_calc=state,
        )
        declare("steps", (), _steps_left)
        self.DeclareVectorOutputPort(
            "next_look", 1, self._calc_next_look, prerequisites_of_calc=state
        )
        self.DeclarePeriodicUnrestrictedUpdateEvent(machine.config.period, 0.0, self._update)

    def memory(self, context: Context) -> PolicyMemory:
        """The policy's whole state, read from its own `context`."""
        abstract: Any = context.get_abstract_state(int(self._memory_index))
        return abstract.get_value()

    def _calc_energies(self, context: Context, output: Any) -> None:
        energies = np.full(len(self._machine.motion.waypoints), np.nan)
        for index, chosen in enumerate(self.memory(context).chosen):
            energies[index] = chosen.energy
        output.SetFromVector(energies)

    def _calc_next_look(self, context: Context, output: Any) -> None:
        memory = self.memory(context)
        looks = memory.status.phase is Phase.OBSERVE
        output.SetFromVector([memory.observe_next if looks else np.inf])

    def _update(self, context: Context, state: State) -> None:
        memory = self._machine.advance(
            self.memory(context), _Pull(self, context), context.get_time()
        )
        state.get_mutable_abstract_state(int(self._memory_index)).set_value(memory)


def _steps_left(memory: PolicyMemory) -> tuple[MotionStep, ...]:
    moves = memory.status.phase in (Phase.PRESENT, Phase.MOVE)
    return memory.steps[memory.step :] if moves else ()


class _Pull:
    """`PolicyInputs` read from the ports of one context, copied: Drake reuses its cache."""

    def __init__(self, policy: IgaPolicy, context: Context) -> None:
        self._policy = policy
        self._context = context

    def _read(self, port: InputPort) -> Any:
        return port.Eval(self._context)

    def cloud(self, role: ObservedRole) -> np.ndarray:
        return self._read(self._policy._cloud_inputs[role]).xyzs().T.copy()

    def cameras(self) -> Mapping[str, CameraCounts]:
        port = self._policy._counts_input
        return self._read(port) if port.HasValue(self._context) else {}

    def losses(self, role: ObservedRole) -> str:
        port = self._policy._losses_input
        return self._read(port).get(role, "") if port.HasValue(self._context) else ""

    def pose(self) -> RigidTransform:
        return RigidTransform(self._read(self._policy._pose_input))

    def position(self) -> np.ndarray:
        return self._read(self._policy._position_input).copy()

    def follower(self) -> FollowerStatus:
        return self._read(self._policy._follower_input)

    def supervisor(self) -> SupervisorStatus:
        port = self._policy._supervisor_input
        return self._read(port) if port.HasValue(self._context) else SupervisorStatus()
