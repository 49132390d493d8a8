import json

import pytest

from iga_drake import cli
from iga_drake.errors import IgaDrakeError
from iga_drake.studies.benchmark_ik import benchmark_ik


def test_random_poses_are_reached_and_no_limit_is_broken(capsys):
    result = benchmark_ik(count=6, seed=1)
    assert result.limits_kept
    assert result.reached == 6
    assert 0.0 < result.max_velocity_ratio <= 0.905
    assert result.min_position_margin > 0.02
    assert result.min_distance > 0.001
    assert "poses followed          6" in capsys.readouterr().out


def test_command_line_prints_json_and_repeats_itself(capsys):
    results = []
    for _ in range(2):
        assert cli.main(["benchmark", "ik", "--count", "1", "--seed", "2", "--json"]) == 0
        results.append(json.loads(capsys.readouterr().out))
    for name in ("reached", "steps", "simulated_seconds"):
        assert results[0][name] == results[1][name]


def test_no_poses_are_refused():
    with pytest.raises(IgaDrakeError, match="count 0"):
        benchmark_ik(count=0)
