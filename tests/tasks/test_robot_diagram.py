"""Every option of a scenario goes into a diagram that runs."""

from iga_drake.aligners.registry import make_aligner
from iga_drake.demonstrations.demonstration import read_demonstrations
from iga_drake.paths import diagrams_dir
from iga_drake.policy.motion import Phase
from iga_drake.station.scenario import load_scenario
from iga_drake.tasks.episode import demonstrations_path
from iga_drake.tasks.registry import make_task
from iga_drake.tasks.robot_diagram import build_episode_diagram
from iga_drake.viewing.meshcat import start_meshcat


def test_one_of_everything_becomes_a_whole_diagram_and_observes() -> None:
    scenario = load_scenario(diagrams_dir() / "one_of_everything.yaml")
    task = make_task(scenario.task.name)
    episode = build_episode_diagram(
        scenario,
        task=task,
        scene=task.scene(0 + scenario.seeds.scene, "test"),
        seed=0,
        aligner=make_aligner(scenario.aligner.name, **scenario.aligner.options),
        demonstrations=read_demonstrations(demonstrations_path(scenario), task=task.name),
        meshcat=start_meshcat(scenario.visualization),
    )
    episode.simulator.AdvanceTo(1.0)
    memory = episode.policy_memory()
    assert len(memory.target_points) > 500
    assert memory.status.phase not in (Phase.REFUSED, Phase.FAILED)
