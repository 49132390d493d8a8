"""`iga view energy`: the energy around a solution, the matches and the pairs of parts behind it.

Works with any `Explanation`: an energy of poses, matches of nodes, weights of pairs of parts.
"""

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from iga_drake.aligners.iga.aligner import Explanation, IgaAligner
from iga_drake.aligners.query import Query
from iga_drake.dataset.splits import sample_set
from iga_drake.files import output_file, output_folder
from iga_drake.studies.diagnosis import Problem, step_from
from iga_drake.viewing.dataset_views import ViewError
from iga_drake.viewing.figures import check_matplotlib, new_figure, write_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

REACH = 0.06  # m, of the plane of translations and along the axis
STEPS = 61  # of a heat map, each way
CLIP = 12.0  # energies this far above the lowest look the same
LINES = 32  # matches drawn of each object and demonstration: its first nodes, evenly spread
# Colours of matches and parts in Meshcat, by confidence from least to most: blue, cyan, green,
# orange, red.
LEVEL_COLORS = (
    (0.25, 0.30, 0.80, 1.0),
    (0.15, 0.65, 0.90, 1.0),
    (0.30, 0.75, 0.30, 1.0),
    (0.95, 0.60, 0.10, 1.0),
    (0.80, 0.10, 0.10, 1.0),
)
CONFIDENCES = len(LEVEL_COLORS)
VIEW = np.array([[-0.64, 0.77, 0.0], [-0.30, -0.25, 0.92]])  # (2, 3) across and up, projections


@dataclass(frozen=True)
class ExplainedProblem:
    """An alignment problem with the aligner's explanation of its answer, and the true pose."""

    name: str
    problem: Problem
    explanation: Explanation
    truth: np.ndarray  # (4, 4) X_WF of the valid answer of the lowest energy

    @staticmethod
    def of(
        aligner: IgaAligner, split: str, index: int, demonstrations: int | None
    ) -> "ExplainedProblem":
        """The explained problem of sample `index` of a set; `demonstrations` None: all."""
        problem = Problem.of(split, index, demonstrations)
        explanation = aligner.explain(*problem.query.clouds, seed=index)
        valid = problem.valid()
        energies = explanation.energy(torch.from_numpy(valid))
        return ExplainedProblem(
            f"{split} {index}", problem, explanation, valid[int(energies.argmin())]
        )

    @property
    def best(self) -> Tensor:
        """Pose X_WF (4, 4) of the best mode."""
        return torch.from_numpy(self.explanation.estimate.poses[0])

    @property
    def centre(self) -> Tensor:
        """Centre (3,) (m) of the grasped cloud, in its frame."""
        return torch.from_numpy(self.problem.query.grasped.mean(0))

    def text(self) -> str:
        """A summary of the problem, then a line for each mode: energy, probability, error."""
        truth = float(self.explanation.energy(torch.from_numpy(self.truth)))
        lines = [
            f"{self.name}: A {self.problem.sample.category[0]}, "
            f"B {self.problem.sample.category[1]}, "
            f"{len(self.problem.query.context)} demonstrations; energy of the truth {truth:.2f}"
        ]
        estimate = self.explanation.estimate
        for k, X in enumerate(estimate.poses):
            shift, angle = self.problem.error(X)
            lines.append(
                f"  mode {k}: energy {estimate.energies[k]:.2f}, probability "
                f"{estimate.probabilities[k]:.3f}, off by {100 * shift:.1f} cm, "
                f"{np.degrees(angle):.1f} deg (modulo symmetry)"
            )
        return "\n".join(lines)


@dataclass(frozen=True)
class Landscape:
    """Energies around a pose. Axes are rows, in W, the one of least curvature first."""

    axes: Tensor  # (3, 3) of translation
    turns: Tensor  # (3, 3) of rotation
    offsets: np.ndarray  # (n,) m, of the plane and along the axis
    angles: np.ndarray  # (m,) rad
    plane: np.ndarray  # (n, n) by steps along axes 0 and 1
    screw: np.ndarray  # (n, m) by steps along and turns about turns 0
    curves: np.ndarray  # (3, m) of turns about each of `turns`


