"""What named frames of the families promise: tips, tops, grips and openings are where they say."""

import numpy as np
import pytest
from family_properties import draws, winding_numbers

from iga_drake.shapes.families.cleaning import CLEANING
from iga_drake.shapes.families.containers import CONTAINERS
from iga_drake.shapes.families.furniture import FURNITURE
from iga_drake.shapes.families.stands import STANDS
from iga_drake.shapes.families.tools import TOOLS
from iga_drake.shapes.families.toys import TOYS
from iga_drake.shapes.families.wearables import WEARABLES
from iga_drake.shapes.instance import ShapeInstance

ALL = (*TOOLS, *CLEANING, *FURNITURE, *STANDS, *CONTAINERS, *WEARABLES, *TOYS)
BY_NAME = {family.name: family for family in ALL}
# Frames at an end: x leads out of the solid there.
TIPS = [
    ("hammer", "striking_face"),
    ("hammer", "claw"),
    ("screwdriver", "tip"),
    ("spatula", "blade_edge"),
    ("trowel", "tip"),
    ("knife", "blade_edge"),
    ("knife", "tip"),
    ("dustpan", "edge"),
    ("broom_head", "socket"),
    ("hook_stand", "hook_upper"),
    ("hook_stand", "hook_lower"),
    ("rack", "peg"),
    ("coat_hanger", "hook"),
    ("coat_hanger", "shoulder"),
    ("shoe", "toe"),
    ("shoe", "heel"),
    ("boot", "toe"),
    ("boot", "heel"),
    ("cap", "brim"),
    ("hat", "brim"),
    ("toy_airplane", "nose"),
    ("toy_airplane", "tail"),
    ("toy_airplane", "wing"),
    ("toy_car", "front"),
    ("toy_car", "rear"),
    ("toy_car", "wheel"),
    ("tap", "spout"),
    ("tap", "lever"),
]
# Frames on a surface that carries something or is looked at: the axis leads off the surface.
TOPS = [
    ("chair", "seat", 2),
    ("stool", "seat", 2),
    ("table", "top", 2),
    ("toy_car", "roof", 2),
    ("box", "floor", 2),
    ("tray", "floor", 2),
    ("hat", "crown", 2),
    ("hook_stand", "hook_seat", 2),
    ("shoe", "insole", 2),
    ("boot", "insole", 2),
    ("guitar", "body", 0),
    ("guitar", "bridge", 0),
]
# Frames inside what a hand takes, and the part's own axis.
GRIPS = [
    ("hammer", "grip"),
    ("screwdriver", "grip"),
    ("spatula", "grip"),
    ("trowel", "grip"),
    ("knife", "grip"),
    ("brush", "grip"),
    ("dustpan", "grip"),
    ("tray", "handle"),
    ("tray", "handle_left"),
    ("coat_hanger", "bar"),
    ("lamp", "stem"),
]
OPENINGS = [
    ("shoe", "opening"),
    ("boot", "opening"),
    ("rack", "opening"),
    ("box", "opening"),
    ("tray", "opening"),
    ("cap", "head_opening"),
    ("hat", "head_opening"),
    ("lamp", "shade"),
]


def inside(instance: ShapeInstance, points: np.ndarray) -> np.ndarray:
    """(P,) whether points are in the solid."""
    return winding_numbers(instance.vertices, instance.faces, points) > 0.5


def along(X: np.ndarray, axis: int, distances: np.ndarray) -> np.ndarray:
    """Points on a frame's axis at distances (m) from its origin."""
    return X[:3, 3] + distances[:, None] * X[:3, axis]


@pytest.mark.parametrize(("family", "name"), TIPS)
def test_tips_point_outwards(family: str, name: str) -> None:
    for instance in draws(BY_NAME[family]):
        X = instance.frames[name]
        assert not inside(instance, along(X, 0, np.linspace(0.006, 0.012, 3))).any()
        assert inside(instance, along(X, 0, -np.linspace(0.0005, 0.01, 8))).any()


@pytest.mark.parametrize(("family", "name", "axis"), TOPS)
def test_tops_lead_off_the_surface(family: str, name: str, axis: int) -> None:
    for instance in draws(BY_NAME[family]):
        X = instance.frames[name]
        assert not inside(instance, along(X, axis, np.array([0.003, 0.006]))).any()
        assert inside(instance, along(X, axis, -np.linspace(0.0003, 0.004, 9))).any()


@pytest.mark.parametrize(("family", "name"), GRIPS)
def test_grips_are_in_what_a_hand_takes(family: str, name: str) -> None:
    for instance in draws(BY_NAME[family]):
        X = instance.frames[name]
        assert inside(instance, X[None, :3, 3]).all()
        assert not inside(instance, along(X, 1, np.array([-0.04, 0.04]))).all()


@pytest.mark.parametrize(("family", "name"), OPENINGS)
def test_openings_lead_out_of_a_cavity(family: str, name: str) -> None:
    for instance in draws(BY_NAME[family]):
        X = instance.frames[name]
        assert not inside(instance, along(X, 2, -np.linspace(0.0, 0.006, 3))).any()
        # A floor or crown closes it, and there is a wall all round.
        start = X[:3, 3] - 0.004 * X[:3, 2]
        turn = np.arange(12) * (np.pi / 6)
        rays = np.cos(turn)[:, None] * X[:3, 0] + np.sin(turn)[:, None] * X[:3, 1]
        rays = np.concatenate([-X[None, :3, 2], rays])
        hit = instance.mesh.ray.intersects_any(np.tile(start, (13, 1)), rays)
        assert hit[0]
        assert hit[1:].mean() > 0.9
