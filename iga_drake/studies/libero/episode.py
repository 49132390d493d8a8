"""Demonstrations by the expert, and episodes in which an aligner says where the hand has to go."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from iga_drake.aligners.protocol import Aligner, AlignerError, PoseEstimate
from iga_drake.demonstrations.alignment import CloudError
from iga_drake.demonstrations.demonstration import (
    Demonstration,
    DemonstrationSet,
    Observation,
    Provenance,
    Waypoint,
)
from iga_drake.studies.libero.benchmark import CAMERAS, STEPS, LiberoScene
from iga_drake.studies.libero.expert import (
    ExpertError,
    TooWideError,
    grasp_across,
    grasp_rim,
    place_in,
    place_on,
)
from iga_drake.studies.libero.motion import (
    Stretch,
    distance,
    grasp_way,
    nearest_turn,
    osc_action,
    place_way,
)
from iga_drake.studies.libero.perception import LabelledView, UnseenError, object_cloud
from iga_drake.version import code_version

TAKEN, GOAL = 1, 2  # labels
UP = np.array([0.0, 0.0, 1.0])
GRASP, PLACE = 0, 1  # waypoints
TRAVEL, CARRY = 0.22, 0.32  # m above the ground, of E
_OPENED, _SHUT = 0.08, 0.0  # m
_STRETCH_STEPS = 50  # at most
_EXACT, _ROUGH = (0.003, 0.02), (0.02, 0.1)  # m, rad from a stretch's end
# A hand that in so many steps comes no nearer than this (m; a rad counts as `_LEVER`) stands still.
_STALLED, _PROGRESS, _LEVER = 8, 0.002, 0.1
_EMPTY = 0.003  # m between the pads of a hand that holds nothing
_AWAY = 0.15  # m from E to the nearest point of an object that isn't held
# Horizontal directions in W, from the middle of a vessel to where its rim is taken.
_SIDES = ((0.0, -1.0), (0.0, 1.0), (-1.0, 0.0), (1.0, 0.0))
_PENETRATION = 0.006  # m that the hand's points may lie below the ground

Watch = Callable[[str, LiberoScene, Sequence[LabelledView]], None]


def _no_watch(when: str, scene: LiberoScene, views: Sequence[LabelledView]) -> None:
    pass


@dataclass(frozen=True)
class LiberoResult:
    """What came of one episode."""

    success: bool
    # Where it failed: perception, alignment, grasp (nothing was held), place, time; "" for none.
    cause: str
    reason: str
    steps: int  # of 1/20 s after settling, until the benchmark called it done or it failed
    # Whether it still was done after the hand had let go and gone: more than the benchmark asks.
    stays: bool
    # Of grasp and place, as far as they were asked: familiarity of both objects and confidence in
    # the answer, where the aligner gives them, probability and rank of the mode taken, seconds.
    familiarity: list[list[float]] = field(default_factory=list)
    confidence: list[float] = field(default_factory=list)
    probability: list[float] = field(default_factory=list)
    mode: list[int] = field(default_factory=list)
    inference_seconds: list[float] = field(default_factory=list)
    perception_seconds: list[float] = field(default_factory=list)
    wall_seconds: float = 0.0


class _Failure(Exception):
    def __init__(self, cause: str, reason: str):
        super().__init__(reason)
        self.cause = cause


class _Hand:
    """Moves a scene's hand along stretches, counts the steps, and notes when the benchmark calls
    the task done."""

    def __init__(self, scene: LiberoScene, limit: int):
        self.scene, self.limit, self.steps = scene, limit, 0
        self.done = False  # now
        self.done_after: int | None = None  # steps, for the first time

    def _step(self, stretch: Stretch) -> None:
        if self.steps >= self.limit and self.done_after is None:
            raise _Failure("time", f"{self.limit} steps are over")
        self.steps += 1
        self.done = self.scene.step(osc_action(self.scene.X_WE, stretch.X_WE, stretch.hand))
        if self.done and self.done_after is None:
            self.done_after = self.steps

    def follow(self, way: Sequence[Stretch]) -> None:
        """Goes along the stretches; one on which the hand comes no nearer to the end, as where the
        arm doesn't reach so far up, is left for the next."""
        for stretch in way:
            shift, turn = _EXACT if stretch.exact else _ROUGH
            before: list[float] = []
            for _ in range(_STRETCH_STEPS):
                away = distance(self.scene.X_WE, stretch.X_WE)
                if away[0] < shift and away[1] < turn:
                    break
                before.append(away[0] + _LEVER * away[1])
                if len(before) > _STALLED and before[-1] > before[-1 - _STALLED] - _PROGRESS:
                    break
                self._step(stretch)
            for _ in range(stretch.wait):
                self._step(stretch)


