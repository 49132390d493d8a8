"""What runs on a Ray cluster gives the same there as here: one test, as a cluster starts slowly."""

from dataclasses import replace
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
    """Two nodes of one core; every node makes shards. The episodes end for lack of time."""
    import ray
    from ray.cluster_utils import Cluster

    export_shards("train", 5, tmp_path / "here", config=SMALL, shard_size=2)
    arguments = ("grasp", "--set=task.time_limit=0.1", "--set=plant.time_step=0.01")
    trials = [
        Trial(task="grasp", scenario="grasp", arguments=arguments, aligner="expert", seed=seed)
        for seed in (3, 4)
    ]
    here = evaluate(trials)
    assert [result.cause for result in here] == ["time", "time"]

    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    node = {"num_cpus": 1, "object_store_memory": 80 * 2**20, "include_dashboard": False}
    cluster = Cluster(initialize_head=True, head_node_args=node)
    try:
        cluster.add_node(num_cpus=1, object_store_memory=80 * 2**20)
        cluster.wait_for_nodes()
        ray.init(address=cluster.address, log_to_driver=False)
        assert sum(node["Alive"] for node in ray.nodes()) == 2
        done = export_shards(
            "train", 5, tmp_path / "there", config=SMALL, shard_size=2, jobs=-1, backend="ray"
        )
        run, width = on_cluster(None)
        there = evaluate(trials, processes=width, run=run)
    finally:
        ray.shutdown()
        cluster.shutdown()
    assert done.made == 3 and contents(tmp_path / "there") == contents(tmp_path / "here")
    clock = {"wall_seconds": None, "real_time_factor": None}
    assert width == 2
    assert [replace(r, **clock) for r in there] == [replace(r, **clock) for r in here]


def test_an_address_without_a_cluster_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    import ray

    def refuse(**settings: object) -> None:
        raise ConnectionError(f"nothing at {settings['address']}")

    monkeypatch.setattr(ray, "is_initialized", lambda: False)
    monkeypatch.setattr(ray, "init", refuse)
    with pytest.raises(ClusterError, match="nothing at there:1; start one"):
        connect_cluster("there:1")
