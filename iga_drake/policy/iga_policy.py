"""The policy as a system: from clouds and demonstrations to end-effector targets."""

from typing import Any

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform
from pydrake.perception import PointCloud
from pydrake.systems.framework import Context, InputPort, LeafSystem, State

from iga_drake.policy.machine import PolicyMachine, PolicyMemory
from iga_drake.systems.messages import FollowerStatus, SupervisorStatus
from iga_drake.systems.ports import PANDA_JOINTS


def to_point_cloud(points: np.ndarray) -> PointCloud:
    """A Drake cloud of `points` (P, 3) (m)."""
    cloud = PointCloud(new_size=len(points))
    cloud.mutable_xyzs()[:] = np.asarray(points, dtype=np.float32).T
    return cloud


class IgaPolicy(LeafSystem):
    """Observes, infers where the grasped object has to go, and moves it there.

    All work is done in a periodic unrestricted update that writes one abstract state; every output
    only reads that state. Cloud inputs are pulled in the observing phases alone.

    .. pydrake_system::

        name: IgaPolicy
        input_ports:
        - target_cloud
        - grasped_cloud
        - camera_counts (optional)
        - pose_measured
        - panda.position_measured
        - follower.status
        - supervisor.status (optional)
        output_ports:
        - target
        - status
        - estimate
        - energy
        - target_observed
        - grasped_observed

    `camera_counts` is a dict of camera name -> value with `valid`, the pixels with a depth.
    `target` is an `EndEffectorTarget`, of sequence 0 while the arm has not been asked to move;
    `status` a `PolicyStatus` (phase, timeline, reason); `estimate` a tuple of the `PoseEstimate`,
    empty before there is one; `energy` the energy of the chosen pose (NaN before there is one);
    `target_observed` the observed target cloud in W; `grasped_observed` the grasped cloud in E that
    the aligner was given.
    """

    def __init__(self, machine: PolicyMachine) -> None:
        super().__init__()
        self._machine = machine
        cloud = Value[PointCloud]()
        self._target_cloud_input = self.DeclareAbstractInputPort("target_cloud", cloud)
        self._grasped_cloud_input = self.DeclareAbstractInputPort("grasped_cloud", cloud)
        self._counts_input = self.DeclareAbstractInputPort("camera_counts", AbstractValue.Make({}))
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

        def declare(name: str, example, read) -> None:
            def calc(context: Any, output: Any) -> None:
                output.set_value(read(self.memory(context)))

            self.DeclareAbstractOutputPort(
                name, lambda: AbstractValue.Make(example), calc, prerequisites_of_calc=state
            )

        declare("target", start.target, lambda memory: memory.target)
        declare("status", start.status, lambda memory: memory.status)
        declare("estimate", (), lambda m: () if m.estimate is None else (m.estimate,))
        declare("target_observed", PointCloud(), lambda m: to_point_cloud(m.target_points))
        declare("grasped_observed", PointCloud(), lambda m: to_point_cloud(m.grasped_points_E))
        self.DeclareVectorOutputPort("energy", 1, self._calc_energy, prerequisites_of_calc=state)
        self.DeclarePeriodicUnrestrictedUpdateEvent(machine.config.period, 0.0, self._update)

    def memory(self, context: Context) -> PolicyMemory:
        """What the policy remembers in its own `context`."""
        abstract: Any = context.get_abstract_state(int(self._memory_index))
        return abstract.get_value()

    def _calc_energy(self, context: Context, output) -> None:
        chosen = self.memory(context).chosen
        output.SetAtIndex(0, np.nan if chosen is None else chosen.energy)

    def _update(self, context: Context, state: State) -> None:
        memory = self._machine.advance(
            self.memory(context), _Pull(self, context), context.get_time()
        )
        state.get_mutable_abstract_state(int(self._memory_index)).set_value(memory)


class _Pull:
    """`PolicyInputs` read from the ports of one context, copied: Drake reuses its cache."""

    def __init__(self, policy: IgaPolicy, context: Context) -> None:
        self._policy = policy
        self._context = context

    def _read(self, port: InputPort) -> Any:
        return port.Eval(self._context)

    def target_cloud(self) -> np.ndarray:
        return self._read(self._policy._target_cloud_input).xyzs().T.copy()

    def grasped_cloud(self) -> np.ndarray:
        return self._read(self._policy._grasped_cloud_input).xyzs().T.copy()

    def silent_cameras(self) -> tuple[str, ...]:
        port = self._policy._counts_input
        if not port.HasValue(self._context):
            return ()
        return tuple(name for name, counts in self._read(port).items() if counts.valid == 0)

    def pose(self) -> RigidTransform:
        return RigidTransform(self._read(self._policy._pose_input))

    def position(self) -> np.ndarray:
        return self._read(self._policy._position_input).copy()

    def follower(self) -> FollowerStatus:
        return self._read(self._policy._follower_input)

    def supervisor(self) -> SupervisorStatus:
        port = self._policy._supervisor_input
        return self._read(port) if port.HasValue(self._context) else SupervisorStatus()
