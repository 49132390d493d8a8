"""What gets into an object's cloud that isn't the object: masks that leak, and stray depth."""

from dataclasses import dataclass

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import LeafSystem, ValueProducer
from pydrake.systems.sensors import CameraInfo, ImageDepth32F, ImageLabel16I
from scipy.spatial import cKDTree

from iga_drake.errors import check_bounds, check_range
from iga_drake.geometry.depth_images import unreliable_pixels
from iga_drake.systems.fusion import pixel_rays
from iga_drake.systems.ports import Role

_JUMP = 0.02  # m between neighbours: pixels there may lie between the object and what is behind it


@dataclass
class Clutter:
    """Errors of labels and depth at the objects, in all cameras; none by default."""

    # Width (m) of the ring that the mask of an object takes in around it: background that is seen
    # within this distance of the object, so the table and neighbours, >= 0.
    ring: float = 0.0
    # Share of an object's pixels whose depth is wrong, in [0, 1).
    stray: float = 0.0
    # Diameter (m) of the patches in which it is wrong, > 0. The fusion drops single pixels and
    # nearly all patches of 1 cm.
    patch: float = 0.03
    # Each patch is nearer or farther along its rays by a distance between 0 and this (m), > 0.
    spread: float = 0.3

    def check(self, where: str = "clutter") -> None:
        """Raises `ConfigError` for a value out of range."""
        check_range(0 <= self.stray < 1, f"{where}.stray", self.stray, "0 <= stray < 1")
        bounds = {"ring": (0.0, 1.0), "patch": (1e-4, 1.0), "spread": (1e-4, 10.0)}
        check_bounds(self, where, bounds)

    @property
    def any(self) -> bool:
        """Whether there is any."""
        return self.ring > 0 or self.stray > 0


def cluttered(
    depth: np.ndarray,
    label: np.ndarray,
    clutter: Clutter,
    rng: np.random.Generator,
    *,
    info: CameraInfo,
) -> tuple[np.ndarray, np.ndarray]:
    """Copies of a depth (H, W) (m) and a label image (H, W) of roles with clutter at the objects.

    Pixels without a depth (0, NaN, infinite) keep theirs, and their label.
    """
    seen = np.where((depth > 0) & (depth < np.inf), depth, np.float32(np.nan))
    with_ring = _leaked(seen, label, clutter.ring, info) if clutter.ring > 0 else label.copy()
    with_stray = depth.copy()
    if clutter.stray > 0:
        for role in (Role.TARGET, Role.GRASPED):
            _scatter(with_stray, np.isfinite(seen) & (label == role), clutter, rng, info.focal_x())
    return with_stray, with_ring


def _leaked(seen: np.ndarray, label: np.ndarray, ring: float, info: CameraInfo) -> np.ndarray:
    """The labels (H, W) when background within `ring` (m) of an object gets the object's."""
    x, y = pixel_rays(info)
    points = np.stack([x * seen, y * seen, seen], axis=-1)
    # Points between an object and what is behind it would have rings of their own.
    jumps = unreliable_pixels(seen, np.zeros_like(label), jump=_JUMP, erosion=1)
    sound = np.isfinite(seen) & ~jumps
    background = np.isfinite(seen) & (label == Role.BACKGROUND)
    nearest = np.full(seen.shape, np.inf)
    leaked = label.copy()
    for role in (Role.TARGET, Role.GRASPED):
        mine = points[sound & (label == role)]
        if len(mine) == 0:
            continue
        near = background & (points >= mine.min(0) - ring).all(-1)
        near &= (points <= mine.max(0) + ring).all(-1)
        distance, _ = cKDTree(mine).query(points[near], distance_upper_bound=ring)
        closer = distance < nearest[near]
        leaked[near] = np.where(closer, role, leaked[near])
        nearest[near] = np.minimum(distance, nearest[near])
    return leaked


def _scatter(
    depth: np.ndarray, mine: np.ndarray, clutter: Clutter, rng: np.random.Generator, focal: float
) -> None:
    """Moves the given share of the pixels `mine` (H, W), which have a depth, in patches."""
    pixels = np.argwhere(mine)
    left = round(clutter.stray * len(pixels))
    free = mine.copy()
    true = depth.copy()
    for v, u in rng.permutation(pixels):
        if left == 0:
            return
        if not free[v, u]:
            continue
        radius = clutter.patch / 2 * focal / true[v, u]
        reach = int(radius)
        rows = slice(max(0, v - reach), v + reach + 1)
        columns = slice(max(0, u - reach), u + reach + 1)
        dv, du = np.ogrid[rows, columns]
        disc = ((dv - v) ** 2 + (du - u) ** 2 <= radius**2) & free[rows, columns]
        patch = np.argwhere(disc)[:left] + [rows.start, columns.start]
        at = tuple(patch.T)
        moved = true[at] + np.float32(rng.uniform(-clutter.spread, clutter.spread))
        depth[at] = np.maximum(moved, 0)
        free[at] = False
        left -= len(patch)


class CameraClutter(LeafSystem):
    """Puts clutter into the images of one camera (`cluttered`), the same for the same images.

    .. pydrake_system::

        name: CameraClutter
        input_ports:
        - depth_image
        - label_image
        output_ports:
        - depth_image
        - label_image

    - `label_image`: roles, as in the port contract.
    """

    def __init__(self, clutter: Clutter, *, info: CameraInfo, seed: tuple[int, ...]):
        """`info`: intrinsics of both images; `seed`: integers >= 0 that nothing else shares."""
        super().__init__()
        self._clutter, self._info, self._seed = clutter, info, seed
        size = info.width(), info.height()
        self._depth = self.DeclareAbstractInputPort("depth_image", Value(ImageDepth32F(*size)))
        self._label = self.DeclareAbstractInputPort("label_image", Value(ImageLabel16I(*size)))
        self._images = self.DeclareCacheEntry(
            description="images with clutter",
            value_producer=ValueProducer(
                allocate=lambda: AbstractValue.Make(object()), calc=self._calc_images
            ),
            prerequisites_of_calc={self.all_input_ports_ticket()},
        )
        for index, (name, image) in enumerate(
            (("depth_image", ImageDepth32F), ("label_image", ImageLabel16I))
        ):
            self.DeclareAbstractOutputPort(
                name,
                lambda image=image: Value(image(*size)),
                self._output(index),
                prerequisites_of_calc={self._images.ticket()},
            )

    def _calc_images(self, context, value) -> None:
        depth, label = (port.Eval(context).data[:, :, 0] for port in (self._depth, self._label))
        rng = np.random.default_rng(self._seed)
        value.set_value(cluttered(depth, label, self._clutter, rng, info=self._info))

    def _output(self, index: int):
        def calc(context, output) -> None:
            output.get_mutable_value().mutable_data[:, :, 0] = self._images.Eval(context)[index]

        return calc
