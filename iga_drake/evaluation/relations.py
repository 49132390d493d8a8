"""R-NDF's test: a mug on a rack, a bottle in a container, a bowl on a mug, judged by physics.

Simeonov et al., "SE(3)-Equivariant Relational Rearrangement with Neural Descriptor Fields" (CoRL
2022). Demonstrations show other instances than the tests. Three depth cameras see each object by
itself. With poses `upright` both objects stand when they are seen, and the aligner is told what is
up; with `arbitrary` both are in any orientation, seen from anywhere, and it is told nothing.
"""

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from time import perf_counter
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from iga_drake.aligners.protocol import Aligner
from iga_drake.aligners.query import Query
from iga_drake.aligners.registry import ORACLE
from iga_drake.dataset.collections import collection_digest
from iga_drake.dataset.depth_camera import observe
from iga_drake.dataset.depth_noise import DepthNoise
from iga_drake.dataset.samples import camera_positions, surface_points
from iga_drake.errors import IgaDrakeError
from iga_drake.evaluation.placing import Placing, judge_placing
from iga_drake.evaluation.relation_objects import (
    DEMONSTRATION,
    PLACING_RELATIONS,
    TEST,
    PlacedPair,
    PlacingRelation,
    RelationObjects,
)
from iga_drake.evaluation.results import ResultsStore, aligner_key, code_key
from iga_drake.evaluation.task_success import wilson_interval
from iga_drake.progress import progress
from iga_drake.shapes.instance import ShapeInstance

POSES = ("upright", "arbitrary")
MOST_TILT = np.radians(15.0)
_POINTS, _VOXEL, _SURFACE = 512, 0.005, 2000
_DEMONSTRATION_TRIES = 5  # for each demonstration that is to hold


@dataclass(frozen=True)
class RelationTrial:
    """What became of one trial."""

    relation: str
    poses: str
    seed: int
    aligner: str
    success: bool
    cause: str  # of a failure, see `Placing`
    translation: (
        float  # m, of the grasped object's origin from where it belongs, in the target's frame
    )
    seconds: float  # of inference
    reused: bool = False


def placing_relation(name: str) -> PlacingRelation:
    """The relation of that name. Raises `IgaDrakeError` for another name."""
    for relation in PLACING_RELATIONS:
        if relation.name == name:
            return relation
    known = ", ".join(relation.name for relation in PLACING_RELATIONS)
    raise IgaDrakeError(f"relation '{name}' is not known; one of: {known}")


