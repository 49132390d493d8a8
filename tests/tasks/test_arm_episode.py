"""An episode on a station that knows no true state, here a stub's."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from robot_stub import START, make_scenario, stub_station

from iga_drake import cli
from iga_drake.aligners.protocol import PoseEstimate
from iga_drake.cli.run import judged
from iga_drake.policy.inference import LocalInference
from iga_drake.systems.messages import Cause
from iga_drake.systems.ports import ArmMode
from iga_drake.tasks.arm_episode import ArmEpisode
from iga_drake.tasks.episode import LogRequest


class Above:
    """An aligner that wants the hand above the target, or nowhere."""

    name = "above"
    answers = True

    def align(self, context, grasped, target, *, grasped_up=None, target_up=None, seed=0):
        X = np.diag([1.0, -1.0, -1.0, 1.0])
        X[:3, 3] = target.mean(0) + [0, 0, 0.12 if self.answers else 9.0]
        return PoseEstimate(X[None], np.zeros(1), np.ones(1))


def episode(aligner: Above, faults: dict[str, Any], **options: Any) -> ArmEpisode:
    scenario = make_scenario()
    scenario.policy.observe_settle = 0.1
    scenario.task.time_limit = 1.5
    inference = LocalInference(aligner, [()])
    station = stub_station(scenario, faults=faults)
    return ArmEpisode(scenario, station=station, inference=inference, rate=0.0, **options)


def test_it_runs_until_the_time_is_over_and_tells_how_it_goes(tmp_path: Path):
    pytest.importorskip("mcap")
    said: list[str] = []
    record = LogRequest(tmp_path / "arm.mcap")
    with episode(Above(), {}, record=record) as running:
        result = running.run(said.append)
        running.note(result)
        joints = running.robot.station.GetOutputPort("panda.position_measured").Eval(
            running.robot.station.GetMyContextFromRoot(running.simulator.get_context())
        )
    assert [line.split()[2] for line in said] == ["observe", "infer", "move"]
    assert not result.finished and result.cause is Cause.TIME
    assert "1.5 s are over" in result.reason and result.seconds == pytest.approx(1.5)
    assert np.abs(joints - START).max() > 0.05
    from iga_drake.station.log.reader import read_episode_log

    log = read_episode_log(tmp_path / "arm.mcap")
    assert log.verdict is not None and log.verdict["reason"] == result.reason
    assert log.verdict["success"] is None


def test_an_arm_that_stops_ends_it_with_the_reason():
    faults: dict[str, Any] = {}
    with episode(Above(), faults) as running:

        def proceed() -> bool:
            if running.time > 0.6:
                faults["panda.mode"] = np.array([float(ArmMode.REFLEX)])
            return True

        result = running.run(proceed=proceed)
    assert result.cause is Cause.ROBOT and ArmMode.REFLEX.problem in result.reason
    assert result.seconds < 1.4  # half a second after it was held
    assert str(result).startswith("FAILURE (robot)")


def test_it_can_be_ended_and_may_be_refused():
    with episode(Above(), {}) as running:
        result = running.run(proceed=lambda: running.time < 0.3)
    assert "it was ended" in result.reason
    aligner = Above()
    aligner.answers = False
    with episode(aligner, {}) as running:
        result = running.run()
    assert result.cause is Cause.IK and "outside the workspace" in result.reason


def test_the_operators_word_is_the_verdict():
    with episode(Above(), {}) as running:
        result = running.run(proceed=lambda: False)
    assert judged(result, True).success is True
    no = judged(result, False)
    assert no.success is False and "operator" in no.reason


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["--aligner", "expert"], "knows the true state"),
        (["--cell", "grasp"], "station 'simulated' is simulated"),
        (["--set", "hardware.boot_limit=0.05"], "PANDA_STATUS: 0 of 5 messages"),
        (["--record", "here.bag"], "name ends with .mcap"),
    ],
)
def test_what_cannot_run_is_refused_with_the_reason(
    capsys: pytest.CaptureFixture, arguments: list[str], reason: str
):
    assert cli.main(["run", "grasp", "--no-ask", *arguments]) == cli.BAD_INPUT
    assert reason in capsys.readouterr().err
