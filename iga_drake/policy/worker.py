"""The process in which an aligner runs beside the control loop: `python -m iga_drake.policy.worker
FD`, started by `WorkerInference` with a pipe of its own.

First comes a message with the aligner's name, its options and the demonstrations' contexts, then
one message a question; each is answered with an estimate or with an error. What an aligner prints
goes to the standard error stream. The process ends when its pipe is closed.
"""

import contextlib
import os
import signal
import sys
import threading
import time
from multiprocessing.connection import Connection
from queue import SimpleQueue
from typing import Any

from iga_drake.errors import error_text

_NICENESS = 5  # the control loop comes first


def _receive(connection: Connection, messages: "SimpleQueue[dict[str, Any]]") -> None:
    """Passes messages on, and ends the process when nobody listens any more, whatever it does."""
    while True:
        try:
            messages.put(connection.recv())
        except (EOFError, OSError):
            os._exit(0)


def main(descriptor: int) -> None:
    """Serves the questions that come through the pipe with this file descriptor."""
    # Who interrupts is meant to interrupt the process that asks, and that one ends this.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Libraries print to the descriptor, not to Python's stream.
    with contextlib.suppress(OSError):  # there may be no such streams
        os.dup2(2, 1)
    sys.stdout = sys.stderr
    os.nice(_NICENESS)
    connection = Connection(descriptor)
    messages: SimpleQueue[dict[str, Any]] = SimpleQueue()
    threading.Thread(target=_receive, args=(connection, messages), daemon=True).start()
    first = messages.get()
    aligner, contexts, failed = None, [], ""
    try:
        from iga_drake.aligners.protocol import PoseEstimate
        from iga_drake.aligners.registry import make_aligner
        from iga_drake.demonstrations.alignment import Alignment

        contexts = [
            tuple(Alignment(*alignment) for alignment in context) for context in first["contexts"]
        ]
        aligner = make_aligner(first["aligner"], **first["options"])
    except Exception as error:
        failed = error_text(error)
    while True:
        asked = messages.get()
        answer: dict[str, Any] = {"error": failed}
        if aligner is not None:
            began = time.perf_counter()
            try:
                found = aligner.align(
                    contexts[asked["waypoint"]],
                    asked["grasped"],
                    asked["target"],
                    grasped_up=asked["grasped_up"],
                    target_up=asked["target_up"],
                    seed=asked["seed"],
                )
                # Plain arrays, whatever the aligner's own types are.
                answer = {"estimate": vars(PoseEstimate.of(found))}
                answer["seconds"] = time.perf_counter() - began
            except Exception as error:
                answer = {"error": error_text(error)}
        connection.send(answer)


if __name__ == "__main__":
    main(int(sys.argv[1]))
