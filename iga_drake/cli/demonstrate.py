"""`iga demonstrate`: the scripted expert records demonstrations."""

import argparse
import multiprocessing
import os
import signal
import threading
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import TYPE_CHECKING

from iga_drake.cli.options import seed
from iga_drake.cli.scenarios import add_scenario_arguments, scenario_of
from iga_drake.cli.status import SUCCESS, CommandError
from iga_drake.errors import kept_on_interrupt
from iga_drake.files import output_folder

if TYPE_CHECKING:
    from iga_drake.demonstrations.demonstration import Demonstration
    from iga_drake.demonstrations.recording import Recording

MOST = 10_000
_ATTEMPTS = 4  # of one process: Drake keeps some 60 MB of every diagram with Python's systems


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `iga demonstrate`."""
    add_scenario_arguments(parser)
    parser.add_argument("--count", type=int, default=5, help="demonstrations to keep")
    parser.add_argument(
        "--out", type=output_folder, required=True, metavar="DIR", help="a new folder"
    )
    parser.add_argument(
        "--overwrite", action="store_true", help="replace the demonstrations that are in DIR"
    )
    parser.add_argument("--seed", type=seed, default=0, help="seed of the first attempt")


def run(arguments: argparse.Namespace) -> int:
    """Records and writes them, or goes on with a recording that was interrupted; nothing of
    somebody else's is overwritten."""
    from iga_drake.demonstrations.recording import Recording
    from iga_drake.demonstrations.store import MANIFEST, check_replaceable, write_demonstrations
    from iga_drake.tasks.episode import record_demonstrations
    from iga_drake.tasks.registry import scenario_task
    from iga_drake.version import code_version

    if not 1 <= arguments.count <= MOST:
        raise CommandError(f"--count {arguments.count}: 1 to {MOST} demonstrations")
    scenario = scenario_of(arguments)
    task = scenario_task(scenario).name
    check_replaceable(arguments.out)  # before minutes of recording
    if (arguments.out / MANIFEST).exists() and not arguments.overwrite:
        raise CommandError(
            f"{arguments.out}: holds demonstrations, which are not overwritten: name another "
            "folder, or add --overwrite"
        )
    key = {"scenario": scenario.digest, "seed": arguments.seed, "code": code_version()}
    recording = Recording(arguments.out, task=task, key=key)
    pool = ProcessPoolExecutor(
        1,
        multiprocessing.get_context("spawn"),
        initializer=_end_with_parent,
        max_tasks_per_child=_ATTEMPTS,
    )

    def attempt(seed: int) -> "Demonstration | None":
        try:
            pool.submit(_attempt, arguments, recording, seed).result()
        except BrokenProcessPool as error:
            raise CommandError(
                f"seed {seed}: the process of the attempt ended at once (killed, or out of "
                "memory?): the same command goes on from there"
            ) from error
        return recording.get(seed)

    try:
        with kept_on_interrupt(
            lambda: f"{recording.kept} demonstrations are kept, the same command goes on from there"
        ):
            demonstrations = record_demonstrations(
                scenario,
                count=arguments.count,
                first_seed=arguments.seed,
                recording=recording,
                attempt=attempt,
            )
    finally:
        for process in multiprocessing.active_children():
            process.kill()
        pool.shutdown(cancel_futures=True)
    write_demonstrations(arguments.out, demonstrations)
    recording.end()
    print(f"{len(demonstrations)} demonstrations of '{demonstrations.task}' in {arguments.out}")
    return SUCCESS


def _attempt(arguments: argparse.Namespace, recording: "Recording", seed: int) -> None:
    """One attempt, kept in the recording."""
    from iga_drake.tasks.episode import attempt_demonstration

    recording.add(seed, attempt_demonstration(scenario_of(arguments), seed))


def _end_with_parent() -> None:
    """Ends this process as soon as the one that started it does; Ctrl-C is that one's matter."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