def landscape(
    energy: Callable[[Tensor], Tensor], X: Tensor, centre: Tensor, *, steps: int = STEPS
) -> Landscape:
    """The energy in the plane of translations and about the axis of rotation in which it is the
    least curved at the pose X (4, 4); turns are about `centre` (3,), a point of the moved frame."""
    curvature: Tensor = torch.autograd.functional.hessian(  # type: ignore[no-untyped-call]
        lambda step: energy(step_from(X, centre, step)), torch.zeros(6, dtype=torch.float64)
    )
    turns, axes = (
        torch.linalg.eigh(curvature[part, part]).eigenvectors.T
        for part in (slice(0, 3), slice(3, 6))
    )
    offsets = torch.linspace(-REACH, REACH, steps, dtype=torch.float64)
    angles = torch.linspace(-np.pi, np.pi, 2 * steps - 1, dtype=torch.float64)
    zero = torch.zeros((), dtype=torch.float64)

    def at(turn: Tensor, shift: Tensor) -> np.ndarray:
        step = torch.cat(torch.broadcast_tensors(turn, shift), -1)
        poses = step_from(X, centre, step)
        with torch.no_grad():  # in pieces: an energy may hold much for every pose
            values = [energy(some) for some in poses.flatten(0, -3).split(256)]
        return torch.cat(values).reshape(step.shape[:-1]).numpy()

    plane = offsets[:, None, None] * axes[0] + offsets[None, :, None] * axes[1]
    spun = angles[:, None] * turns[0]
    along = offsets[:, None, None] * turns[0]
    return Landscape(
        axes=axes,
        turns=turns,
        offsets=offsets.numpy(),
        angles=angles.numpy(),
        plane=at(zero.expand(3), plane),
        screw=at(spun[None], along),
        curves=at(angles[None, :, None] * turns[:, None], zero.expand(3)),
    )


def landscape_figure(explained: ExplainedProblem, field: Landscape, path: Path) -> None:
    """Heat maps of the plane and of the axis, curves of turns; the truth and the modes marked."""
    figure, (plane, screw, curves) = new_figure(1, 3, inches=4.4)
    low = float(min(field.plane.min(), field.screw.min(), field.curves.min()))
    cm, degrees = 100 * field.offsets, np.degrees(field.angles)
    _heat(plane, cm, cm, field.plane.T, low)
    plane.contour(cm, cm, field.plane.T, low + np.array([1, 2, 5, 10]), colors="k", linewidths=0.4)
    shift = shift_along(explained, explained.truth, field.axes)
    plane.plot(0, 0, "k+", ms=10, mew=2, label="found; circles: other modes")
    plane.plot(*shift[:2], "r*", ms=10, label=f"truth ({shift[2]:+.1f} cm off the plane)")
    for k, X in enumerate(explained.explanation.estimate.poses[1:], 1):
        other = shift_along(explained, X, field.axes)
        if max(abs(other[:2])) < 100 * REACH:
            plane.plot(*other[:2], "ko", mfc="none", ms=5, mew=0.7)
            plane.text(other[0], other[1], f" {k}", color="k", fontsize=7)
    plane.set(
        title="Translation, plane of least curvature", xlabel="cm", ylabel="cm", aspect="equal",
        xlim=cm[[0, -1]], ylim=cm[[0, -1]],
    )  # fmt: skip
    plane.legend(fontsize=7, loc="upper right")
    image = _heat(screw, degrees, cm, field.screw, low)
    screw.plot(0, 0, "k+", ms=10, mew=2)
    screw.set(
        title="Axis of least curvature", xlabel="turn about it (deg)", ylabel="shift along it (cm)",
        xticks=range(-180, 181, 90),
    )  # fmt: skip
    figure.colorbar(image, ax=screw, label=f"energy, clipped {CLIP:.0f} above the lowest")
    for k, name in enumerate(("least", "middle", "most")):
        curves.plot(degrees, field.curves[k], label=f"axis of {name} curvature")
    curves.set(
        title="Rotation about the centre of A", xlabel="turn (deg)", ylabel="energy",
        xticks=range(-180, 181, 90),
    )  # fmt: skip
    curves.legend(fontsize=7)
    curves.grid(alpha=0.3)
    figure.suptitle(explained.name, fontsize=9)
    write_figure(figure, path)


def _heat(panel: "Axes", x: np.ndarray, y: np.ndarray, values: np.ndarray, low: float) -> Any:
    return panel.pcolormesh(
        x, y, values, vmin=low, vmax=low + CLIP, cmap="viridis_r", shading="nearest"
    )


def shift_along(explained: ExplainedProblem, X: np.ndarray, axes: Tensor) -> np.ndarray:
    """(3,) cm along axes (3, 3): from the centre of A in the best mode to that at pose X."""
    other = torch.from_numpy(X)
    off = (other - explained.best)[:3, :3] @ explained.centre + (other - explained.best)[:3, 3]
    return 100 * (axes @ off).numpy()


