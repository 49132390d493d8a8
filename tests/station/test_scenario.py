import dataclasses
import re
import tempfile
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from pydrake.multibody.plant import MultibodyPlantConfig

from iga_drake.paths import diagrams_dir
from iga_drake.station.cameras.rgbd import LookAt, Pose, RgbdCamera
from iga_drake.station.scenario import (
    Scenario,
    ScenarioError,
    _fields,
    load_scenario,
)

SHIPPED = (
    "grasp", "stack", "hang", "insert", "pour", "sweep", "pick_and_stack", "pick_and_insert",
    "field", "hardware", "one_of_everything", "ycb_fruit",
)  # fmt: skip
# Time steps (s) other than the default.
TIME_STEPS = {"pour": 0.0025, "sweep": 0.005, "pick_and_stack": 0.004, "pick_and_insert": 0.004}


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
    assert scenario.plant.time_step == TIME_STEPS.get(name, 0.002)
    assert len(scenario.camera_names) >= 2


def test_task_scenarios_differ_in_the_task_only():
    grasp = load_scenario(diagrams_dir() / "grasp.yaml")
    stack = load_scenario(diagrams_dir() / "stack.yaml")
    assert (grasp.task.name, stack.task.name) == ("grasp", "stack")
    assert grasp.camera_names == ("camera_0", "camera_1", "camera_2")
    stack.task, stack.demonstrations = grasp.task, grasp.demonstrations
    assert stack.to_yaml() == grasp.to_yaml()


@pytest.mark.parametrize("name", ["grasp", "stack"])
def test_field_adds_clutter_and_nothing_else(name):
    plain, field = load_scenario(name), load_scenario(name, "field")
    assert not plain.clutter.in_images and not plain.clutter.neighbours
    assert (field.clutter.ring, field.clutter.stray) == (0.06, 0.05)
    field.clutter = plain.clutter
    assert field.to_yaml() == plain.to_yaml()


@pytest.mark.parametrize("name", SHIPPED)
def test_round_trip(tmp_path, name):
    scenario = load_scenario(diagrams_dir() / f"{name}.yaml")
    again = _load(tmp_path, scenario.to_yaml())
    assert again.to_yaml() == scenario.to_yaml()
    for field in dataclasses.fields(Scenario):
        # Drake's own structs have no equality.
        if field.type is not MultibodyPlantConfig and field.name != "lcm_buses":
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


def test_hardware_keeps_the_task_and_its_cameras():
    plain, real = load_scenario("grasp"), load_scenario("grasp", "hardware")
    assert real.station == "hardware"
    assert real.lcm_buses["default"].lcm_url.startswith("udpm://")
    assert (real.task, real.cameras) == (plain.task, plain.cameras)
    assert 1 / real.control.period == 200


