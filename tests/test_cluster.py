"""What runs on a Ray cluster gives the same there as here: one test, as a cluster starts slowly."""

from pathlib import Path

import pytest

from iga_drake.cluster import ClusterError, connect_cluster
from iga_drake.dataset.export import export_shards
from iga_drake.dataset.samples import SampleConfig
from iga_drake.evaluation.task_success import Trial, evaluate, on_cluster

SMALL = SampleConfig(
    surface_points=400, cloud_points=48, least_seen=8, deformations=(1.0, 0.0, 0.0, 0.0)
)


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_a_cluster_gives_the_same_samples_and_trials(tmp_path: Path, monkeypatch) -> None:
    """Of one node that runs two processes. The episode ends for lack of time."""
    import ray

    export_shards("train", 3, tmp_path / "here", config=SMALL, shard_size=2)
    late = ("grasp", "--set=task.time_limit=0.1", "--set=plant.time_step=0.01")
    trials = [
        Trial(task="grasp", scenario="grasp", arguments=arguments, aligner="expert", seed=3)
        for arguments in (late, ("nowhere.yaml",))
    ]
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    monkeypatch.setenv("RAY_worker_niceness", "0")  # else other tests go first
    try:
        ray.init(
            address="local",  # another one may run on this machine
            num_cpus=2,
            object_store_memory=80 * 2**20,
            include_dashboard=False,
            log_to_driver=False,
        )
        done = export_shards(
            "train", 3, tmp_path / "there", config=SMALL, shard_size=2, jobs=-1, backend="ray"
        )
        run, width = on_cluster(None)
        there = evaluate(trials, processes=width, run=run)
    finally:
        ray.shutdown()
    assert done.made == 2 and contents(tmp_path / "there") == contents(tmp_path / "here")
    assert width == 2
    assert [result.cause for result in there] == ["time", "error"]
    assert there[0].simulated_seconds == pytest.approx(0.1, abs=0.05)
    assert "nowhere.yaml: no such file" in there[1].reason


def test_an_address_without_a_cluster_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    import ray

    def refuse(**settings: object) -> None:
        raise ConnectionError(f"nothing at {settings['address']}")

    monkeypatch.setattr(ray, "is_initialized", lambda: False)
    monkeypatch.setattr(ray, "init", refuse)
    with pytest.raises(ClusterError, match="nothing at there:1; start one"):
        connect_cluster("there:1")