@dataclass(frozen=True)
class Lines:
    """Matches of one object between the test pair and one demonstration."""

    test: np.ndarray  # (n, 3) m, in the test cloud's frame
    demonstration: np.ndarray  # (n, 3) m
    confidence: np.ndarray  # (n,) probability of the match under the best hypothesis
    R_TD: np.ndarray  # (3, 3) turns the demonstration as the test cloud lies


def match_lines(explanation: Explanation, role: int, d: int, count: int = LINES) -> Lines:
    """The most likely matches of the first nodes."""
    match = explanation.matches[role][d]
    confidence, which = match.assignment[0, :count].max(-1)
    return Lines(
        test=explanation.nodes[role, -1, :count].numpy(),
        demonstration=explanation.nodes[role, d, which].numpy(),
        confidence=confidence.numpy(),
        R_TD=match.R_DT[0].T.numpy(),
    )


def _clouds(query: Query, role: int) -> tuple[np.ndarray, list[np.ndarray]]:
    """An object's test cloud, as the aligner got it, and its cloud in each demonstration."""
    if role == 0:
        return query.grasped, [a.grasped for a in query.context]
    return query.target, [a.target for a in query.context]


def correspondence_figure(explained: ExplainedProblem, path: Path) -> None:
    """Draws the matches to a PNG file, a panel for each object and demonstration.

    A panel shows the test cloud (left), the demonstration's, turned as the test cloud lies, and
    lines between matches, coloured by confidence.
    """
    from matplotlib.collections import LineCollection

    demonstrations = len(explained.problem.query.context)
    figure, panels = new_figure(2, demonstrations, inches=3.4)
    lines = None
    for role, name in enumerate("AB"):
        test, clouds = _clouds(explained.problem.query, role)
        for d, cloud in enumerate(clouds):
            panel = panels[role * demonstrations + d]
            matches = match_lines(explained.explanation, role, d)
            left, ends = ((p - test.mean(0)) @ VIEW.T for p in (test, matches.test))
            right, heads = (
                (p - cloud.mean(0)) @ matches.R_TD.T @ VIEW.T
                for p in (cloud, matches.demonstration)
            )
            apart = np.array([left[:, 0].max() - right[:, 0].min() + 0.03, 0.0])
            for points, color in ((left, "C1"), (right + apart, "C0")):
                panel.scatter(points[:, 0], points[:, 1], s=3, color=color, alpha=0.35, lw=0)
            lines = LineCollection(
                list(np.stack((ends, heads + apart), 1)), array=matches.confidence, cmap="turbo",
                linewidths=0.9, clim=(0.0, 1.0),
            )  # fmt: skip
            panel.add_collection(lines)
            panel.set_aspect("equal")
            panel.set_axis_off()
            category = explained.problem.sample.category[role]
            panel.set_title(f"{name} {category}, demonstration {d}", fontsize=8)
    if lines is not None:
        figure.colorbar(lines, ax=panels, label="probability of the match", shrink=0.7)
    figure.suptitle(f"{explained.name}: test cloud orange, demonstration blue", fontsize=9)
    write_figure(figure, path)


def pair_figure(explained: ExplainedProblem, path: Path) -> None:
    """Shares of the pairs of parts in the best mode, and of the parts on the clouds."""
    figure, (matrix, place, other) = new_figure(1, 3, inches=4.4)
    weights = explained.explanation.pair_weights(explained.best).numpy()
    image = matrix.imshow(weights, cmap="magma_r", aspect="auto")
    figure.colorbar(image, ax=matrix, label="share of the support")
    matrix.set(title="Pairs of parts", xlabel="part of B", ylabel="part of A")
    A, B, parts = _posed_parts(explained, weights)
    middle = B.mean(0)
    sights = (VIEW, np.array([[0.77, 0.64, 0.0], [-0.25, 0.30, 0.92]]))  # a quarter turn between
    for panel, sight in zip((place, other), sights, strict=True):
        for cloud, color in ((A, "C1"), (B, "C0")):
            x, y = sight @ (cloud - middle).T
            panel.scatter(x, y, s=4, color=color, alpha=0.3, lw=0)
        for nodes, share, edge in parts:
            x, y = sight @ (nodes - middle).T
            size = 4 + 400 * share
            panel.scatter(x, y, s=size, c=share, cmap="magma_r", edgecolors=edge, lw=0.8)
        panel.set_aspect("equal")
        panel.set_axis_off()
        panel.set_ylim(*_at_least(panel.get_ylim(), 0.15))
    place.set_title("Parts by their share")
    other.set_title("A quarter turn on")
    figure.suptitle(f"{explained.name}: A at the best mode orange, B blue", fontsize=9)
    write_figure(figure, path)


