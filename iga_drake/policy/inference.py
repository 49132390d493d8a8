"""Where the aligner runs: in this process, or in a worker process of its own.

The policy asks with `start`, looks for the answer with `poll`, and gives up with `cancel`. Whatever
an aligner does (raise, return nonsense, hang, crash, exit) comes back as an `InferenceFailure` with
a reason; this process and its control loop live on.
"""

import contextlib
import os
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from queue import SimpleQueue
from typing import Any, Protocol

import numpy as np

from iga_drake.aligners.protocol import Aligner, PoseEstimate, check_aligns
from iga_drake.demonstrations.alignment import Alignment
from iga_drake.errors import error_text
from iga_drake.policy.motion import Refusal
from iga_drake.systems.messages import Cause

Contexts = Sequence[tuple[Alignment, ...]]


@dataclass(frozen=True)
class InferenceAnswer:
    """A pose estimate and what it took."""

    estimate: PoseEstimate
    seconds: float  # wall-clock time that the aligner took


class InferenceFailure(Refusal):
    """There is no answer; the message is the reason."""

    def __init__(self, reason: str, cause: Cause = Cause.ALIGNMENT) -> None:
        super().__init__(reason, cause)


class Inference(Protocol):
    """Answers one question at a time about the waypoints of one set of demonstrations."""

    name: str

    def start(
        self,
        waypoint: int,
        grasped: np.ndarray,
        target: np.ndarray,
        seed: int,
        *,
        grasped_up: np.ndarray | None = None,
        target_up: np.ndarray | None = None,
    ) -> int:
        """Asks where the grasped cloud (P, 3) in E has to go, given the target cloud (Q, 3) in W
        and the context of a waypoint; `grasped_up` in E and `target_up` in W (3,) are the objects'
        ways up, None where unknown. Returns the question's number and never waits; an earlier
        question without an answer is given up."""
        ...

    def poll(self, question: int, timeout: float) -> InferenceAnswer | None:
        """The answer, waiting for it up to `timeout` (s, wall clock), or None if it isn't there.

        Raises `InferenceFailure` where there will be none.
        """
        ...

    def cancel(self) -> None:
        """Gives up whatever is under way."""
        ...

    def close(self) -> None:
        """Ends what runs. A later `start` begins anew."""
        ...


class LocalInference:
    """An aligner given as an object, in this process.

    Args:
        aligner: the object.
        contexts: the alignments of the demonstrations, for each waypoint.
        beside: runs it in a thread beside the caller's, for a policy that doesn't wait. Otherwise
            `poll` runs it and returns when it is done. Neither can be ended early.

    Raises `AlignerError` for an aligner that can't be asked as the protocol says.
    """

    def __init__(self, aligner: Aligner, contexts: Contexts, *, beside: bool = False) -> None:
        check_aligns(aligner, aligner.name)
        self.name = aligner.name
        self._aligner = aligner
        self._contexts = contexts
        self._beside = beside
        self._question = 0
        self._run: Callable[[], None] | None = None
        self._done = threading.Event()
        self._result: InferenceAnswer | InferenceFailure | None = None

    def start(
        self,
        waypoint: int,
        grasped: np.ndarray,
        target: np.ndarray,
        seed: int,
        *,
        grasped_up: np.ndarray | None = None,
        target_up: np.ndarray | None = None,
    ) -> int:
        self._question += 1
        question, done = self._question, threading.Event()
        self._done, self._result = done, None

        def run() -> None:
            began = time.perf_counter()
            result: InferenceAnswer | InferenceFailure
            try:
                found = self._aligner.align(
                    self._contexts[waypoint],
                    grasped,
                    target,
                    grasped_up=grasped_up,
                    target_up=target_up,
                    seed=seed,
                )
                estimate = PoseEstimate.of(found)
                result = InferenceAnswer(estimate, time.perf_counter() - began)
            except KeyboardInterrupt:
                raise
            except BaseException as error:
                result = InferenceFailure(f"aligner {self.name}: {error_text(error)}")
            if question == self._question:
                self._result = result
            done.set()

        self._run = run
        if self._beside:
            threading.Thread(target=run, daemon=True, name=f"aligner {self.name}").start()
        return question

    def poll(self, question: int, timeout: float) -> InferenceAnswer | None:
        if question != self._question:
            raise InferenceFailure(f"aligner {self.name}: question {question} was given up")
        if not self._beside and self._run is not None and not self._done.is_set():
            self._run()
        if not self._done.wait(max(0.0, timeout)):
            return None
        assert self._result is not None
        if isinstance(self._result, InferenceFailure):
            raise self._result
        return self._result

    def cancel(self) -> None:
        self._question += 1

    def close(self) -> None:
        self.cancel()