class RelationTest:
    """Trials of one relation with one source of objects."""

    def __init__(
        self,
        relation: PlacingRelation,
        *,
        poses: str = "upright",
        demonstrations: int = 10,
        meshes: str = "",
        unit: float = 1.0,
        lift: float = 0.02,
    ) -> None:
        """Args:
        poses: of the objects when they are seen, one of POSES.
        demonstrations: how many; the same ones in all trials, seen anew in each.
        meshes, unit: see `RelationObjects`.
        lift: see `judge_placing`.

        Raises `IgaDrakeError` for an unknown value, and where there are no objects.
        """
        if poses not in POSES:
            raise IgaDrakeError(f"poses '{poses}': one of {', '.join(POSES)} expected")
        if demonstrations < 1:
            raise IgaDrakeError(f"{demonstrations} demonstrations: at least 1 is needed")
        self.relation, self.poses, self.count = relation, poses, demonstrations
        self.objects = RelationObjects(meshes, unit)
        self.objects.check(relation)
        if not 0 <= lift < 1:
            raise IgaDrakeError(f"lift {lift}: 0 or more is expected (m)")
        self._meshes, self._unit, self._lift = meshes, unit, lift

    @property
    def source(self) -> str:
        """Where the objects are from, for tables."""
        return self.objects.source(self.relation)

    def trial(self, aligner: Aligner | None, seed: int) -> RelationTrial:
        """One trial; without an aligner the object is put where it truly belongs."""
        pair = self.objects.draw(self.relation, TEST, self._rng(seed, 0))
        X_BA, seconds = pair.X_BA, 0.0
        if aligner is not None:
            query, X_WA, X_WB = self.query(seed, pair)
            began = perf_counter()
            estimate = query.ask(aligner, seed)
            seconds = perf_counter() - began
            X_BA = np.linalg.inv(X_WB) @ query.motion(estimate) @ X_WA
        placing = self._judge(pair, X_BA)
        return RelationTrial(
            relation=self.relation.name,
            poses=self.poses,
            seed=seed,
            aligner=aligner.name if aligner else ORACLE,
            success=placing.success,
            cause=placing.cause,
            translation=float(np.linalg.norm(X_BA[:3, 3] - pair.X_BA[:3, 3])),
            seconds=seconds,
        )

    def query(self, seed: int, pair: PlacedPair) -> tuple[Query, np.ndarray, np.ndarray]:
        """The question about a test pair, and the poses X_WA, X_WB (4, 4) in which its cloud of A
        would be right beside that of B."""
        rng = self._rng(seed, 1)
        shown = _demonstrations(self.relation, self.count, self._meshes, self._unit)
        pairs = [*shown, pair]
        clouds, ups, poses = [], [], []
        for n, each in enumerate(pairs):
            anyhow = self.poses == "arbitrary" and n == len(pairs) - 1
            X_WB = np.eye(4)
            turn = Rotation.from_rotvec([0.0, 0.0, rng.uniform(-np.pi, np.pi)])
            X_WB[:3, :3] = (Rotation.random(rng=rng) if anyhow else turn).as_matrix()
            X_WB[:3, 3] = rng.normal(size=3) * 0.2
            X_WA = X_WB @ each.X_BA
            own = [
                _cloud(shape, X, None if anyhow else X[:3, 2], rng)
                for shape, X in ((each.grasped, X_WA), (each.target, X_WB))
            ]
            clouds.append(own)
            ups.append((X_WA[:3, 2], X_WB[:3, 2]))
            poses.append((X_WA, X_WB))
        points = np.stack([np.stack(own) for own in zip(*clouds, strict=True)])
        A, B = (np.stack(each) for each in zip(*ups, strict=True))
        X_WA, X_WB = poses[-1]
        start = np.eye(4)
        start[:3, 3] = rng.normal(size=3) * 0.3
        if self.poses == "upright":  # the grasped object stands, turned about the vertical
            stands = Rotation.from_rotvec([0.0, 0.0, rng.uniform(-np.pi, np.pi)]).as_matrix()
            start[:3, :3] = stands @ X_WA[:3, :3].T
            return Query.of(points, start, grasped_up=A, target_up=B), X_WA, X_WB
        start[:3, :3] = Rotation.random(rng=rng).as_matrix()
        return Query.of(points, start), X_WA, X_WB

    def key(self, aligner: Aligner | None, name: str, options: Mapping[str, Any]) -> dict[str, Any]:
        """All that a result depends on but the seed, for a `ResultsStore`."""
        return {
            "kind": "relations",
            "relation": self.relation.name,
            "poses": self.poses,
            "demonstrations": self.count,
            "meshes": collection_digest(self._meshes) if self._meshes else "",
            "unit": self._unit,
            "lift": self._lift,
            **aligner_key(aligner, name, options),
            "code": code_key(aligner),
        }

    def _judge(self, pair: PlacedPair, X_BA: np.ndarray) -> Placing:
        return _judge(self.relation, pair, X_BA, self._lift)

    def _rng(self, seed: int, stream: int) -> np.random.Generator:
        return _rng(self.relation, seed, stream)


