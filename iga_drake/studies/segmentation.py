"""`iga evaluate segmentation`: the geometric segmenter's labels beside the true ones.

Every scene of a task is looked at twice where the hand holds an object from the start: with the arm
as it starts, and in the posture in which the object is shown. A point is a pixel with a depth.
"""

import argparse
import json
import statistics
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from iga_drake.demonstrations.store import read_demonstrations
from iga_drake.errors import IgaDrakeError
from iga_drake.planning.inverse_kinematics import PoseSolver
from iga_drake.station.cameras.rgbd import camera_info
from iga_drake.station.make import make_station
from iga_drake.station.panda.model import find_panda
from iga_drake.station.panda.planning import make_panda_planning_robot
from iga_drake.station.perception import make_segmenter
from iga_drake.station.scenario import Scenario, load_scenario
from iga_drake.systems.fusion import pixel_rays
from iga_drake.systems.geometric_segmentation import CameraView, SegmentedViews
from iga_drake.systems.ports import Role
from iga_drake.tasks.distractors import with_distractors
from iga_drake.tasks.episode import TEST_SEED_OFFSET, demonstrations_path
from iga_drake.tasks.registry import scenario_task
from iga_drake.viewing.figures import figure_file, new_figure, write_figure

_COUNTED = {"target": Role.TARGET, "grasped": Role.GRASPED}
_TASKS = (
    "grasp",
    "stack",
    "sweep",
    "hang",
    "insert",
    "pour",
    "pick_and_insert",
    "pick_and_stack",
)
_COLORS = {Role.TARGET: (0.95, 0.55, 0.1), Role.GRASPED: (0.15, 0.55, 0.95),
           Role.ROBOT: (0.25, 0.75, 0.3)}  # fmt: skip


@dataclass(frozen=True)
class RenderedViews:
    """One look of all cameras at a scene."""

    views: Mapping[str, CameraView]
    labels: Mapping[str, np.ndarray]  # true roles, (H, W)
    colors: Mapping[str, np.ndarray]  # (H, W, 3) uint8
    position: np.ndarray  # joint angles (rad)
    opening: float  # m


@dataclass(frozen=True)
class RoleCounts:
    """Points of one role over any number of looks."""

    true: int = 0
    labelled: int = 0
    both: int = 0
    # Looks at which a role with points got no label at all.
    looks: int = 0
    refused: int = 0

    def add(self, truth: np.ndarray, label: np.ndarray, role: int) -> "RoleCounts":
        """With the points of one look, whose true and found roles are `truth` and `label` (P,)."""
        true, labelled = truth == role, label == role
        return RoleCounts(
            self.true + int(true.sum()),
            self.labelled + int(labelled.sum()),
            self.both + int((true & labelled).sum()),
            self.looks + int(true.any()),
            self.refused + int(true.any() and not labelled.any()),
        )

    @property
    def precision(self) -> float:
        """Share of the points labelled so that are so; NaN where there are none."""
        return self.both / self.labelled if self.labelled else float("nan")

    @property
    def recall(self) -> float:
        """Share of the points that are labelled so; NaN where there are none."""
        return self.both / self.true if self.true else float("nan")

    @property
    def overlap(self) -> float:
        """Intersection over union; NaN where there are no points."""
        union = self.true + self.labelled - self.both
        return self.both / union if union else float("nan")


@dataclass(frozen=True)
class SegmentationResult:
    """A task's points by role, of how many looks, and the segmenter's times (ms) and reasons."""

    task: str
    looks: int
    roles: Mapping[str, RoleCounts]
    # Points of the robot that were taken for an object.
    robot_as_object: int
    milliseconds: Sequence[float]
    problems: Sequence[str]


def render_views(scenario: Scenario, seed: int) -> Iterator[RenderedViews]:
    """The looks at one scene of the scenario's task, test objects; the arm doesn't move, but is put
    to where the object in the hand is shown."""
    task = scenario_task(scenario)
    scene = with_distractors(task.scene(seed), scenario.distractors, seed)
    station = make_station(scenario, scene=scene, seed=seed + TEST_SEED_OFFSET)
    context = station.CreateDefaultContext()
    plant = station.GetSubsystemByName("plant")
    panda = find_panda(plant)
    state = plant.GetMyMutableContextFromRoot(context)
    X_WE = panda.X_WE(state)
    postures = [np.asarray(scene.panda_position, dtype=float)]
    shown = [plan.present for plan in task.motion.observations if plan.present is not None]
    if shown and scene.truth.X_EO:  # the hand holds it at the start
        robot = make_panda_planning_robot(scenario.table, scenario.planning)
        solver = PoseSolver(robot, config=scenario.planning)
        found = solver.solve(shown[0], near=postures[0])
        postures += [] if found is None else [found]
    for posture in postures:
        panda.set_position(state, posture)
        moved = panda.X_WE(state) @ X_WE.inverse()
        for item in scene.with_role("grasped"):
            (body,) = plant.GetBodyIndices(plant.GetModelInstanceByName(item.name))
            plant.SetFloatingBaseBodyPoseInWorldFrame(
                state, plant.get_body(body), moved @ item.X_WO
            )
        images: dict[str, dict] = {}
        for name in scenario.camera_names:
            images[name] = {
                kind: station.GetOutputPort(f"{name}.{kind}").Eval(context)
                for kind in ("depth_image", "label_image", "color_image", "pose")
            }
        yield RenderedViews(
            views={
                name: CameraView(
                    image["depth_image"].data[:, :, 0].copy(),
                    pixel_rays(camera_info(scenario.cameras[name].intrinsics)),
                    image["pose"],
                )
                for name, image in images.items()
            },
            labels={name: i["label_image"].data[:, :, 0].copy() for name, i in images.items()},
            colors={name: i["color_image"].data[:, :, :3].copy() for name, i in images.items()},
            position=posture,
            opening=float(scene.hand_opening),
        )


