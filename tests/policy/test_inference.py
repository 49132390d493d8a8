"""Inference in a worker process: answers, and whatever goes wrong with it."""

import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import numpy as np
import psutil
import pytest
from outside_package import install
from policy_fakes import GRIPPER, TARGET, make_demonstrations

from iga_drake.aligners.protocol import AlignerError
from iga_drake.aligners.registry import make_aligner
from iga_drake.demonstrations.alignment import Alignment
from iga_drake.policy.inference import InferenceFailure, LocalInference, WorkerInference
from iga_drake.systems.messages import Cause

CODE = '''
import os, signal, sys, time
import numpy as np
from iga_drake.aligners.protocol import PoseEstimate


class Outside:
    """Does with each question what the seed says."""

    name = "outside"

    def __init__(self, offset=0.0):
        self.offset, self.count = offset, 0

    def align(self, context, grasped, target, *, grasped_up=None, target_up=None, seed=0):
        self.count += 1
        if seed == 1:
            time.sleep(60.0)
        if seed == 2:
            os.kill(os.getpid(), signal.SIGSEGV)
        if seed == 3:
            sys.exit(5)
        if seed == 4:
            raise ValueError("no such luck")
        if seed == 5:
            return None
        if seed == 6:
            ups = [context[0].grasped_up, context[0].target_up, grasped_up, target_up]
            raise ValueError("ways up: " + str([None if u is None else list(u) for u in ups]))
        print("a word on the way", flush=True)
        X = np.eye(4)
        X[:3, 3] = target.mean(0) + [self.offset, 0.1 * self.count, len(context)]
        return PoseEstimate(X[None], np.zeros(1), np.ones(1), (0.5, 0.25))


def broken():
    raise RuntimeError("never made")
'''


@pytest.fixture
def outside(tmp_path: Path, monkeypatch):
    monkeypatch.syspath_prepend(str(tmp_path))
    install(tmp_path, CODE, {"iga_drake.aligners": {"outside": "Outside", "broken": "broken"}})


@pytest.fixture
def worker(outside):
    contexts = make_demonstrations().contexts
    inference = WorkerInference("outside", {"offset": 2.0}, contexts)
    yield inference
    inference.close()


def ask(inference, seed: int = 0, timeout: float = 30.0):
    question = inference.start(0, GRIPPER, TARGET, seed)
    return inference.poll(question, timeout)


def test_the_answer_is_that_of_the_aligner_itself(outside, capfd):
    worker = WorkerInference("outside", {"offset": 2.0}, make_demonstrations().contexts)
    answer = ask(worker)
    worker.close()
    expected = make_aligner("outside", offset=2.0).align(
        make_demonstrations().contexts[0], GRIPPER, TARGET
    )
    np.testing.assert_array_equal(answer.estimate.poses, expected.poses)
    assert answer.estimate.familiarity.tolist() == [0.5, 0.25] and answer.seconds >= 0
    printed = capfd.readouterr()
    assert printed.out.count("a word") == 1 and "a word" in printed.err


def test_the_aligner_is_loaded_once(worker):
    heights = [ask(worker).estimate.poses[0, 1, 3] for _ in range(3)]
    np.testing.assert_allclose(np.diff(heights), 0.1)


def test_ways_up_of_context_and_question_come_to_the_aligner(outside):
    x, y, z = np.eye(3)
    context = (Alignment(GRIPPER, TARGET, target_up=y),)
    found = []
    worker = WorkerInference("outside", {}, [context])
    for inference in (worker, LocalInference(make_aligner("outside"), [context])):
        for ups in ({}, {"grasped_up": x, "target_up": z}):
            question = inference.start(0, GRIPPER, TARGET, 6, **ups)
            with pytest.raises(InferenceFailure) as failure:
                inference.poll(question, 30.0)
            found.append(str(failure.value).replace("np.float64", "").partition("ways up: ")[2])
        inference.close()
    without = "[None, [(0.0), (1.0), (0.0)], None, None]"
    told = "[None, [(0.0), (1.0), (0.0)], [(1.0), (0.0), (0.0)], [(0.0), (0.0), (1.0)]]"
    assert found == [without, told, without, told]


