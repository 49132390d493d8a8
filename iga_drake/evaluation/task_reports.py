"""Results of trials as files that others read (JUnit's XML, Markdown), and against earlier ones."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from scipy.stats import binomtest

from iga_drake.evaluation.results import ResultsStore
from iga_drake.evaluation.task_success import (
    BROKEN,
    EvaluationError,
    TrialResult,
    summarise_trials,
)

# What a trial is, whatever code or weights it is run with: scenario's name, aligner, split, seed.
_Identity = tuple[str, str, str, int]


def _identity(result: TrialResult) -> _Identity:
    return result.scenario, result.aligner, result.split, result.seed


def _word(result: TrialResult) -> str:
    return "success" if result.success else f"{result.cause}: {result.reason}"


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Trials now against the same trials before: pairs (before, now), in the order of now."""

    broke: tuple[tuple[TrialResult, TrialResult], ...]  # success before, failure now
    mended: tuple[tuple[TrialResult, TrialResult], ...]
    other_cause: tuple[tuple[TrialResult, TrialResult], ...]  # failed both times
    same: int
    new: int  # trials that weren't run before

    @property
    def probability(self) -> float:
        """Probability of so uneven a split of the changed verdicts, or a more uneven one, where a
        change either way is as likely (exact sign test; McNemar, Psychometrika 12 (1947) 153)."""
        changed = len(self.broke) + len(self.mended)
        return float(binomtest(len(self.broke), changed).pvalue) if changed else 1.0

    def lines(self) -> list[str]:
        """A head line, then one for each trial that changed."""
        head = (
            f"against before: {len(self.broke)} broke, {len(self.mended)} mended, "
            f"{len(self.other_cause)} fail otherwise, {self.same} are the same, {self.new} are new "
            f"(sign test: p = {self.probability:.2g})"
        )
        changed = [
            f"  {name} {now.scenario} {now.aligner} seed {now.seed}: "
            f"{_word(before)} -> {_word(now)}"
            for name, pairs in (
                ("broke", self.broke),
                ("mended", self.mended),
                ("fails otherwise", self.other_cause),
            )
            for before, now in pairs
        ]
        return [head, *changed]


def read_trials(path: Path) -> list[TrialResult]:
    """The trials of a results file (`iga evaluate tasks --results`), of each the latest.

    Raises `EvaluationError` where there is no file or no trial in it, `ResultsError` for a file of
    another kind.
    """
    if not path.is_file():
        raise EvaluationError(f"{path}: no such results file")
    found: dict[_Identity, TrialResult] = {}
    for key, row in ResultsStore(path).rows():
        if key.get("kind") != "tasks":
            continue
        result = TrialResult(
            task=row["task"],
            scenario=row.get("scenario", row["task"]),
            aligner=key["aligner"],
            seed=key["seed"],
            split=key["split"],
            success=row["success"],
            cause=row.get("cause", ""),
            reason=row.get("reason", ""),
        )
        found.pop(_identity(result), None)
        found[_identity(result)] = result
    if not found:
        raise EvaluationError(f"{path}: holds no trials of tasks: name another results file")
    return list(found.values())


def compare_trials(before: Sequence[TrialResult], now: Sequence[TrialResult]) -> Comparison:
    """Trials are the same where scenario's name, aligner, split and seed are. Those whose process
    broke, now or before, measured nothing and are left out."""
    known: Mapping[_Identity, TrialResult] = {
        _identity(result): result for result in before if result.cause != BROKEN
    }
    broke, mended, other, same, new = [], [], [], 0, 0
    for result in now:
        if result.cause == BROKEN:
            continue
        earlier = known.get(_identity(result))
        if earlier is None:
            new += 1
        elif earlier.success and not result.success:
            broke.append((earlier, result))
        elif result.success and not earlier.success:
            mended.append((earlier, result))
        elif earlier.cause != result.cause:
            other.append((earlier, result))
        else:
            same += 1
    return Comparison(
        broke=tuple(broke), mended=tuple(mended), other_cause=tuple(other), same=same, new=new
    )