def _at_least(limits: tuple[float, float], span: float) -> tuple[float, float]:
    """Limits of an axis, widened about their middle where they span less."""
    middle, half = sum(limits) / 2, max(abs(limits[1] - limits[0]), span) / 2
    return middle - half, middle + half


def _posed_parts(
    explained: ExplainedProblem, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray, list[tuple[np.ndarray, np.ndarray, str]]]:
    """In W (m): A's cloud at the best mode, B's cloud, and for each object its parts' nodes (n, 3),
    their shares (n,) of the support, and an edge colour."""
    X = explained.best.numpy()
    A = explained.problem.query.grasped @ X[:3, :3].T + X[:3, 3]
    P, Q = weights.shape
    nodes = explained.explanation.nodes[:, -1].numpy()
    parts_A = nodes[0, :P] @ X[:3, :3].T + X[:3, 3]
    return (
        A,
        explained.problem.query.target,
        [(parts_A, weights.sum(1), "C1"), (nodes[1, :Q], weights.sum(0), "C0")],
    )


def write_figures(explained: ExplainedProblem, field: Landscape, folder: Path) -> list[Path]:
    """Writes all figures as PNG; returns their paths."""
    paths = [folder / f"{name}.png" for name in ("landscape", "correspondences", "pairs")]
    landscape_figure(explained, field, paths[0])
    correspondence_figure(explained, paths[1])
    pair_figure(explained, paths[2])
    return paths


