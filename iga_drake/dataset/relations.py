"""Relations between different products of our families, stated by their named frames.

Both objects stand upright on a table when they are seen, but for those that `Relation.upright`
names; A then goes to where a frame of it meets a frame of B, up to one offset that all pairs of a
sample share (the height of a spout over an opening, say). All pairs show different products, in
parameters and sizes.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from iga_drake.dataset.splits import SampleSet
from iga_drake.shapes.families import FAMILIES

Range = tuple[float, float]
# How far the products of a sample differ: standard deviation of every parameter about one draw of
# them, as a share of its range, and factors of the natural size, log-uniform.
SPREAD = 0.2
SIZE_FACTOR = (0.85, 1.18)

# Axes of a frame of A, as columns, in those of a frame of B.
SAME = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
ON_HOOK = ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))  # z up the hook, y along it
ON_PEG = ((0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 1.0))  # y out along the peg, z up
X_UP = ((0.0, 0.0, -1.0), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0))


@dataclass(frozen=True)
class Relation:
    """Where an object of one of some families belongs on one of others."""

    name: str
    grasped: Mapping[str, str]  # A's families: the frame whose origin counts
    target: Mapping[str, str]  # B's
    turn: tuple[tuple[float, ...], ...] = SAME
    # Whether the axes that `turn` relates are those of the frames, else those of the objects.
    frame_axes: tuple[bool, bool] = (False, False)
    # Shared by a sample, drawn uniformly: m, along the axes of B that count...
    offset: tuple[Range, Range, Range] = ((0.0, 0.0), (0.0, 0.0), (0.0, 0.0))
    # ...and rad: of A about its own y before `turn`, and about B's z after it.
    pitch: Range = (0.0, 0.0)
    yaw: Range = (0.0, 0.0)
    on_table: bool = False  # B's frame counts at the height of the table
    upright: tuple[bool, bool] = (True, True)  # whether A and B stand upright when they are seen
    axes: str = ""  # A's frame whose axes count, where it isn't that whose origin does


_ANY = (-np.pi, np.pi)
_LITTLE = (-0.2, 0.2)
RELATIONS = (
    Relation(
        "handle on a hook", {"mug": "handle"}, {"hook_stand": "hook_upper", "rack": "peg"},
        ON_HOOK, (True, True), ((-0.03, 0.0), (0.0, 0.0), (0.005, 0.02)), pitch=_LITTLE,
    ),
    Relation(
        "handle on a peg", {"mug": "handle"}, {"peg_tree": "peg_top"},
        ON_PEG, (True, True), ((-0.025, -0.005), (0.0, 0.0), (0.0, 0.01)), pitch=_LITTLE,
    ),
    Relation(
        "hanger on a hook", {"coat_hanger": "hook"}, {"hook_stand": "hook_upper", "rack": "peg"},
        ON_HOOK, (False, True), ((-0.01, 0.01), (0.0, 0.0), (0.005, 0.02)), pitch=_LITTLE,
        upright=(False, True),
    ),
    Relation(
        "ladle on a hook", {"ladle": "tip"},
        {"hook_stand": "hook_upper", "rack": "peg", "hook_rail": "hook_first"},
        X_UP, (True, False), ((-0.02, -0.01), (0.0, 0.0), (0.0, 0.02)), pitch=_LITTLE, yaw=_LITTLE,
        axes="handle", upright=(False, True),
    ),
    Relation(
        "hat on a hook", {"hat": "crown", "cap": "crown"}, {"hook_stand": "hook_upper"},
        offset=((-0.01, 0.01), (0.0, 0.0), (0.0, 0.02)), pitch=_LITTLE, yaw=_ANY,
    ),
    Relation(
        "bottle in a box", {"bottle": "base", "spray_bottle": "base", "jar": "base"},
        {"box": "floor", "crate": "floor"},
        offset=((-0.02, 0.02), (-0.02, 0.02), (0.0, 0.005)), yaw=_ANY,
    ),
    Relation(
        "shoe in a box", {"shoe": "sole", "boot": "sole"}, {"box": "floor", "crate": "floor"},
        offset=((-0.01, 0.01), (-0.01, 0.01), (0.0, 0.005)), yaw=_ANY,
    ),
    Relation(
        "spout over an opening",
        {"teapot": "spout", "kettle": "spout", "watering_can": "spout"},
        {"mug": "opening", "glass": "opening", "bowl": "opening", "bucket": "opening"},
        offset=((0.0, 0.02), (-0.01, 0.01), (0.01, 0.06)), pitch=(-0.9, -0.3), yaw=_ANY,
    ),
    Relation(
        "bowl in a bowl", {"bowl": "base"}, {"bowl": "floor", "pot": "base"},
        offset=((0.0, 0.0), (0.0, 0.0), (0.004, 0.012)), yaw=_ANY,
    ),
    Relation(
        "crockery on a plate", {"bowl": "base", "mug": "base", "glass": "base"}, {"plate": "floor"},
        offset=((-0.02, 0.02), (-0.02, 0.02), (0.0, 0.002)), yaw=_ANY,
    ),
    Relation(
        "spoon in a mug", {"spoon": "tip"}, {"mug": "base", "glass": "base", "bucket": "base"},
        X_UP, offset=((-0.01, 0.01), (-0.01, 0.01), (0.008, 0.015)), pitch=(-0.25, 0.25), yaw=_ANY,
        upright=(False, True),
    ),
    Relation(
        "bottle beside a handle", {"bottle": "base", "vase": "base", "glass": "base"},
        {"mug": "handle", "teapot": "handle", "jug": "handle"},
        offset=((0.05, 0.1), (-0.03, 0.03), (0.0, 0.0)), yaw=_ANY, on_table=True,
    ),
    Relation(
        "cookware on a table", {"kettle": "base", "pan": "base", "lamp": "base"},
        {"table": "top", "stool": "seat"},
        offset=((-0.03, 0.03), (-0.02, 0.02), (0.0, 0.002)), yaw=_ANY,
    ),
)  # fmt: skip


@dataclass(frozen=True)
class RelatedPairs:
    """N + 1 pairs of different products, the first one canonical, in one relation."""

    relation: Relation
    category: tuple[str, str]
    vertices: tuple[np.ndarray, np.ndarray]  # of A and B, (N + 1, V, 3) m in their own frames O
    faces: tuple[np.ndarray, np.ndarray]  # (F, 3)
    X_BA: np.ndarray  # (N + 1, 4, 4)
    places: tuple[np.ndarray, np.ndarray]  # (3,) m, the canonical instances' frames that meet


def related_categories(chosen: SampleSet, k: int) -> tuple[str, str]:
    """Names of A's and B's families at index k of a set of relations."""
    _, A, B = _drawn(chosen, k)
    return A, B


def related_pairs(chosen: SampleSet, k: int, size: Range) -> RelatedPairs:
    """The pairs at index k of a set of relations; extents of instances are kept within `size` m."""
    relation, *category = _drawn(chosen, k)
    shared = chosen.rng("alignments", k)
    X_FF = np.eye(4)
    R_pitch = Rotation.from_euler("y", shared.uniform(*relation.pitch)).as_matrix()
    R_yaw = Rotation.from_euler("z", shared.uniform(*relation.yaw)).as_matrix()
    X_FF[:3, :3] = R_yaw @ np.array(relation.turn) @ R_pitch
    X_FF[:3, 3] = [shared.uniform(*limits) for limits in relation.offset]
    vertices, faces, frames = [], [], []
    for role, name in enumerate(category):
        family, instances, own = FAMILIES[name], [], []
        product = family.sample_parameters(chosen.rng("instances", k, role))
        for n in range(chosen.pairs + 1):
            rng = chosen.rng("instances", k, role, n)
            draft = family.draft(family.vary_parameters(product, rng, SPREAD))
            surface = draft.surface()
            extent = float(np.ptp(surface.vertices, axis=0).max())
            factor = float(np.exp(rng.uniform(*np.log(SIZE_FACTOR))))
            factor = float(np.clip(factor * extent, *size)) / extent
            instances.append(factor * surface.vertices)
            own.append(_frame(relation, role, draft.frames, name, factor))
        vertices.append(np.stack(instances))
        faces.append(surface.faces)
        frames.append(np.stack(own))
    return RelatedPairs(
        relation=relation,
        category=(category[0], category[1]),
        vertices=(vertices[0], vertices[1]),
        faces=(faces[0], faces[1]),
        X_BA=frames[1] @ X_FF @ np.linalg.inv(frames[0]),
        places=(frames[0][0, :3, 3], frames[1][0, :3, 3]),
    )


def _drawn(chosen: SampleSet, k: int) -> tuple[Relation, str, str]:
    """The relation at index k and its two families."""
    rng = chosen.rng("categories", k)
    relation = RELATIONS[int(rng.integers(len(RELATIONS)))]
    A, B = (
        list(families)[int(rng.integers(len(families)))]
        for families in (relation.grasped, relation.target)
    )
    return relation, A, B


def _frame(
    relation: Relation, role: int, frames: Mapping[str, np.ndarray], name: str, factor: float
) -> np.ndarray:
    """X_OF (4, 4) of the frame that counts, of an object scaled by a factor."""
    X = frames[(relation.grasped, relation.target)[role][name]].copy()
    X[:3, 3] *= factor
    if role == 0 and relation.axes:
        X[:3, :3] = frames[relation.axes][:3, :3]
    if not relation.frame_axes[role]:
        X[:3, :3] = np.eye(3)
    if role == 1 and relation.on_table:
        X[2, 3] = 0.0
    return X
