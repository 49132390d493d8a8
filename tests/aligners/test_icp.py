"""ICP on objects that it has seen: the exact pose comes back."""

import numpy as np
from scipy.spatial.transform import Rotation

from iga_drake.aligners.icp import IcpAligner
from iga_drake.dataset.samples import make_sample
from iga_drake.demonstrations.alignment import Alignment


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