def show_explained(meshcat, explained: ExplainedProblem, field: Landscape) -> None:
    """Shows in a `pydrake.geometry.Meshcat`: the test pair with its modes, the demonstrations
    behind it, matches as lines (red: sure, blue: a guess), parts by their share, the plane of
    translations coloured by energy."""
    from pydrake.geometry import Rgba

    from iga_drake.viewing.replay import (
        GRASPED_COLOR,
        PREDICTED_COLOR,
        TARGET_COLOR,
        show_cloud,
    )

    root = "energy"
    meshcat.Delete(root)
    for hidden in ("/Grid", "/Axes"):
        meshcat.SetProperty(hidden, "visible", False)
    for shade in ("top_color", "bottom_color"):
        meshcat.SetProperty("/Background", shade, [1.0, 1.0, 1.0])
    query, explanation = explained.problem.query, explained.explanation
    estimate = explanation.estimate
    middle = query.target.mean(0)
    show_cloud(meshcat, f"{root}/test/target cloud", query.target - middle, TARGET_COLOR)
    for k, X in enumerate(estimate.poses):
        name = f"{k} energy {estimate.energies[k]:.2f} probability {estimate.probabilities[k]:.2f}"
        moved = query.grasped @ X[:3, :3].T + X[:3, 3] - middle
        show_cloud(
            meshcat, f"{root}/modes/{name}", moved, PREDICTED_COLOR if k == 0 else GRASPED_COLOR
        )
        meshcat.SetProperty(f"{root}/modes/{name}", "visible", k == 0)
    truth = query.grasped @ explained.truth[:3, :3].T + explained.truth[:3, 3] - middle
    show_cloud(meshcat, f"{root}/truth", truth, Rgba(0.4, 0.4, 0.4, 1.0))
    meshcat.SetProperty(f"{root}/truth", "visible", False)
    _show_parts(meshcat, f"{root}/parts", explained, middle)
    _show_plane(meshcat, f"{root}/landscape", explained, field, middle)
    posed = explained.best.numpy()
    everything = np.concatenate([query.target - middle, truth])
    spacing = 1.2 * float(np.ptp(everything, axis=0).max()) + 0.05
    count = len(query.context)
    for d, alignment in enumerate(query.context):
        name = f"{root}/demonstrations/{d}"
        # Turned as B lies, in a row behind the test pair.
        turn = match_lines(explanation, 1, d).R_TD
        place = np.array([-spacing, spacing * (d - (count - 1) / 2), 0.0])
        own = alignment.target.mean(0)
        for what, cloud, color in (
            ("target cloud", alignment.target, TARGET_COLOR),
            ("grasped cloud", alignment.grasped, GRASPED_COLOR),
        ):
            show_cloud(meshcat, f"{name}/{what}", (cloud - own) @ turn.T + place, color)
        for role, what in enumerate("AB"):
            lines = match_lines(explanation, role, d)
            start = lines.test @ posed[:3, :3].T + posed[:3, 3] if role == 0 else lines.test
            end = (lines.demonstration - own) @ turn.T + place
            path = f"{root}/matches/{d} {what}"
            for level, color, some in _levels(lines.confidence, 1.0):
                meshcat.SetLineSegments(
                    f"{path}/{level}", (start[some] - middle).T, end[some].T, 1.5, Rgba(*color)
                )
            meshcat.SetProperty(path, "visible", d == count // 2)
    looks_at = np.array([-0.4 * spacing, 0.0, 0.0])
    meshcat.SetCameraPose(looks_at + spacing * np.array([1.7, 0.5, 1.3]), looks_at)


def _levels(
    values: np.ndarray, most: float
) -> list[tuple[str, tuple[float, float, float, float], np.ndarray]]:
    """Values in bins from 0 to `most`: a name, a colour from blue to red, which values."""
    bins = np.clip((CONFIDENCES * values / most).astype(int), 0, CONFIDENCES - 1)
    return [
        (f"above {most * k / CONFIDENCES:.3f}", color, bins == k)
        for k, color in enumerate(LEVEL_COLORS)
        if (bins == k).any()
    ]


def _show_parts(meshcat, path: str, explained: ExplainedProblem, middle: np.ndarray) -> None:
    from pydrake.geometry import Rgba

    from iga_drake.viewing.replay import show_cloud

    weights = explained.explanation.pair_weights(explained.best).numpy()
    for name, (nodes, share, _) in zip("AB", _posed_parts(explained, weights)[2], strict=True):
        for level, color, some in _levels(share, max(float(share.max()), 1e-9)):
            show_cloud(meshcat, f"{path}/{name}/{level}", nodes[some] - middle, Rgba(*color), 0.012)


def _show_plane(
    meshcat, path: str, explained: ExplainedProblem, field: Landscape, middle: np.ndarray
) -> None:
    from matplotlib import colormaps

    at = (explained.best[:3, :3] @ explained.centre + explained.best[:3, 3]).numpy() - middle
    u, v = np.meshgrid(field.offsets, field.offsets, indexing="ij")
    axes = field.axes.numpy()
    vertices = at + u.reshape(-1, 1) * axes[0] + v.reshape(-1, 1) * axes[1]
    n = len(field.offsets)
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate(
        [np.stack((corner, corner + n, corner + 1), 1),
         np.stack((corner + n, corner + n + 1, corner + 1), 1)]
    )  # fmt: skip
    level = np.clip((field.plane - field.plane.min()) / CLIP, 0, 1)
    colors = colormaps["viridis_r"](level.ravel())[:, :3]
    meshcat.SetTriangleColorMesh(path, vertices.T, faces.T, colors.T)
    meshcat.SetProperty(path, "visible", False)


def add_view_energy(parser: argparse.ArgumentParser) -> None:
    """Options of `iga view energy`."""
    parser.description = (
        "The energy around a solution, matches and pairs of parts: figures, a page, or served."
    )
    parser.add_argument(
        "--set", dest="split", default="unseen_categories", help="default: unseen_categories"
    )
    parser.add_argument("--index", type=int, default=0, help="of the sample (default 0)")
    parser.add_argument("--demonstrations", type=int, default=4, help="default 4")
    parser.add_argument("--weights", type=Path, help="of iga (default: the landed ones)")
    parser.add_argument("--out", type=output_folder, metavar="DIR", help="write figures there")
    parser.add_argument("--html", type=output_file, metavar="OUT", help="write a page, serve none")


def view_energy(arguments: argparse.Namespace) -> int:
    """Runs `iga view energy`; returns the exit status."""
    chosen = sample_set(arguments.split)
    if arguments.index < 0 or (chosen.count is not None and arguments.index >= chosen.count):
        raise ViewError(
            f"--index: sample {arguments.index} asked of '{arguments.split}', it has "
            f"{chosen.count or 'any from 0 on'}"
        )
    if not 1 <= arguments.demonstrations < chosen.pairs:
        raise ViewError(
            f"--demonstrations {arguments.demonstrations}: '{arguments.split}' has 1 to "
            f"{chosen.pairs - 1}"
        )
    check_matplotlib()
    explained = ExplainedProblem.of(
        IgaAligner(weights=arguments.weights),
        arguments.split,
        arguments.index,
        arguments.demonstrations,
    )
    print(explained.text(), flush=True)
    field = landscape(explained.explanation.energy, explained.best, explained.centre)
    if arguments.out:
        for path in write_figures(explained, field, arguments.out):
            print(f"written: {path}")
    if arguments.html or not arguments.out:
        from iga_drake.viewing.replay import quiet_meshcat, write_or_serve

        meshcat = quiet_meshcat()
        show_explained(meshcat, explained, field)
        write_or_serve(meshcat, arguments.html)
    return 0
