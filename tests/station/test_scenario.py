import dataclasses

import pytest
import yaml
from pydrake.multibody.plant import MultibodyPlantConfig

from iga_drake.paths import diagrams_dir
from iga_drake.station.scenario import (
    Camera,
    LookAt,
    Pose,
    Scenario,
    ScenarioError,
    load_scenario,
)

SHIPPED = ("grasp", "stack", "one_of_everything")


def _load(tmp_path, text: str) -> Scenario:
    path = tmp_path / "scenario.yaml"
    path.write_text(text, encoding="utf-8")
    return load_scenario(path)


def _message(tmp_path, text: str) -> str:
    with pytest.raises(ScenarioError) as error:
        _load(tmp_path, text)
    message = str(error.value)
    assert "scenario.yaml" in message
    return message


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_scenarios_load(name):
    scenario = load_scenario(diagrams_dir() / f"{name}.yaml")
    assert scenario.plant.time_step == 0.002
    assert len(scenario.camera_names) >= 2


def test_task_scenarios_differ_in_the_task_only():
    grasp = load_scenario(diagrams_dir() / "grasp.yaml")
    stack = load_scenario(diagrams_dir() / "stack.yaml")
    assert (grasp.task.name, stack.task.name) == ("grasp", "stack")
    assert grasp.camera_names == ("camera_0", "camera_1", "camera_2")
    stack.task, stack.demonstrations = grasp.task, grasp.demonstrations
    assert stack.to_yaml() == grasp.to_yaml()


@pytest.mark.parametrize("name", SHIPPED)
def test_round_trip(tmp_path, name):
    scenario = load_scenario(diagrams_dir() / f"{name}.yaml")
    again = _load(tmp_path, scenario.to_yaml())
    assert again.to_yaml() == scenario.to_yaml()
    for field in dataclasses.fields(Scenario):
        if field.type is not MultibodyPlantConfig:  # has no equality
            assert getattr(again, field.name) == getattr(scenario, field.name)


def test_one_of_everything_states_every_option():
    data = yaml.load((diagrams_dir() / "one_of_everything.yaml").read_text(), Loader=_IgnoreTags)

    def check(value, node, where):
        if dataclasses.is_dataclass(value):
            names = [f.name for f in dataclasses.fields(value)]
        elif isinstance(value, MultibodyPlantConfig):
            names = [f.name for f in MultibodyPlantConfig.__fields__]
        else:
            return
        assert set(node) == set(names), where
        for name in names:
            check(getattr(value, name), node[name], f"{where}.{name}")

    scenario = load_scenario(diagrams_dir() / "one_of_everything.yaml")
    check(scenario, data, "scenario")
    check(scenario.cameras["front"], data["cameras"]["front"], "front")
    assert isinstance(scenario.cameras["front"].pose, LookAt)
    assert isinstance(scenario.cameras["above"].pose, Pose)


class _IgnoreTags(yaml.SafeLoader):
    pass


_IgnoreTags.add_multi_constructor("!", lambda loader, _, node: loader.construct_mapping(node))


@pytest.mark.parametrize("text", ["", "\n", "# only a comment\n", "{}"])
def test_empty_file_is_the_default(tmp_path, text):
    assert _load(tmp_path, text).to_yaml() == Scenario().to_yaml()


def test_what_is_stated_is_taken_and_the_rest_stays(tmp_path):
    scenario = _load(
        tmp_path,
        """
        plant: {time_step: 0.001}
        control: {period: 1e-2, linear_speed: 1}
        task: {name: stack}
        aligner: {options: {count: 3, color: red}}
        cameras: {left: {noise: {gaussian: false}}}
        """,
    )
    assert scenario.plant.time_step == 0.001
    assert scenario.plant.discrete_contact_approximation == "sap"
    assert scenario.control.period == 0.01
    assert scenario.control.linear_speed == 1.0
    assert scenario.aligner.options == {"count": 3.0, "color": "red"}
    assert scenario.camera_names == ("left",)
    assert not scenario.cameras["left"].noise.gaussian
    assert scenario.cameras["left"].noise.dropouts
    assert scenario.cameras["left"].intrinsics == Camera().intrinsics


