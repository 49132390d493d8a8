"""Turns the labels of a renderer into the roles that the rest of the diagram knows."""

from collections.abc import Mapping

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import LeafSystem
from pydrake.systems.sensors import ImageLabel16I


class Segmentation(LeafSystem):
    """Maps a label image of body indices (Drake's default) to one of roles, by a look-up.

    Bodies that nobody mentions, the empty sky and Drake's other reserved labels are background.

    .. pydrake_system::

        name: Segmentation
        input_ports:
        - body_label_image
        output_ports:
        - label_image
    """

    def __init__(self, roles: Mapping[int, int], *, width: int, height: int, background: int = 0):
        """`roles`: body index -> role (the port contract's `Role`); `width`, `height` in px."""
        super().__init__()
        self._role_of_label = np.full(1 << 16, background, dtype=np.int16)
        for body, role in roles.items():
            self._role_of_label[body] = role
        self._input = self.DeclareAbstractInputPort(
            "body_label_image", Value(ImageLabel16I(width, height))
        )
        self.DeclareAbstractOutputPort(
            "label_image", lambda: Value(ImageLabel16I(width, height)), self._calc
        )

    def _calc(self, context, output):
        labels = self._input.Eval(context).data.view(np.uint16)
        output.get_mutable_value().mutable_data[:] = self._role_of_label[labels]
