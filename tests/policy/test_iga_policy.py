import numpy as np
from policy_fakes import GRIPPER, TARGET, X_GOAL, X_PRESENT, FakeAligner, make_machine
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.perception import PointCloud
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem

from iga_drake.policy.iga_policy import IgaPolicy
from iga_drake.policy.motion import Phase
from iga_drake.systems.messages import NO_TARGET, FollowerStatus


class CountingCloud(LeafSystem):
    """A cloud source that counts how often it is rendered; time makes every pull a new one."""

    def __init__(self, points: np.ndarray) -> None:
        super().__init__()
        self.count = 0
        self._points = points
        self.DeclareAbstractOutputPort(
            "cloud", lambda: AbstractValue.Make(PointCloud()), self._calc
        )

    def _calc(self, context, output) -> None:
        self.count += 1
        cloud = PointCloud(len(self._points))
        cloud.mutable_xyzs()[:] = self._points.T
        output.set_value(cloud)


class ReachesAtOnce(LeafSystem):
    """A follower that reports every target as reached 0.2 s after it was set."""

    def __init__(self, policy: IgaPolicy) -> None:
        super().__init__()
        self._input = self.DeclareAbstractInputPort("target", AbstractValue.Make(NO_TARGET))
        index = self.DeclareAbstractState(AbstractValue.Make(FollowerStatus()))
        self.DeclareStateOutputPort("status", index)
        self.DeclarePeriodicUnrestrictedUpdateEvent(0.2, 0.1, self._update)

    def _update(self, context, state) -> None:
        target = self._input.Eval(context)
        reached = target.sequence
        state.get_mutable_abstract_state(0).set_value(FollowerStatus(sequence_reached=reached))


def build(aligner):
    builder = DiagramBuilder()
    policy = builder.AddSystem(IgaPolicy(make_machine(aligner=aligner)))
    cloud = builder.AddSystem(CountingCloud(TARGET))
    follower = builder.AddSystem(ReachesAtOnce(policy))
    builder.Connect(cloud.GetOutputPort("cloud"), policy.GetInputPort("target_cloud"))
    builder.Connect(policy.GetOutputPort("target"), follower.GetInputPort("target"))
    builder.Connect(follower.GetOutputPort("status"), policy.GetInputPort("follower.status"))
    simulator = Simulator(builder.Build())
    context = policy.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    policy.GetInputPort("pose_measured").FixValue(context, X_PRESENT)
    policy.GetInputPort("panda.position_measured").FixValue(context, np.zeros(7))
    return policy, cloud, simulator, context


def test_runs_in_a_diagram_and_renders_only_while_observing():
    aligner = FakeAligner()
    policy, cloud, simulator, context = build(aligner)
    assert np.isnan(policy.GetOutputPort("energies").Eval(context)[0])
    assert policy.GetOutputPort("estimates").Eval(context) == ()
    assert policy.GetOutputPort("target").Eval(context).sequence == 0
    simulator.AdvanceTo(0.4)
    assert cloud.count == 0, "the scene is still coming to rest"
    simulator.AdvanceTo(10.0)
    status = policy.GetOutputPort("status").Eval(context)
    assert status.phase is Phase.DONE
    assert cloud.count == 1
    assert len(aligner.calls) == 1, "inference ran once, whatever was evaluated"
    assert policy.GetOutputPort("energies").Eval(context)[0] == 0.0
    assert len(policy.GetOutputPort("estimates").Eval(context)[0].poses) == 1
    observed = policy.GetOutputPort("observations").Eval(context)
    np.testing.assert_allclose(observed["pan"].points, TARGET, atol=1e-6)
    np.testing.assert_array_equal(observed["gripper"].points, GRIPPER)
    lifted = policy.GetOutputPort("target").Eval(context).X_WE
    expected = RigidTransform(X_GOAL.rotation(), X_GOAL.translation() + np.array([0, 0, 0.15]))
    assert lifted.IsNearlyEqualTo(expected, 1e-9)


def test_evaluating_outputs_never_infers():
    aligner = FakeAligner()
    policy, cloud, _simulator, context = build(aligner)
    for name in ("target", "status", "estimates", "energies", "observations"):
        policy.GetOutputPort(name).Eval(context)
    assert not aligner.calls and cloud.count == 0


def test_contexts_are_independent():
    policy, _cloud, simulator, context = build(FakeAligner())
    other = simulator.get_context().Clone()
    simulator.AdvanceTo(10.0)
    port = policy.GetOutputPort("status")
    assert port.Eval(context).phase is Phase.DONE
    assert port.Eval(policy.GetMyContextFromRoot(other)).phase is Phase.OBSERVE