def junit_xml(results: Sequence[TrialResult]) -> str:
    """The results in the XML that continuous integration reads: a suite for each scenario and
    aligner, a case for each seed; a process that broke is an error, what else fails a failure."""
    root = ElementTree.Element("testsuites")
    for scenario, aligner in dict.fromkeys((r.scenario, r.aligner) for r in results):
        mine = [r for r in results if (r.scenario, r.aligner) == (scenario, aligner)]
        broken = sum(r.cause == BROKEN for r in mine)
        suite = ElementTree.SubElement(
            root, "testsuite", name=f"{scenario}.{aligner}", tests=str(len(mine)),
            failures=str(sum(not r.success for r in mine) - broken), errors=str(broken),
            time=f"{sum(r.wall_seconds or 0.0 for r in mine):.3f}",
        )  # fmt: skip
        for result in mine:
            case = ElementTree.SubElement(
                suite, "testcase", classname=f"{scenario}.{aligner}", name=f"seed {result.seed}",
                time=f"{result.wall_seconds or 0.0:.3f}",
            )  # fmt: skip
            if not result.success:
                kind = "error" if result.cause == BROKEN else "failure"
                ElementTree.SubElement(
                    case, kind, type=result.cause, message=_printable(result.reason)
                )
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def _printable(text: str) -> str:
    """Without characters that XML can't hold."""
    return "".join(c if c.isprintable() else " " for c in text)


def markdown_summary(results: Sequence[TrialResult], comparison: Comparison | None = None) -> str:
    """A table of scenarios by aligners, one of rates with 95 % intervals, causes of failure and
    times, then the failures and what changed."""
    rows = summarise_trials(results)

    def number(value: float | None, scale: float, unit: str) -> str:
        return "-" if value is None else f"{scale * value:.2f} {unit}".rstrip()

    lines = _rates(rows)
    lines += [
        "",
        "| scenario | aligner | success | 95 % interval | causes | position | rotation | inference "
        "| simulated, mean | wall clock, mean | real-time factor |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    failures = []
    for row in rows:
        causes = ", ".join(f"{cause} {count}" for cause, count in row["causes"].items())
        low, high = row["wilson_95"]
        lines.append(
            f"| {_cell(row['scenario'])} | {_cell(row['aligner'])} "
            f"| {row['successes']} of {row['trials']} | {100 * low:.0f} to {100 * high:.0f} % "
            f"| {_cell(causes) or '-'} "
            f"| {number(row['median_position_error_m'], 100, 'cm')} "
            f"| {number(row['median_rotation_error_rad'], 180 / math.pi, '°')} "
            f"| {number(row['median_inference_s'], 1, 's')} "
            f"| {number(row['mean_simulated_s'], 1, 's')} | {number(row['mean_wall_s'], 1, 's')} "
            f"| {number(row['median_real_time_factor'], 1, '')} |"
        )
        failures += [
            f"| {_cell(row['scenario'])} | {_cell(row['aligner'])} | {failure['seed']} "
            f"| {_cell(failure['cause'])} | {_cell(failure['reason'])} |"
            for failure in row["failures"]
        ]
    if failures:
        lines += ["", "| failed | aligner | seed | cause | reason |", "|---|---|---|---|---|"]
        lines += failures
    if comparison is not None:
        head, *changed = comparison.lines()
        lines += ["", head[0].upper() + head[1:], "", *(f"- {line.strip()}" for line in changed)]
    return "\n".join(lines).rstrip() + "\n"


def _rates(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Lines of a table: successes of trials, scenarios down and aligners across."""
    aligners = list(dict.fromkeys(row["aligner"] for row in rows))
    found = {(row["scenario"], row["aligner"]): row for row in rows}
    lines = [
        "| " + " | ".join(["scenario", *map(_cell, aligners)]) + " |",
        "|" + "---|" * (1 + len(aligners)),
    ]
    for scenario in dict.fromkeys(row["scenario"] for row in rows):
        cells = [_cell(scenario)]
        for aligner in aligners:
            row = found.get((scenario, aligner))
            cells.append("-" if row is None else f"{row['successes']} of {row['trials']}")
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def _cell(text: str) -> str:
    return _printable(text).replace("|", "\\|")