class _Old:
    """Written for the protocol before there were ways up."""

    name = "old"

    def align(self, context, grasped, target, *, seed=0):
        raise AssertionError("never asked")


def test_an_aligner_that_takes_no_ways_up_is_refused_at_once():
    with pytest.raises(AlignerError, match=r"'old'.*grasped_up=None.*got an unexpected keyword"):
        LocalInference(_Old(), make_demonstrations().contexts)


def test_looking_for_an_answer_does_not_wait(worker):
    ask(worker)
    question = worker.start(0, GRIPPER, TARGET, 1)
    began = time.perf_counter()
    assert worker.poll(question, 0.0) is None
    assert time.perf_counter() - began < 0.5


@pytest.mark.parametrize(
    ("seed", "reason"),
    [
        (2, f"worker process was ended by signal {int(signal.SIGSEGV)}"),
        (3, "worker process exited with status 5"),
        (4, "ValueError: no such luck"),
        (5, "returned NoneType, a PoseEstimate is expected"),
    ],
)
def test_what_goes_wrong_is_told_and_the_next_question_is_answered(worker, seed, reason):
    with pytest.raises(InferenceFailure, match=f"aligner outside: .*{reason}") as failure:
        ask(worker, seed)
    assert failure.value.cause is Cause.ALIGNMENT
    assert ask(worker).estimate.poses.shape == (1, 4, 4)


def test_a_hanging_aligner_is_ended_and_leaves_no_process(worker):
    ask(worker)
    process = psutil.Process(worker.process_id)
    assert ask(worker, 1, timeout=0.2) is None
    worker.cancel()
    assert not process.is_running() and worker.process_id is None
    assert ask(worker).estimate is not None


def test_an_answer_that_was_given_up_is_not_taken_for_another(worker):
    first = worker.start(0, GRIPPER, TARGET, 1)
    second = worker.start(0, GRIPPER, TARGET, 0)
    with pytest.raises(InferenceFailure, match="was given up"):
        worker.poll(first, 0.0)
    assert worker.poll(second, 30.0).estimate is not None


def test_an_aligner_that_cannot_be_made_is_told(outside):
    inference = WorkerInference("broken", {}, make_demonstrations().contexts)
    with pytest.raises(InferenceFailure, match="RuntimeError: never made"):
        ask(inference)
    inference.close()


def test_unknown_options_are_told(outside):
    inference = WorkerInference("outside", {"colour": "red"}, make_demonstrations().contexts)
    with pytest.raises(InferenceFailure, match=r"'colour'.*does not take them"):
        ask(inference)
    inference.close()


def test_no_worker_outlives_a_process_that_is_killed(outside, tmp_path: Path):
    code = textwrap.dedent("""
        import sys, time
        import numpy as np
        from iga_drake.policy.inference import WorkerInference
        inference = WorkerInference("outside", {}, [()])
        question = inference.start(0, np.zeros((9, 3)), np.zeros((9, 3)), 0)
        assert inference.poll(question, 30.0) is not None
        inference.start(0, np.zeros((9, 3)), np.zeros((9, 3)), 1)
        print(inference.process_id, flush=True)
        time.sleep(60.0)
    """)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    parent = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, env=environment,
        stderr=subprocess.DEVNULL,
    )  # fmt: skip
    worker = psutil.Process(int(parent.stdout.readline()))
    assert worker.is_running()
    parent.kill()
    parent.wait()
    worker.wait(timeout=10.0)


def test_a_local_aligner_gives_the_same_answer_beside_the_caller(outside):
    aligner = make_aligner("outside")
    contexts = make_demonstrations().contexts
    answers = [ask(LocalInference(aligner, contexts, beside=beside)) for beside in (True, False)]
    assert all(answer.estimate.poses[0, 2, 3] > 0.9 for answer in answers)
