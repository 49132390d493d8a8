import numpy as np
from pydrake.systems.sensors import ImageLabel16I

from iga_drake.systems.ports import Role
from iga_drake.systems.segmentation import Segmentation


def _segment(roles, labels: np.ndarray) -> np.ndarray:
    height, width = labels.shape
    system = Segmentation(roles, width=width, height=height)
    image = ImageLabel16I(width, height)
    image.mutable_data[:, :, 0] = labels
    context = system.CreateDefaultContext()
    system.get_input_port().FixValue(context, image)
    return system.get_output_port().Eval(context).data[:, :, 0].copy()


def test_bodies_become_roles():
    roles = {3: Role.ROBOT, 4: Role.ROBOT, 7: Role.TARGET, 8: Role.GRASPED}
    labels = np.random.default_rng(0).integers(0, 10, (48, 64)).astype(np.int16)
    segmented = _segment(roles, labels)
    for body in range(10):
        expected = roles.get(body, Role.BACKGROUND)
        assert (segmented[labels == body] == expected).all()


def test_reserved_labels_are_background():
    # Drake's empty, do-not-render, don't-care and unspecified.
    labels = np.array([[32766, 32765, 32764, 32767, -1, 5]], dtype=np.int16)
    np.testing.assert_array_equal(_segment({5: 1}, labels), [[0, 0, 0, 0, 0, 1]])
