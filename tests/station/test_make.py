"""Stations and kinds of cameras by name, one file each, also from another package."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from outside_package import install

from iga_drake.station.contract import StationError
from iga_drake.station.make import make_station
from iga_drake.station.scenario import Scenario

CODE = '''
from dataclasses import dataclass

from iga_drake.errors import check_range
from iga_drake.station.cameras.rgbd import RgbdCamera
from iga_drake.station.simulated.station import build_simulation_station

BUILT = []


@dataclass
class ZoomCamera(RgbdCamera):
    """An RGB-D camera whose focal length is multiplied."""

    zoom: float = 1.0

    def check(self, where):
        super().check(where)
        check_range(self.zoom > 0, f"{where}.zoom", self.zoom, "> 0")

    def add(self, builder, scene_graph, *, name, seed):
        self.intrinsics.fx *= self.zoom
        self.intrinsics.fy *= self.zoom
        return super().add(builder, scene_graph, name=name, seed=seed)


def make(scenario, *, scene, seed, meshcat):
    BUILT.append(seed)
    return build_simulation_station(scenario, scene=scene, seed=seed, meshcat=meshcat)
'''

CHECK = """
import sys
import numpy as np
from iga_drake.station.make import make_station
from iga_drake.station.panda.model import HOME_POSITION
from iga_drake.station.scenario import ScenarioError, load_scenario
from iga_drake.station.simulated.scene import Scene

module, text = sys.argv[1:]
open("scenario.yaml", "w").write(text)
scenario = load_scenario("scenario.yaml")
near, far = scenario.cameras["near"], scenario.cameras["far"]
assert (type(near).__name__, type(far).__name__, far.zoom) == ("RgbdCamera", "ZoomCamera", 2.0)
scene = Scene(objects=(), panda_position=np.array(HOME_POSITION), hand_opening=0.04)
station = make_station(scenario, scene=scene, seed=7)
assert sys.modules[module].BUILT == [7]
context = station.CreateDefaultContext()
robot = [
    (station.GetOutputPort(f"{name}.label_image").Eval(context).data == 3).sum()
    for name in ("near", "far")
]
assert 2.5 < robot[1] / robot[0] < 5.0, robot  # twice as long and wide, as far as it is in view
try:
    load_scenario("scenario.yaml", overrides=["cameras.far.zoom=0"])
except ScenarioError as error:
    assert "cameras.far.zoom: 0" in str(error), error
else:
    raise AssertionError("a zoom of 0 was accepted")
"""

SCENARIO = """
station: outside
panda: {visuals: primitives}
cameras:
  near:
    pose: !LookAt {position: [2.6, 0.3, 1.0], target: [0.2, 0.0, 0.4]}
    intrinsics: {width: 160, height: 120, fx: 77.0, fy: 77.0, cx: 79.5, cy: 59.5}
  far: !ZoomCamera
    pose: !LookAt {position: [2.6, 0.3, 1.0], target: [0.2, 0.0, 0.4]}
    intrinsics: {width: 160, height: 120, fx: 77.0, fy: 77.0, cx: 79.5, cy: 59.5}
    zoom: 2.0
"""


def test_a_station_and_a_camera_of_another_package(tmp_path: Path):
    groups = {
        "iga_drake.stations": {"outside": "make"},
        "iga_drake.cameras": {"zoom": "ZoomCamera"},
    }
    module = install(tmp_path, CODE, groups)
    path = os.pathsep.join([str(tmp_path), *(p for p in sys.path if p)])
    done = subprocess.run(
        [sys.executable, "-c", CHECK, module, SCENARIO],
        cwd=tmp_path, env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr


def test_unknown_stations_are_listed():
    scenario = Scenario(station="moon")
    with pytest.raises(StationError, match="unknown station 'moon': one of: hardware, re"):
        make_station(scenario)


def test_the_simulated_station_needs_a_scene():
    with pytest.raises(StationError, match="needs a scene"):
        make_station(Scenario())