class WorkerInference:
    """An aligner by name, in a worker process of its own.

    The worker loads the aligner and the contexts once, when this object is made, beside whatever
    the caller does next. It is ended when a question is given up, when it dies it is found out at
    the next `poll`; the next `start` begins a new one. It ends by itself when this process does.

    Args:
        aligner: the name in the registry.
        options: what the aligner lets one choose.
        contexts: the alignments of the demonstrations, for each waypoint.
    """

    def __init__(self, aligner: str, options: Mapping[str, Any], contexts: Contexts) -> None:
        self.name = aligner
        self._options = dict(options)
        self._contexts = [
            [(a.grasped, a.target, a.grasped_up, a.target_up) for a in context]
            for context in contexts
        ]
        self._question = 0
        self._process: subprocess.Popen | None = None
        self._connection: Connection | None = None
        self._pending = False
        self._outbox: SimpleQueue[dict[str, Any] | None] = SimpleQueue()
        self._begin()

    def _begin(self) -> None:
        mine, theirs = Pipe()
        environment = dict(os.environ)
        environment["PYTHONPATH"] = os.pathsep.join(path for path in sys.path if path)
        # One core stays with the control loop.
        threads = max(1, (os.cpu_count() or 2) - 1)
        environment.setdefault("OMP_NUM_THREADS", str(threads))
        self._process = subprocess.Popen(
            [sys.executable, "-m", "iga_drake.policy.worker", str(theirs.fileno())],
            pass_fds=[theirs.fileno()],
            stdin=subprocess.DEVNULL,
            env=environment,
        )
        theirs.close()
        self._connection = mine
        self._finalizer = weakref.finalize(self, _end, self._process, mine)
        self._outbox = SimpleQueue()
        self._outbox.put(
            {"aligner": self.name, "options": self._options, "contexts": self._contexts}
        )
        threading.Thread(target=_send, args=(mine, self._outbox), daemon=True).start()

    @property
    def process_id(self) -> int | None:
        """The worker's process id; None while there is no worker."""
        return None if self._process is None else self._process.pid

    def start(
        self,
        waypoint: int,
        grasped: np.ndarray,
        target: np.ndarray,
        seed: int,
        *,
        grasped_up: np.ndarray | None = None,
        target_up: np.ndarray | None = None,
    ) -> int:
        self._question += 1
        if self._pending or (self._process is not None and self._process.poll() is not None):
            self.close()
        if self._process is None:
            self._begin()
        self._pending = True
        self._outbox.put(
            {
                "waypoint": waypoint,
                "grasped": np.asarray(grasped),
                "target": np.asarray(target),
                "grasped_up": grasped_up,
                "target_up": target_up,
                "seed": seed,
            }
        )
        return self._question

    def poll(self, question: int, timeout: float) -> InferenceAnswer | None:
        if question != self._question or not self._pending or self._connection is None:
            raise InferenceFailure(f"aligner {self.name}: question {question} was given up")
        try:
            if not self._connection.poll(max(0.0, timeout)):
                return None
            answer = self._connection.recv()
        except (EOFError, OSError):
            reason = self._death()
            self.close()
            raise InferenceFailure(f"aligner {self.name}: {reason}") from None
        self._pending = False
        if "error" in answer:
            raise InferenceFailure(f"aligner {self.name}: {answer['error']}")
        return InferenceAnswer(PoseEstimate(**answer["estimate"]), answer["seconds"])

    def _death(self) -> str:
        """How the worker ended, in words."""
        assert self._process is not None
        try:
            code = self._process.wait(timeout=1.0)
        except subprocess.TimeoutExpired:
            return "its worker process closed the pipe"
        if code < 0:
            return f"its worker process was ended by signal {-code}"
        return f"its worker process exited with status {code}"

    def cancel(self) -> None:
        self._question += 1
        if self._pending:
            self.close()

    def close(self) -> None:
        self._pending = False
        if self._process is not None:
            self._outbox.put(None)
            self._finalizer()
        self._process = self._connection = None


def _send(connection: Connection, outbox: "SimpleQueue[dict[str, Any] | None]") -> None:
    """Sends what is put into `outbox` until None comes: a full pipe keeps nobody else waiting."""
    while (message := outbox.get()) is not None:
        # A worker that can't take it has died; `poll` finds out.
        with contextlib.suppress(OSError, TypeError):  # the latter: closed while it sends
            connection.send(message)


def _end(process: subprocess.Popen, connection: Connection) -> None:
    """Ends a worker at once; it has nothing to save."""
    connection.close()
    process.kill()
    process.wait()
