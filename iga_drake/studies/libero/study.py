"""`iga evaluate libero`: LIBERO-PRO's pick-and-place suites by an aligner, in MuJoCo.

For each task the scripted expert demonstrates the unperturbed task, from its last initial states;
then the aligner does the perturbed one, from its first. Results are kept episode by episode, and
the same command goes on from there.
"""

import argparse
import json
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

from iga_drake.aligners.protocol import Aligner
from iga_drake.aligners.registry import check_aligner, make_aligner
from iga_drake.demonstrations.demonstration import DemonstrationSet
from iga_drake.demonstrations.store import MANIFEST, read_demonstrations, write_demonstrations
from iga_drake.errors import check_range, kept_on_interrupt
from iga_drake.evaluation.results import (
    ResultsStore,
    aligner_key,
    code_key,
    folder_digest,
    results_file,
    results_kept,
)
from iga_drake.files import output_folder
from iga_drake.progress import counter
from iga_drake.studies.libero.benchmark import (
    STATES,
    STEPS,
    SUITES,
    VARIANTS,
    LiberoScene,
    LiberoTask,
    libero_tasks,
    libero_versions,
)
from iga_drake.studies.libero.episode import LiberoResult, Watch, demonstrate, run_episode
from iga_drake.studies.libero.expert import ExpertError
from iga_drake.studies.libero.perception import LabelledView, UnseenError

TASKS = 10  # of each suite
DEMONSTRATIONS = 5
_TRIES = 3  # initial states of the expert for each demonstration

Row = tuple[dict[str, Any], LiberoResult]  # task, state and seed of an episode, what came of it


def _record(task: LiberoTask, count: int, folder: Path, watch: Watch) -> None:
    """Writes the expert's demonstrations of a task, from its last initial states downwards.

    States from which the expert doesn't succeed are left out. Raises `ExpertError` where too few
    are left.
    """
    scene, shown, failures = LiberoScene(task), [], []
    try:
        for state in range(STATES - 1, STATES - 1 - _TRIES * count, -1):
            try:
                shown.append(demonstrate(scene, state, watch))
            except (ExpertError, UnseenError) as failure:
                failures.append(str(failure))
            if len(shown) == count:
                break
    finally:
        scene.close()
    if len(shown) < count:
        raise ExpertError(
            f"{task.name}: {len(shown)} demonstrations of {_TRIES * count} initial states, {count} "
            f"are needed: {'; '.join(failures[:3])}"
        )
    name = f"{task.suite}/{task.name}"
    write_demonstrations(folder, DemonstrationSet(name, tuple(shown)))


def demonstrations_of(task: LiberoTask, count: int, folder: Path, watch: Watch) -> DemonstrationSet:
    """The first `count` demonstrations of an unperturbed task; recorded where the folder has none
    or fewer."""
    name = f"{task.suite}/{task.name}"
    if (folder / MANIFEST).is_file():
        shown = read_demonstrations(folder, task=name)
        if len(shown) >= count:
            return shown.first(count)
    _record(task, count, folder, watch)
    return read_demonstrations(folder, task=name)


def frames_of(folder: Path | None) -> Callable[[str], Watch]:
    """From the name of an episode to a function that writes what the cameras see, side by side, as
    `NAME-WHEN.png`; without a folder nothing is written."""

    def nothing(when: str, scene: LiberoScene, views: Sequence[LabelledView]) -> None:
        pass

    def named(name: str) -> Watch:
        def watch(when: str, scene: LiberoScene, views: Sequence[LabelledView]) -> None:
            from PIL import Image

            assert folder is not None
            folder.mkdir(parents=True, exist_ok=True)
            sheet = np.concatenate([view.color for view in views or scene.views()], axis=1)
            Image.fromarray(sheet).save(folder / f"{name}-{when}.png")

        return watch if folder is not None else nothing

    return named


def libero_table(rows: Sequence[Row]) -> str:
    """Successes by task with the causes of failures, and the whole with its interval, as text."""
    lines = [f"{'task':<52} {'success':>9}  {'steps':>5} {'s':>5}  failures"]
    for name in dict.fromkeys(row["task"] for row, _ in rows):
        lines.append(_line(name, [result for row, result in rows if row["task"] == name]))
    whole = [result for _, result in rows]
    lines.append(_line("all", whole))
    if whole:
        done = sum(result.success for result in whole)
        found = binomtest(done, len(whole)).proportion_ci(method="wilson")
        lines.append(
            f"success {done / len(whole):.2f}, 95 % (Wilson) {found.low:.2f} to {found.high:.2f}"
        )
    return "\n".join(lines)