@pytest.mark.parametrize(
    ("text", "key", "valid"),
    [
        ("task: {options: {}}", "options", ("name", "time_limit")),
        ("nonsense: 1", "nonsense", ("plant", "cameras", "task", "seeds")),
        ("plant: {time_stp: 0.1}", "time_stp", ("time_step", "contact_model")),
        ("cameras: {a: {nose: {}}}", "nose", ("pose", "intrinsics", "noise", "calibration")),
        ("cameras: {a: {pose: !Pose {position: [0, 0, 0]}}}", "position", ("translation", "rpy")),
        ("cameras: {a: {pose: !Poze {}}}", "!Poze", ("!LookAt", "!Pose")),
        ("3: 4", "3", ("plant",)),
    ],
)
def test_unknown_key_lists_the_valid_ones(tmp_path, text, key, valid):
    message = _message(tmp_path, text)
    assert key in message
    for name in valid:
        assert name in message


@pytest.mark.parametrize(
    ("text", "where"),
    [
        ("plant: 3", "plant"),
        ("[1, 2]", "mapping"),
        ("cameras: {a: {near: wide}}", "cameras.a.near"),
        ("cameras: {a: {intrinsics: {width: 3.5}}}", "cameras.a.intrinsics.width"),
        ("cameras: {a: }", "cameras.a"),
        ("cameras: {a: {pose: {position: [1, x, 2]}}}", "cameras.a.pose.position[1]"),
        ("cameras: {a: {pose: {position: 1}}}", "cameras.a.pose.position"),
        ("visualization: {meshcat: 1}", "visualization.meshcat"),
        ("control: {period: true}", "control.period"),
        ("control: {period: .nan}", "control.period"),
        ("aligner: {options: {a: true}}", "aligner.options.a"),
        ("demonstrations: 5", "demonstrations"),
        ("seeds: {scene: null}", "seeds.scene"),
    ],
)
def test_wrong_type_names_the_key(tmp_path, text, where):
    assert where in _message(tmp_path, text)


@pytest.mark.parametrize(
    ("text", "where"),
    [
        ("plant: {time_step: 0}", "plant.time_step"),
        ("plant: {contact_model: sticky}", "hydroelastic_with_fallback"),
        ("panda: {visuals: shiny}", "panda.visuals"),
        ("table: {size: [1, 1]}", "table.size"),
        ("table: {size: [1, 1, -1]}", "table.size"),
        ("cameras: {}", "at least one camera"),
        ("cameras: {a: {pose: {position: [1, 2]}}}", "cameras.a.pose.position"),
        ("cameras: {a: {pose: {position: [1, 2, 3], target: [1, 2, 0]}}}", "cameras.a.pose.target"),
        ("cameras: {a: {near: 4}}", "near < far"),
        ("cameras: {a: {noise: {dropout_probability: 2}}}", "dropout_probability"),
        ("cameras: {a: {calibration: {minimum: 0.1}}}", "calibration.minimum"),
        ("cameras: {a: {calibration: {rotation: 1}}}", "calibration.rotation"),
        ("fusion: {crop_lower: [9, 9, 9]}", "fusion.crop_lower"),
        ("fusion: {erosion: -1}", "fusion.erosion"),
        ("control: {joint_speed_scale: 1.5}", "control.joint_speed_scale"),
        ("time_limits: {infer: 0}", "time_limits.infer"),
        ("seeds: {scene: -1}", "seeds.scene"),
    ],
)
def test_value_out_of_range_names_the_key(tmp_path, text, where):
    assert where in _message(tmp_path, text)


def test_missing_and_broken_files(tmp_path):
    with pytest.raises(ScenarioError, match=r"nowhere\.yaml"):
        load_scenario(tmp_path / "nowhere.yaml")
    assert "YAML" in _message(tmp_path, "a: [")
    path = tmp_path / "binary.yaml"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ScenarioError, match=r"binary\.yaml"):
        load_scenario(path)
