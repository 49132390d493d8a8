"""ICP on objects that it has seen: the exact pose comes back."""

import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from iga_drake.aligners.icp import IcpAligner
from iga_drake.aligners.protocol import AlignerError
from iga_drake.aligners.registry import make_aligner
from iga_drake.dataset.samples import make_sample
from iga_drake.demonstrations.alignment import Alignment, CloudError


def test_the_same_objects_moved_are_put_back() -> None:
    sample = make_sample("validation", 1)
    A, B = sample.points[0, 0].astype(float), sample.points[1, 0].astype(float)
    G = np.eye(4)
    G[:3, :3] = Rotation.from_rotvec([0.4, -0.3, 0.5]).as_matrix()
    G[:3, 3] = (0.1, 0.2, -0.3)
    estimate = IcpAligner(starts=48).align(
        (Alignment(A, B),), A @ G[:3, :3].T + G[:3, 3], B, seed=0
    )
    np.testing.assert_allclose(estimate.poses[0] @ G, np.eye(4), atol=2e-3)


def _brick(rng: np.random.Generator) -> np.ndarray:
    """Points of a brick's surface: it looks the same after half a turn about any of its axes."""
    points = rng.uniform(-1, 1, (600, 3))
    side = rng.integers(3, size=600)
    points[np.arange(600), side] = np.sign(points[np.arange(600), side])
    return points * [0.06, 0.04, 0.025]


@pytest.mark.parametrize("seed", range(6))
def test_the_way_up_tells_top_from_bottom(seed: int) -> None:
    """A ball-like thing lies on the brick's top; the test's brick is turned anyhow, up with it."""
    rng = np.random.default_rng(seed)
    thing = 0.03 * rng.normal(size=(300, 3)) * [1.0, 0.6, 0.4]
    up = np.array([0.0, 0.0, 1.0])
    shown = Alignment(thing + [0, 0, 0.06], _brick(rng), target_up=up)
    R = Rotation.random(rng=rng).as_matrix()
    p = rng.normal(size=3)
    estimate = IcpAligner(starts=12).align(
        (shown,), thing, _brick(rng) @ R.T + p, target_up=R @ up, seed=seed
    )
    assert len(estimate.poses) == 1
    np.testing.assert_allclose(R.T @ (estimate.poses[0, :3, 3] - p), [0, 0, 0.06], atol=0.01)


def test_a_way_up_of_another_length_is_refused() -> None:
    cloud = _brick(np.random.default_rng(0))
    with pytest.raises(CloudError, match=r"target_up: .*length 2"):
        IcpAligner().align((Alignment(cloud, cloud),), cloud, cloud, target_up=np.array([0, 0, 2]))


def test_a_missing_package_is_told_when_the_aligner_is_made(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(AlignerError, match=r"Open3D is not installed: pip install"):
        make_aligner("icp")


@pytest.mark.parametrize(
    "options", [{"starts": 0}, {"starts": "many"}, {"starts": 2.5}, {"voxel": float("nan")},
                {"refined": 1e9}, {"starts": [1]}],
)  # fmt: skip
def test_options_that_cannot_be_are_refused(options: dict) -> None:
    with pytest.raises(AlignerError):
        make_aligner("icp", **options)