def test_drivers_are_checked(tmp_path):
    for text, reason in (
        ("model_drivers: {panda: {lcm_bus: robot}}", "lcm_bus: 'robot' .* one of: default"),
        ("lcm_buses: {robot: {}}", "lcm_bus: 'default' .* one of: robot"),
        ("model_drivers: {iiwa: {}}", "one driver, that of 'panda'"),
        ("model_drivers: {panda: {control_mode: torque}}", "'torque' .* position, velocity"),
        ("model_drivers: {panda: {expiry: 9}}", "model_drivers.panda.expiry"),
        ("hardware: {camera_bus: usb}", "hardware.camera_bus: 'usb' .* one of: default"),
        ("lcm_buses: {default: {url: x}}", "unknown key 'url'"),
        ("hardware: {boot_limit: -1}", "hardware.boot_limit"),
    ):
        assert re.search(reason, _message(tmp_path, text)), text


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
        cameras: {left: {noise: {disparity: 0.1}}, right: {noisy: false}}
        """,
    )
    assert scenario.plant.time_step == 0.001
    assert scenario.plant.discrete_contact_approximation == "sap"
    assert scenario.control.period == 0.01
    assert scenario.control.linear_speed == 1.0
    assert scenario.aligner.options == {"count": 3.0, "color": "red"}
    assert scenario.camera_names == ("left", "right")
    assert scenario.cameras["left"].noise.disparity == 0.1
    assert scenario.cameras["left"].noise.quantum == RgbdCamera().noise.quantum
    assert not scenario.cameras["right"].noisy
    assert scenario.cameras["left"].intrinsics == RgbdCamera().intrinsics


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
        ("cameras: {}", "1 to 32 cameras"),
        ("cameras: {a: {pose: {position: [1, 2]}}}", "cameras.a.pose.position"),
        ("cameras: {a: {pose: {position: [1, 2, 3], target: [1, 2, 0]}}}", "cameras.a.pose.target"),
        ("cameras: {a: {near: 4}}", "near < far"),
        ("cameras: {a: {noise: {edge_lost: 2}}}", "cameras.a.noise.edge_lost"),
        ("cameras: {a: {frame_period: 0}}", "cameras.a.frame_period"),
        ("cameras: {a: {calibration: {minimum: 0.1}}}", "calibration.minimum"),
        ("cameras: {a: {calibration: {rotation: 1}}}", "calibration.rotation"),
        ("fusion: {crop_lower: [9, 9, 9]}", "fusion.crop_lower"),
        ("clutter: {stray: 1}", "clutter.stray"),
        ("fusion: {erosion: -1}", "fusion.erosion"),
        ("differential_ik: {velocity_scale: 1.5}", "differential_ik.velocity_scale"),
        ("policy: {infer_limit: 0}", "policy.infer_limit"),
        ("policy: {inference: telepathy}", "lockstep, delay, concurrent"),
        ("differential_ik: {horizon: 0.005}", "at least the period of the commands, 0.01 s"),
        ("supervisor: {torque_limit: [1, 2]}", "supervisor.torque_limit"),
        ("supervisor: {workspace_lower: [1, 1, 1]}", "supervisor.workspace_lower"),
        ("planning: {table_distance: -1}", "planning.table_distance"),
        ("fusion: {maximum_age: 0}", "fusion.maximum_age"),
        ("cameras: {a: {far: 40}}", "what the renderer can do"),
        ("visualization: {port: 80}", "visualization.port"),
        ("context_size: 0", "context_size"),
        ("seeds: {scene: -1}", "seeds.scene"),
    ],
)
def test_value_out_of_range_names_the_key(tmp_path, text, where):
    assert where in _message(tmp_path, text)


# Every number of the schema by its key, and what users mistake: units, percent, signs.
def _numbers(value, where="") -> list[str]:
    fields = _fields(type(value))
    if fields is not None:
        dot = f"{where}." if where else ""
        return [key for f in fields for key in _numbers(getattr(value, f), f"{dot}{f}")]
    if isinstance(value, dict):
        return [key for k, v in value.items() for key in _numbers(v, f"{where}.{k}")]
    if isinstance(value, list):
        return [f"{where}[]"]
    return [where] if isinstance(value, int | float) and not isinstance(value, bool) else []


NUMBERS = _numbers(load_scenario("one_of_everything"))
WILD = [-1e300, -1.0, 1e9, 1e300, "7000", None, [], {}, "nan", ".inf", "1e400", "9" * 5000]


@pytest.mark.parametrize("key", NUMBERS)
def test_every_number_has_an_upper_bound_and_is_named(key: str):
    name = key.removesuffix("[]")
    for value in (1e300, -1e300):
        text = f"[{value}, {value}, {value}]" if key.endswith("[]") else f"{value}"
        with pytest.raises(ScenarioError) as error:
            load_scenario("one_of_everything", overrides=[f"{name}={text}"])
        assert name.rpartition(".")[0] in str(error.value) and len(str(error.value)) < 400


@given(st.sampled_from(NUMBERS), st.sampled_from(WILD) | st.floats() | st.integers())
def test_any_value_is_accepted_within_its_bounds_or_refused_by_name(key: str, value):
    text = str(value).lower() if value is None or isinstance(value, float) else f"{value}"
    try:
        scenario = load_scenario("grasp", overrides=[f"{key.removesuffix('[]')}={text}"])
    except ScenarioError as error:
        assert len(str(error)) < 2000
        return
    assert load_scenario("grasp").to_yaml() != "" and scenario.to_yaml() != ""


NODES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(
        st.sampled_from(["task", "name", "cameras", "fusion", "policy", "_tag", "a"]), inner,
        max_size=3,
    ),
    max_leaves=8,
)  # fmt: skip


@given(NODES)
def test_any_file_is_read_or_refused(node):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scenario.yaml"
        path.write_text(yaml.safe_dump(node))
        try:
            load_scenario(path)
        except ScenarioError as error:
            assert str(path) in str(error) and len(str(error)) < 2500


@pytest.mark.parametrize(
    "text",
    [
        "[" * 1500,
        "task: {name: " + "9" * 5000 + "}",
        "fusion: {voxel_size: " + "9" * 5000 + "}",
        "a: &a [*a]",
        "task: &a {name: *a}",
        "x" * 90_000 + ": 1",
        "task: {name: !!python/object/apply:os.system [ls]}",
        "? [1, 2]\n: 3",
        "task: {name: " + "y" * 50_000 + ", time_limit: z}",
        "- " * 3000,
    ],
)
def test_files_that_are_too_much_are_refused_in_few_words(tmp_path, text):
    assert len(_message(tmp_path, text)) < 2500


def test_few_lines_that_stand_for_many_are_read_quickly(tmp_path):
    lines = ["  - &a0 [lol, lol, lol, lol, lol, lol, lol, lol, lol]"]
    lines += [f"  - &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]" for n in range(1, 30)]
    message = _message(tmp_path, "task:\n  name:\n" + "\n".join(lines))
    assert "task.name: expected str, found list" in message and len(message) < 1000


def test_a_large_file_is_not_read(tmp_path):
    path = tmp_path / "scenario.yaml"
    path.write_bytes(b"#" * 2_000_000)
    with pytest.raises(ScenarioError, match="2000000 bytes, a scenario has at most 1000000"):
        load_scenario(path)


def test_missing_and_broken_files(tmp_path):
    with pytest.raises(ScenarioError, match=r"nowhere\.yaml"):
        load_scenario(tmp_path / "nowhere.yaml")
    assert "YAML" in _message(tmp_path, "a: [")
    path = tmp_path / "binary.yaml"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ScenarioError, match=r"binary\.yaml"):
        load_scenario(path)


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ("task: {name: grasp}\ncontrol: {}\ntask: {name: stack}", r"'task' .* lines 1 and 3"),
        ("control: {period: 0.01, period: 0.02}", r"'control\.period' is stated twice"),
        ("cameras: {a: {}, a: {}}", r"'cameras\.a' is stated twice"),
        ("cameras: {a: {pose: !LookAt {target: [0, 0, 0], target: [1, 0, 0]}}}", "target"),
    ],
)
def test_a_key_stated_twice_is_refused(tmp_path, text, key):
    with pytest.raises(ScenarioError, match=f"scenario.yaml: key .*{key}"):
        _load(tmp_path, text)


def test_later_files_and_settings_have_the_last_word(tmp_path):
    first, second = tmp_path / "a.yaml", tmp_path / "b.yaml"
    first.write_text("control: {linear_speed: 0.1, angular_speed: 0.5}\ncameras: {a: {}, b: {}}")
    second.write_text("control: {linear_speed: 0.3}\ncameras: {c: {near: 0.4}}")
    scenario = load_scenario(first, second)
    assert (scenario.control.linear_speed, scenario.control.angular_speed) == (0.3, 0.5)
    assert scenario.camera_names == ("c",)
    changed = load_scenario(
        first,
        second,
        overrides=["control.linear_speed=0.2", "cameras.c.far=2.5", "task.name=stack",
                   "fusion.crop_lower=[0, -1, 0]"],
    )  # fmt: skip
    assert changed.control.linear_speed == 0.2
    assert (changed.cameras["c"].near, changed.cameras["c"].far) == (0.4, 2.5)
    assert changed.task.name == "stack" and changed.fusion.crop_lower == [0.0, -1.0, 0.0]
    assert scenario.control.linear_speed == 0.3, "the first result is left as it was"


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("control.linear_sped=1", "linear_sped.*valid keys: period, linear_speed"),
        ("control.linear_speed=fast", "control.linear_speed: expected float"),
        ("control.linear_speed=-1", "control.linear_speed: -1.0 is out of range"),
        ("control.linear_speed", "expected key.path=value"),
        ("=3", "expected key.path=value"),
        ("control.=3", "expected key.path=value"),
        ("control.period=[", "not valid YAML"),
    ],
)
def test_bad_settings_are_named(override, message):
    with pytest.raises(ScenarioError, match=message):
        load_scenario("grasp", overrides=[override])


def test_the_digest_is_of_what_is_said_not_of_the_file(tmp_path):
    texts = {
        "a": "control: {linear_speed: 0.1}", "b": "# the same\ncontrol:\n  linear_speed: 1e-1\n",
        "c": "control: {linear_speed: 0.11}",
    }  # fmt: skip
    digests = {}
    for name, text in texts.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "same.yaml").write_text(text)
        digests[name] = load_scenario(tmp_path / name / "same.yaml").digest
    assert digests["a"] == digests["b"] != digests["c"]


def test_names_of_shipped_files_are_found_and_unknown_ones_listed():
    assert load_scenario("stack").task.name == load_scenario("stack.yaml").task.name == "stack"
    with pytest.raises(ScenarioError, match="name a YAML file or one of: field, grasp"):
        load_scenario("sweep_the_floor")
