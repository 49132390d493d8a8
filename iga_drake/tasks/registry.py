"""The tasks by name."""

from iga_drake.tasks.grasp import Grasp
from iga_drake.tasks.stack import Stack
from iga_drake.tasks.task import Task, TaskError

TASKS: dict[str, type[Task]] = {task.name: task for task in (Grasp, Stack)}


def make_task(name: str) -> Task:
    """The task called `name`; `TaskError` lists the names that there are."""
    if name not in TASKS:
        raise TaskError(f"unknown task '{name}': the tasks are {', '.join(sorted(TASKS))}")
    return TASKS[name]()
