"""Tasks by name: those of this package's modules, and those that other packages install.

To add one, write a module here with `TASKS = {"name": factory}`, or state an entry point of the
group `iga_drake.tasks`. A factory, such as a subclass of `Task`, is called without arguments.
"""

from iga_drake.registry import Registry
from iga_drake.station.scenario import Scenario
from iga_drake.tasks.declared import DeclaredTask
from iga_drake.tasks.task import Task, TaskError

_REGISTRY: Registry[Task] = Registry(
    "task",
    package="iga_drake.tasks",
    attribute="TASKS",
    group="iga_drake.tasks",
    error=TaskError,
)


def task_names() -> list[str]:
    """The names that `make_task` takes, sorted."""
    return _REGISTRY.names()


def make_task(name: str) -> Task:
    """The task called `name`; `TaskError` lists the names that there are."""
    return _REGISTRY.factory(name)()


def scenario_task(scenario: Scenario) -> Task:
    """The task that a scenario declares or names. Raises `TaskError` where it is none."""
    choice = scenario.task
    if choice.declared is None:
        return make_task(choice.name)
    if choice.name in task_names():
        raise TaskError(
            f"task.name: '{choice.name}' is a task that there is already, and the scenario "
            "declares one: give it another name"
        )
    return DeclaredTask(choice.name, choice.declared)
