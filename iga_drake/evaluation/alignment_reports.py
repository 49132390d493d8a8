"""Alignment errors as files that others read: tables in Markdown, and a figure of both errors."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from iga_drake.aligners.registry import ORACLE
from iga_drake.dataset.splits import sample_set
from iga_drake.evaluation.alignment import FLIP, THRESHOLDS, AlignmentErrors
from iga_drake.viewing.figures import new_figure, write_figure


def markdown_errors(errors: Sequence[AlignmentErrors]) -> str:
    """Two tables of errors modulo symmetry: translation / rotation, sets down and aligners across,
    then a line for each aligner and set with everything."""
    within = " | ".join(f"{100 * m:g} cm {degrees:g}°" for m, degrees in THRESHOLDS)
    aligners = list(dict.fromkeys(each.aligner for each in errors))
    found = {(_clouds(each), each.aligner): each for each in errors}
    lines = [
        "Mean errors modulo symmetry, cm / deg:",
        "",
        "| clouds | " + " | ".join(aligners) + " |",
        "|---" * (1 + len(aligners)) + "|",
    ]
    for clouds in dict.fromkeys(map(_clouds, errors)):
        cells = [clouds]
        for aligner in aligners:
            each = found.get((clouds, aligner))
            cells.append(
                f"{each.modulo.translation_mean:.2f} / {each.modulo.rotation_mean:.1f}"
                if each
                else "-"
            )
        lines.append("| " + " | ".join(cells) + " |")
    lines += [
        "",
        f"Modulo symmetry, mean ± standard deviation (median); flips: over {FLIP:g}°; seconds: "
        "median of an inference.",
        "",
        f"| aligner | clouds | samples | translation, cm | rotation, deg | {within} | flips | s |",
        "|---" * (7 + len(THRESHOLDS)) + "|",
    ]
    for each in errors:
        e = each.modulo
        shares = " | ".join(f"{100 * share:.0f} %" for share in e.success)
        lines.append(
            f"| {each.aligner} | {_clouds(each)} | {each.count} "
            f"| {e.translation_mean:.2f} ± {e.translation_std:.2f} ({e.translation_median:.2f}) "
            f"| {e.rotation_mean:.1f} ± {e.rotation_std:.1f} ({e.rotation_median:.1f}) "
            f"| {shares} | {100 * e.flips:.1f} % | {each.seconds_median:.2f} |"
        )
    return "\n".join(lines) + "\n"


def draw_errors(errors: Sequence[AlignmentErrors], path: Path) -> None:
    """Writes a PNG: mean translation and rotation errors modulo symmetry, the sets beside each
    other, a bar for each aligner, with the standard errors of the means; the oracle's as lines."""
    clouds = list(dict.fromkeys(map(_clouds, errors)))
    aligners = list(dict.fromkeys(e.aligner for e in errors if e.aligner != ORACLE))
    figure, panels = new_figure(2, 1)
    figure.set_size_inches(max(6.0, 1.4 * len(clouds)), 6.5)
    width = 0.8 / max(1, len(aligners))
    quantities = (("translation", "translation error, cm"), ("rotation", "rotation error, deg"))
    for panel, (quantity, label) in zip(panels, quantities, strict=True):
        for each in errors:
            mean = getattr(each.modulo, f"{quantity}_mean")
            place = clouds.index(_clouds(each))
            if each.aligner == ORACLE:
                named = "" if ORACLE in panel.get_legend_handles_labels()[1] else ORACLE
                panel.hlines(mean, place - 0.45, place + 0.45, "black", "dashed", label=named)
                continue
            number = aligners.index(each.aligner)
            spread = getattr(each.modulo, f"{quantity}_std") / np.sqrt(each.count)
            panel.bar(
                place + (number - (len(aligners) - 1) / 2) * width,
                mean,
                0.9 * width,
                yerr=spread,
                color=f"C{number % 10}",
                error_kw={"elinewidth": 0.8},
            )
        for number, aligner in enumerate(aligners):
            panel.bar(0, 0, color=f"C{number % 10}", label=aligner)
        labels = [text.replace(", ", "\n") for text in clouds]
        panel.set_xticks(range(len(clouds)), labels, fontsize=8)
        panel.set_ylabel(label)
        panel.spines[["top", "right"]].set_visible(False)
    panels[0].legend(fontsize=8, ncols=4)
    write_figure(figure, path)


def _clouds(each: AlignmentErrors) -> str:
    """The set, its field version, and whether ways up were given; the oracle needs none, and stands
    beside those that had them where they are given by default."""
    up = each.up or (each.aligner == ORACLE and sample_set(each.split).relations)
    return ", ".join(filter(None, (each.split, each.field, "up known" if up else "")))