def _held_cloud(scene: LiberoScene, views: Sequence[LabelledView]) -> np.ndarray:
    """The cloud of what is taken, in E."""
    cloud, X = object_cloud(views, TAKEN, scene.taken), scene.X_WE
    return (cloud - X[:3, 3]) @ X[:3, :3]


def demonstrate(scene: LiberoScene, state: int, watch: Watch = _no_watch) -> Demonstration:
    """The expert does the task from an initial state.

    What is too wide is taken at its rim, from the first side that works. Raises `ExpertError` where
    it doesn't succeed, `UnseenError` where the cameras see too little.
    """
    scene.start(state)
    try:
        return _demonstrate(scene, state, grasp_across(scene.true_surface(scene.taken)), watch)
    except TooWideError:
        failures = []
    for side in _SIDES:
        scene.start(state)
        grasp = grasp_rim(scene.true_surface(scene.taken), np.array(side))
        try:
            return _demonstrate(scene, state, grasp, watch)
        except ExpertError as error:
            failures.append(str(error))
    raise ExpertError(failures[-1])


def _demonstrate(scene: LiberoScene, state: int, grasp: np.ndarray, watch: Watch) -> Demonstration:
    """The rest of `demonstrate`, with this grasp."""
    views = scene.views()
    watch("start", scene, views)
    taken, goal = object_cloud(views, TAKEN, scene.taken), object_cloud(views, GOAL, scene.goal)
    gripper = scene.gripper_cloud()
    hand = _Hand(scene, 10 * STEPS[scene.task.suite])
    way = grasp_way(nearest_turn(scene.X_WE, grasp), scene.ground + TRAVEL, scene.ground + CARRY)
    hand.follow(way[:3])
    grasp = scene.X_WE
    hand.follow(way[3:])
    views = scene.views()
    watch("held", scene, views)
    held, up_E = _held_cloud(scene, views), scene.X_WE[:3, :3].T @ UP
    put = place_in if scene.relation == "in" else place_on
    place = put(scene.X_WE, scene.true_surface(scene.taken), scene.true_surface(scene.goal))
    way = place_way(place, scene.ground + CARRY)
    hand.follow(way[:2])
    place = scene.X_WE
    hand.follow(way[2:])
    watch("end", scene, ())
    if not hand.done:
        raise ExpertError(f"{scene.task.name}, initial state {state}: the expert didn't succeed")
    up_E /= np.linalg.norm(up_E)
    observations = {
        "gripper": Observation(gripper, "gripper", "E", gravity=-up_E),
        "taken": Observation(taken, "target", "W", upright=True),
        "held": Observation(held, "grasped", "E", gravity=-up_E, upright=True),
        "goal": Observation(goal, "target", "W", upright=True),
    }
    waypoints = (
        Waypoint("grasp", _rigid(grasp), _SHUT, "gripper", "taken"),
        Waypoint("place", _rigid(place), _OPENED, "held", "goal"),
    )
    provenance = Provenance(
        source="scripted expert in LIBERO",
        seed=state,
        sensors=CAMERAS,
        instances={"taken": scene.taken, "goal": scene.goal},
        code=code_version(),
    )
    return Demonstration(observations, waypoints, provenance=provenance)


def _rigid(X: np.ndarray) -> np.ndarray:
    """The nearest rigid pose: MuJoCo's rotation matrices are orthonormal to 1e-6 alone."""
    U, _, Vt = np.linalg.svd(X[:3, :3])
    X = X.copy()
    X[:3, :3] = U @ Vt
    return X