def measure_segmentation(
    scenario: Scenario, seeds: Sequence[int], *, png: Path | None = None
) -> SegmentationResult:
    """Counts the points of the looks at the scenes with these seeds; `png`: a picture of the last
    look's labels, the true ones above those found."""
    task = scenario_task(scenario)
    demonstrations = read_demonstrations(demonstrations_path(scenario), task=task.name)
    demonstrations = demonstrations.first(min(scenario.context_size, len(demonstrations)))
    segmenter = make_segmenter(scenario, demonstrations)
    roles = {name: RoleCounts() for name in _COUNTED}
    times, problems, leaked = [], [], 0
    for seed in seeds:
        for rendered in render_views(scenario, seed):
            began = time.perf_counter()
            found = segmenter.segment(rendered.views, rendered.position, rendered.opening)
            times.append(1e3 * (time.perf_counter() - began))
            truth, label = _points(rendered, found)
            roles = {name: c.add(truth, label, _COUNTED[name]) for name, c in roles.items()}
            is_object = (label == Role.TARGET) | (label == Role.GRASPED)
            leaked += int(((truth == Role.ROBOT) & is_object).sum())
            problems += [
                f"{task.name}, seed {seed}: {name}: {reason}"
                for name, reason in found.problems.items()
                if (truth == _COUNTED[name]).any()
            ]
            if png is not None:
                _draw(rendered, found, png)
    return SegmentationResult(task.name, len(times), roles, leaked, times, problems)


def _points(rendered: RenderedViews, found: SegmentedViews) -> tuple[np.ndarray, np.ndarray]:
    """True and found roles (P,) of all cameras' pixels with a depth."""
    truth, label = [], []
    for name, view in rendered.views.items():
        seen = (view.depth > 0) & (view.depth < np.inf)
        truth.append(rendered.labels[name][seen])
        label.append(found.labels[name][seen])
    return np.concatenate(truth), np.concatenate(label)


def _draw(rendered: RenderedViews, found: SegmentedViews, path: Path) -> None:
    """Writes the true labels (above) and those found (below), one camera a column."""
    figure, panels = new_figure(2, len(rendered.views), inches=4.0)
    for row, (title, labels) in enumerate((("true", rendered.labels), ("geometric", found.labels))):
        for column, name in enumerate(rendered.views):
            image = rendered.colors[name] / 255.0
            shown = 0.6 * image.mean(axis=2, keepdims=True) + 0.4 * image
            for role, color in _COLORS.items():
                mine = labels[name] == role
                shown[mine] = 0.45 * shown[mine] + 0.55 * np.array(color)
            panel = panels[row * len(rendered.views) + column]
            panel.imshow(np.clip(shown, 0, 1))
            panel.set_title(f"{name}, {title}", fontsize=9)
            panel.set_axis_off()
    write_figure(figure, path)


def result_table(results: Sequence[SegmentationResult]) -> str:
    """The results as text."""
    lines = [
        f"{'task':<16}{'role':<9}{'looks':>6}{'refused':>9}{'points':>10}{'precision':>11}"
        f"{'recall':>8}{'IoU':>8}"
    ]
    for result in results:
        for name, c in result.roles.items():
            if c.true or c.labelled:
                lines.append(
                    f"{result.task:<16}{name:<9}{c.looks:>6}{c.refused:>9}{c.true:>10}"
                    f"{c.precision:>11.4f}{c.recall:>8.4f}{c.overlap:>8.4f}"
                )
        lines.append(
            f"{result.task:<16}robot taken for an object: {result.robot_as_object} points; "
            f"{statistics.median(result.milliseconds):.0f} ms (median) for the labels of a look"
        )
    return "\n".join([*lines, *(reason for each in results for reason in each.problems)])


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("--tasks", default=",".join(_TASKS), help=f"default {','.join(_TASKS)}")
    parser.add_argument("--count", type=int, default=5, help="scenes of each task")
    parser.add_argument("--seed", type=int, default=0, help="of the first scene")
    parser.add_argument("--distractors", type=int, default=0, help="further objects in each scene")
    parser.add_argument("--png", type=figure_file, help="picture of the labels of the last look")
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def run(arguments: argparse.Namespace) -> int:
    """Prints precision, recall and overlap of each role, and the reasons of refusals."""
    if arguments.count < 1 or arguments.seed < 0:
        raise IgaDrakeError(
            f"--count {arguments.count} --seed {arguments.seed}: at least 1 and 0 are needed"
        )
    results = []
    for name in arguments.tasks.split(","):
        scenario = load_scenario(name, overrides=[f"distractors={arguments.distractors}"])
        seeds = range(arguments.seed, arguments.seed + arguments.count)
        results.append(measure_segmentation(scenario, seeds, png=arguments.png))
    if arguments.json:
        print(json.dumps([_row(result) for result in results], indent=2))
    else:
        print(result_table(results))
    return 0


def _row(result: SegmentationResult) -> dict:
    """A result as plain JSON values."""
    return {
        "task": result.task,
        "looks": result.looks,
        "robot_as_object": result.robot_as_object,
        "milliseconds_median": statistics.median(result.milliseconds),
        "problems": list(result.problems),
        "roles": {
            name: {**vars(c), "precision": c.precision, "recall": c.recall, "iou": c.overlap}
            for name, c in result.roles.items()
        },
    }
