"""Errors of masks and depth at the objects: masks that leak, take in a neighbour or lose a part of
the object, and stray depth."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform
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
    # Number of other objects of the scene, the nearest ones, that are labelled as the target.
    neighbours: int = 0
    # Share of the target's and of the grasped object's pixels, of all cameras together, that lose
    # their label: those on one side of a plane, whose direction follows from the seed, in [0, 1).
    lost_target: float = 0.0
    lost_grasped: float = 0.0

    def check(self, where: str = "clutter") -> None:
        """Raises `ConfigError` for a value out of range."""
        for name in ("stray", "lost_target", "lost_grasped"):
            value = getattr(self, name)
            check_range(0 <= value < 1, f"{where}.{name}", value, f"0 <= {name} < 1")
        check_bounds(self, where, {"neighbours": (0, 20)})
        bounds = {"ring": (0.0, 1.0), "patch": (1e-4, 1.0), "spread": (1e-4, 10.0)}
        check_bounds(self, where, bounds)

    @property
    def in_images(self) -> bool:
        """Whether it changes the images of cameras that label `neighbours` as the target."""
        return max(self.ring, self.stray, self.lost_target, self.lost_grasped) > 0


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


@dataclass(frozen=True)
class View:
    """What one camera sees of the objects: depth (H, W) (m), labels (H, W), X_WC, intrinsics."""

    depth: np.ndarray
    label: np.ndarray
    X_WC: RigidTransform
    info: CameraInfo

    def along(self, direction: np.ndarray) -> np.ndarray:
        """(H, W) How far along a unit vector (3,) of W each pixel's point lies (m); NaN where there
        is no depth."""
        z = np.where((self.depth > 0) & (self.depth < np.inf), self.depth, np.float32(np.nan))
        x, y = pixel_rays(self.info)
        d_C = self.X_WC.rotation().matrix().T @ direction
        return (x * d_C[0] + y * d_C[1] + d_C[2]) * z + self.X_WC.translation() @ direction


def lost_behind(
    views: Mapping[str, View], role: Role, share: float, direction: np.ndarray
) -> dict[str, np.ndarray]:
    """For each camera, which pixels (H, W) lie where an object of `role` is lost: on the near side
    of a plane across `direction` (3,), a unit vector of W, that has `share` of the object's pixels,
    of all cameras together, on that side."""
    along = {name: view.along(direction) for name, view in views.items()}
    own = np.concatenate([along[name][view.label == role] for name, view in views.items()])
    own = own[np.isfinite(own)]
    if len(own) == 0:
        return {name: np.zeros(view.label.shape, bool) for name, view in views.items()}
    return {name: found < np.quantile(own, share) for name, found in along.items()}


class CameraClutter(LeafSystem):
    """Puts clutter into the images of all cameras, the same for the same images.

    .. pydrake_system::

        name: CameraClutter
        input_ports:
        - <camera>.depth_image
        - <camera>.label_image
        - <camera>.pose
        output_ports:
        - <camera>.depth_image
        - <camera>.label_image

    - `<camera>.label_image`: roles; `<camera>.pose`: X_WC; as in the port contract, of each camera.
    """

    def __init__(self, clutter: Clutter, cameras: Mapping[str, CameraInfo], *, seed: int):
        """`cameras`: name -> intrinsics of both images; `seed`: >= 0."""
        super().__init__()
        self._clutter, self._infos, self._seed = clutter, dict(cameras), seed
        self._inputs = {}
        for name, info in cameras.items():
            size = info.width(), info.height()
            self._inputs[name] = (
                self.DeclareAbstractInputPort(f"{name}.depth_image", Value(ImageDepth32F(*size))),
                self.DeclareAbstractInputPort(f"{name}.label_image", Value(ImageLabel16I(*size))),
                self.DeclareAbstractInputPort(f"{name}.pose", Value(RigidTransform())),
            )
        self._images = self.DeclareCacheEntry(
            description="images with clutter",
            value_producer=ValueProducer(
                allocate=lambda: AbstractValue.Make(object()), calc=self._calc_images
            ),
            prerequisites_of_calc={self.all_input_ports_ticket()},
        )
        for name, info in cameras.items():
            for index, (port, image) in enumerate(
                (("depth_image", ImageDepth32F), ("label_image", ImageLabel16I))
            ):
                size = info.width(), info.height()
                self.DeclareAbstractOutputPort(
                    f"{name}.{port}",
                    lambda image=image, size=size: Value(image(*size)),
                    self._output(name, index),
                    prerequisites_of_calc={self._images.ticket()},
                )

    def _calc_images(self, context, value) -> None:
        views = {}
        for name, ports in self._inputs.items():
            depth, label, X_WC = (port.Eval(context) for port in ports)
            views[name] = View(depth.data[:, :, 0], label.data[:, :, 0], X_WC, self._infos[name])
        images = {}
        for index, (name, view) in enumerate(views.items()):
            rng = np.random.default_rng((self._seed, index, 2))
            images[name] = cluttered(view.depth, view.label, self._clutter, rng, info=view.info)
        lost = {Role.TARGET: self._clutter.lost_target, Role.GRASPED: self._clutter.lost_grasped}
        for role, share in lost.items():
            if share > 0:
                direction = np.random.default_rng((self._seed, int(role), 4)).normal(size=3)
                direction /= np.linalg.norm(direction)
                for name, behind in lost_behind(views, role, share, direction).items():
                    label = images[name][1]
                    label[behind & (label == role)] = Role.BACKGROUND
        value.set_value(images)

    def _output(self, name: str, index: int):
        def calc(context, output) -> None:
            image = self._images.Eval(context)[name][index]
            output.get_mutable_value().mutable_data[:, :, 0] = image

        return calc