def _line(name: str, results: Sequence[LiberoResult]) -> str:
    causes = Counter(result.cause for result in results if not result.success)
    done = [result for result in results if result.success]
    steps = f"{np.median([r.steps for r in done]):5.0f}" if done else "    -"
    seconds = np.mean([r.wall_seconds for r in results]) if results else np.nan
    words = ", ".join(f"{count} {cause}" for cause, count in causes.most_common())
    return (
        f"{name[:52]:<52} {len(done):>4} /{len(results):>3}  {steps} {seconds:5.1f}  {words}"
    ).rstrip()


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("--suite", choices=SUITES, default=SUITES[0], help="default %(default)s")
    parser.add_argument(
        "--variant", choices=VARIANTS, default="swap",
        help="perturbation of LIBERO-PRO: swap (moved objects), object (replaced ones), none; "
        "default %(default)s",
    )  # fmt: skip
    parser.add_argument("--tasks", default="", help="numbers, such as 0,3 (default: all ten)")
    parser.add_argument("--episodes", type=int, default=20, help="of each task (default 20)")
    parser.add_argument(
        "--demonstrations", type=int, default=DEMONSTRATIONS, help="of each task (default 5)"
    )
    parser.add_argument("--aligner", default="iga", help="default %(default)s")
    parser.add_argument("--seed", type=int, default=0, help="of the aligner (default 0)")
    parser.add_argument(
        "--folder", type=output_folder, default=Path("outputs/libero"),
        help="where demonstrations are kept and looked for (default %(default)s)",
    )  # fmt: skip
    parser.add_argument("--results", type=results_file, help="JSON lines: kept and gone on from")
    parser.add_argument("--frames", type=output_folder, help="folder for pictures of the episodes")
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def _tasks_asked(text: str) -> list[int]:
    if not text:
        return list(range(TASKS))
    numbers = []
    for part in text.split(","):
        ok = part.strip().isdecimal() and int(part) < TASKS
        check_range(ok, "--tasks", text, f"numbers from 0 to {TASKS - 1}, with commas")
        numbers.append(int(part))
    return numbers


def run(arguments: argparse.Namespace, aligner: Aligner | None = None) -> int:
    """Runs the episodes that aren't in the results yet and prints the table of all."""
    count, episodes = arguments.demonstrations, arguments.episodes
    check_range(
        1 <= count <= STATES // _TRIES, "--demonstrations", count, f"1 to {STATES // _TRIES}"
    )
    most = STATES if arguments.variant != "none" else STATES - _TRIES * count
    check_range(1 <= episodes <= most, "--episodes", episodes, f"1 to {most}")
    check_range(0 <= arguments.seed < 2**31, "--seed", arguments.seed, "0 to 2^31 - 1")
    numbers = _tasks_asked(arguments.tasks)
    check_aligner(arguments.aligner)
    versions = libero_versions()
    aligner = aligner or make_aligner(arguments.aligner)
    store = ResultsStore(arguments.results) if arguments.results else None
    frames = frames_of(arguments.frames)
    shown_tasks = libero_tasks(arguments.suite)
    tasks = {task.name: task for task in libero_tasks(arguments.suite, arguments.variant)}
    rows: list[Row] = []
    with (
        kept_on_interrupt(lambda: results_kept(arguments.results)),
        counter("episodes", len(numbers) * episodes) as told,
    ):
        for number in numbers:
            shown_task = shown_tasks[number]
            task = tasks[shown_task.name]
            folder = arguments.folder / arguments.suite / task.name
            shown = demonstrations_of(shown_task, count, folder, frames(f"{number}-shown"))
            key = {
                "kind": "libero",
                "suite": task.suite,
                "variant": task.variant,
                "task": task.name,
                "demonstrations": [count, folder_digest(folder)],
                "steps": STEPS[task.suite],
                "versions": versions,
                **aligner_key(aligner, arguments.aligner),
                "code": code_key(aligner),
            }
            scene = None
            for state in range(episodes):
                row = {"task": task.name, "state": state, "seed": arguments.seed}
                known = store.get({**key, **row}) if store else None
                if known is not None:
                    rows.append((row, LiberoResult(**known)))
                    told.update()
                    continue
                scene = scene or LiberoScene(task)
                watch = frames(f"{number}-{task.variant}-{state}")
                result = run_episode(scene, state, shown, aligner, seed=arguments.seed, watch=watch)
                rows.append((row, result))
                if store:
                    store.add({**key, **row}, asdict(result))
                told.update()
            if scene is not None:
                scene.close()
    if arguments.json:
        print(json.dumps([{**row, **asdict(result)} for row, result in rows], indent=2))
    else:
        print(f"{arguments.suite}_{arguments.variant}, {count} demonstrations, {arguments.aligner}")
        print(libero_table(rows))
    return 0