@lru_cache(maxsize=8)
def _demonstrations(
    relation: PlacingRelation, count: int, meshes: str, unit: float
) -> tuple[PlacedPair, ...]:
    """Pairs of the demonstrations' instances that hold in the simulation where they belong."""
    objects, shown = RelationObjects(meshes, unit), []
    for seed in range(_DEMONSTRATION_TRIES * count):
        pair = objects.draw(relation, DEMONSTRATION, _rng(relation, seed, 2))
        if _judge(relation, pair, pair.X_BA, 0.0).success:
            shown.append(pair)
        if len(shown) == count:
            return tuple(shown)
    raise IgaDrakeError(
        f"{relation.name}: {len(shown)} of {_DEMONSTRATION_TRIES * count} demonstrations held, "
        f"{count} are needed: give other meshes, or ask for fewer"
    )


def _judge(relation: PlacingRelation, pair: PlacedPair, X_BA: np.ndarray, lift: float) -> Placing:
    return judge_placing(
        pair.grasped,
        pair.target,
        X_BA,
        most_tilt=MOST_TILT if relation.upright else None,
        lift=lift,
    )


def _rng(relation: PlacingRelation, seed: int, stream: int) -> np.random.Generator:
    """Objects are the same for all poses and aligners."""
    return np.random.default_rng([zlib.crc32(relation.name.encode()), seed, stream])


def _cloud(
    shape: ShapeInstance, X_WO: np.ndarray, up: np.ndarray | None, rng: np.random.Generator
) -> np.ndarray:
    """(P, 3) m: an object at X_WO (4, 4) as three noisy depth cameras see it, which stand above it
    in the direction of `up` (3,), or anywhere."""
    points, normals, spacing = surface_points(rng, shape.vertices[None], shape.faces, _SURFACE)
    points, normals = points @ X_WO[:3, :3].T + X_WO[:3, 3], normals @ X_WO[:3, :3].T
    above = None if up is None else up[None]
    cameras = camera_positions(rng, points.mean(1), above)
    clouds = observe(
        *(torch.from_numpy(each) for each in (points[None], normals[None], cameras)),
        spacing=torch.from_numpy(spacing[None]),
        voxel=_VOXEL,
        count=_POINTS,
        noise=DepthNoise(),
        generator=torch.Generator().manual_seed(int(rng.integers(1 << 62))),
    )
    return clouds.points.numpy()[0, 0]


def run_relation_trials(
    test: RelationTest,
    aligner: Aligner | None,
    seeds: Sequence[int],
    *,
    options: Mapping[str, Any] | None = None,
    store: ResultsStore | None = None,
) -> list[RelationTrial]:
    """Trials of an aligner; those that the store holds are taken from there, others put there."""
    name = aligner.name if aligner else ORACLE
    common = test.key(aligner, name, options or {})
    rows = []
    for seed in progress(seeds, f"{name}, {test.relation.name} ({test.poses})"):
        key = {**common, "seed": seed}
        known = store.get(key) if store else None
        if known is not None:
            rows.append(RelationTrial(**known, reused=True))
            continue
        row = test.trial(aligner, seed)
        if store:
            store.add(key, {n: value for n, value in asdict(row).items() if n != "reused"})
        rows.append(row)
    return rows


def summarise_relation(test: RelationTest, rows: Sequence[RelationTrial]) -> dict[str, Any]:
    """One row for a table: successes with Wilson's interval, causes of failures, what is published
    of R-NDF."""
    successes = sum(row.success for row in rows)
    causes = sorted({row.cause for row in rows if not row.success})
    return {
        "relation": test.relation.name,
        "poses": test.poses,
        "objects": test.source,
        "aligner": rows[0].aligner,
        "successes": successes,
        "trials": len(rows),
        "wilson_95": list(wilson_interval(successes, len(rows))),
        "median_translation_m": float(np.median([row.translation for row in rows])),
        "median_inference_s": float(np.median([row.seconds for row in rows])),
        "causes": {cause: sum(row.cause == cause for row in rows) for cause in causes},
        "published_rndf": test.relation.published[POSES.index(test.poses)],
        "reused": sum(row.reused for row in rows),
    }