class _Run:
    """One episode of an aligner."""

    def __init__(
        self,
        scene: LiberoScene,
        shown: DemonstrationSet,
        aligner: Aligner,
        seed: int,
        limit: int,
        watch: Watch,
    ):
        self.scene, self.shown, self.aligner, self.seed = scene, shown, aligner, seed
        self.hand, self.watch = _Hand(scene, limit), watch
        self.familiarity: list[list[float]] = []
        self.confidence: list[float] = []
        self.probability: list[float] = []
        self.mode: list[int] = []
        self.inference: list[float] = []
        self.perception: list[float] = []

    def views(self, when: str) -> list[LabelledView]:
        began = time.perf_counter()
        views = self.scene.views()
        self.perception.append(time.perf_counter() - began)
        self.watch(when, self.scene, views)
        return views

    def pose(
        self,
        waypoint: int,
        grasped: np.ndarray,
        target: np.ndarray,
        grasped_up: np.ndarray | None,
    ) -> np.ndarray:
        """The pose X_WE of the best mode that the arm can reach."""
        began = time.perf_counter()
        try:
            estimate = PoseEstimate.of(
                self.aligner.align(
                    self.shown.context(waypoint), grasped, target,
                    grasped_up=grasped_up, target_up=UP, seed=self.seed,
                )
            )  # fmt: skip
        except (AlignerError, CloudError) as error:
            raise _Failure("alignment", str(error)) from error
        self.inference.append(time.perf_counter() - began)
        if estimate.familiarity is not None:
            self.familiarity.append(np.round(estimate.familiarity, 4).tolist())
        if estimate.confidence is not None:
            self.confidence.append(round(estimate.confidence, 4))
        gripper = self.shown.demonstrations[0].observations["gripper"].points
        for mode, X in enumerate(estimate.poses):
            if waypoint == GRASP:
                X = nearest_turn(self.scene.X_WE, X)
            lowest = float((gripper @ X[2, :3]).min() + X[2, 3])
            if lowest < self.scene.ground - _PENETRATION:
                continue
            if not self.scene.reachable(X):
                continue
            self.mode.append(mode)
            self.probability.append(round(float(estimate.probabilities[mode]), 4))
            return X
        raise _Failure("alignment", f"none of {len(estimate.poses)} poses can be reached")

    def run(self) -> None:
        """Raises `_Failure` or `UnseenError` where it doesn't come to its end."""
        scene, ground = self.scene, self.scene.ground
        views = self.views("start")
        taken, goal = object_cloud(views, TAKEN, scene.taken), object_cloud(views, GOAL, scene.goal)
        gripper = self.shown.demonstrations[0].observations["gripper"].points

        grasp = self.pose(GRASP, gripper, taken, None)
        self.hand.follow(grasp_way(grasp, ground + TRAVEL, ground + CARRY))
        views = self.views("held")
        if scene.opening < _EMPTY:
            raise _Failure("grasp", "the hand is closed on nothing")
        held = _held_cloud(scene, views)
        nearest = float(np.linalg.norm(held, axis=1).min())
        if nearest > _AWAY:
            raise _Failure("grasp", f"{scene.taken} is {nearest:.2f} m away from the hand")

        up = scene.X_WE[:3, :3].T @ UP
        place = self.pose(PLACE, held, goal, up / np.linalg.norm(up))
        self.hand.follow(place_way(place, ground + CARRY))


def run_episode(
    scene: LiberoScene,
    state: int,
    shown: DemonstrationSet,
    aligner: Aligner,
    *,
    seed: int = 0,
    limit: int | None = None,
    watch: Watch = _no_watch,
) -> LiberoResult:
    """Does the task from an initial state, as the demonstrations show it.

    `limit`: steps, by default those of published evaluations of the suite.
    """
    began = time.perf_counter()
    scene.start(state)
    run = _Run(scene, shown, aligner, seed, limit or STEPS[scene.task.suite], watch)
    cause, reason = "place", f"{scene.taken} was let go, the benchmark doesn't call it done"
    try:
        run.run()
    except _Failure as failure:
        cause, reason = failure.cause, str(failure)
    except UnseenError as error:
        cause, reason = "perception", str(error)
    hand = run.hand
    success = hand.done_after is not None
    watch("end", scene, ())
    return LiberoResult(
        success=success,
        cause="" if success else cause,
        reason="" if success else reason,
        steps=hand.done_after or hand.steps,
        stays=hand.done,
        familiarity=run.familiarity,
        confidence=run.confidence,
        probability=run.probability,
        mode=run.mode,
        inference_seconds=[round(s, 3) for s in run.inference],
        perception_seconds=[round(s, 3) for s in run.perception],
        wall_seconds=round(time.perf_counter() - began, 2),
    )
