import json

from iga_drake import cli
from iga_drake.studies.benchmark_fusion import _table


def test_times_every_contender_in_one_run(capsys):
    assert cli.main(["benchmark", "fusion", "--json", "--repetitions", "1"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert set(result) == {
        "ours, whole images",
        "ours, objects",
        "geometric labels",
        "Drake, whole images",
        "Open3D, whole images",
    }
    ours = result["ours, whole images"]
    assert ours["ratio"] == 1.0
    for name, figures in result.items():
        assert figures["count"] == 1
        assert 0 < figures["min_ms"] <= figures["median_ms"] <= figures["max_ms"]
        if "whole" in name:  # all see the same surfaces; ours drops the pixels at jumps
            assert 0.9 < figures["points"] / ours["points"] < 1.1
    assert result["geometric labels"]["points"] > 2000  # of the ball that stands
    lines = _table(result).splitlines()
    assert len(lines) == 2 + len(result)
    assert all(any(line.startswith(name) for line in lines) for name in result)
