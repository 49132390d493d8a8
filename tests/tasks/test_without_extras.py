"""What the demo's set-up has is enough for every shipped task."""

import subprocess
import sys

from iga_drake import errors

SCENES = """
import sys

sys.modules.update(dict.fromkeys({names!r}))  # None: not there
from iga_drake.tasks.registry import make_task

for task in {tasks!r}:
    assert make_task(task).scene(0).objects
"""
TASKS = (
    "grasp", "hang", "insert", "pick_and_insert", "pick_and_stack", "pour", "stack", "sweep",
)  # fmt: skip


def test_scenes_are_made_without_optional_packages() -> None:
    script = SCENES.format(names=sorted(errors._EXTRAS), tasks=TASKS)
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr[-2000:]
