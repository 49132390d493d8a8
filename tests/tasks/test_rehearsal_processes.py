"""The cell in processes of its own, behind LCM over UDP, commanded at the clock's pace."""

import numpy as np
import pytest

from iga_drake import cli
from iga_drake.policy.motion import Phase
from iga_drake.station.cameras.rgbd import Intrinsics
from iga_drake.station.scenario import load_scenario
from iga_drake.tasks.rehearsal import RehearsalClock, rehearse, timing_of


@pytest.mark.parametrize("driver", [False, True], ids=["lcm", "driver"])
def test_a_cell_of_processes_is_booted_seen_and_commanded(driver: bool):
    scenario = load_scenario(
        "grasp", "hardware",
        overrides=["segmentation.source=truth", "aligner.name=expert",
                   "panda.visuals=primitives"],
    )  # fmt: skip
    for camera in scenario.cameras.values():
        camera.intrinsics = Intrinsics(160, 120, fx=154.0, fy=154.0, cx=79.5, cy=59.5)
    scenario.policy.minimum_points = 8
    said: list[str] = []
    moving: list[None] = []

    def proceed() -> bool:
        """Until it has moved for a while, however long the first image takes."""
        if any("move grasp" in line for line in said):
            moving.append(None)
        return len(moving) < 10

    rehearsed = rehearse(scenario, rate=0.1, on_event=said.append, proceed=proceed, driver=driver)
    phases = [entry.phase for entry in rehearsed.result.timeline]
    assert phases[:3] == [Phase.OBSERVE, Phase.INFER, Phase.MOVE], rehearsed.result
    assert rehearsed.timing.count > 20
    assert rehearsed.row()["rate"] == 0.1 and "FAILURE" in str(rehearsed)


def test_timing_is_in_milliseconds_of_the_wall_clock():
    clock = RehearsalClock(0.0, 0.5)
    # Every 5 ms, one 2 ms late.
    stamps = np.array([0.0, 0.005, 0.010, 0.015, 0.020, 0.025])
    arrivals = stamps + [0.001, 0.001, 0.003, 0.001, 0.001, 0.001]
    timing = timing_of(
        arrivals, stamps, clock=clock, period=0.005, expiry=0.05, inferring=[(0.018, 0.030)]
    )
    assert timing.count == 6 and timing.seconds == pytest.approx(0.025) and timing.missed == 0
    assert timing.jitter[2] == pytest.approx(4.0)  # 2 ms of a clock at half the pace
    assert timing.jitter_inferring == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)
    assert timing.latency[0] == pytest.approx(2.0) and timing.latency[2] == pytest.approx(6.0)
    empty = timing_of(np.zeros(0), np.zeros(0), clock=clock, period=0.005, expiry=0.05)
    assert empty.count == 0


def test_a_stall_and_an_expired_command_are_missed_watchdogs():
    stamps = 0.005 * np.arange(40.0)
    clock = RehearsalClock(0.0, 1.0)

    def missed(stamps: np.ndarray, arrivals: np.ndarray, changes: slice) -> tuple[int, int]:
        differs = np.zeros(40)
        differs[changes] = 1
        timing = timing_of(
            arrivals, stamps, clock=clock, period=0.005, expiry=0.05, changes=differs
        )
        return timing.missed, timing.missed_moving

    assert missed(stamps, stamps + 0.049, slice(None)) == (0, 0)
    stalled = stamps + np.where(np.arange(40) < 20, 0.0, 0.06)
    assert missed(stalled, stalled, slice(20, 40)) == (1, 1)
    assert missed(stalled, stalled, slice(0, 20)) == (1, 1)
    assert missed(stalled, stalled, slice(0, 19)) == (1, 0)  # it stood still before and after
    late = stamps + 0.001
    late[39] += 0.051
    # Nothing came for so long, and then one that had expired.
    assert missed(stamps, late, slice(None)) == (2, 2)
    assert missed(stamps, late, slice(0, 9)) == (2, 0)


def test_a_rate_above_the_clocks_is_refused(capsys: pytest.CaptureFixture):
    assert cli.main(["rehearse", "grasp", "--realtime", "2"]) == cli.BAD_INPUT
    assert "0.01 to 1" in capsys.readouterr().err
