"""Objects that others describe: they have their size and mass, fall, rest, or are refused."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from pydrake.geometry import Box
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import AddMultibodyPlant, CoulombFriction, MultibodyPlantConfig
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from iga_drake.station.contract import StationError
from iga_drake.station.panda.model import add_panda
from iga_drake.station.simulated.model_files import (
    add_object,
    model_shape,
    names_the_world,
    read_model,
)
from iga_drake.station.simulated.scene import SceneObject
from iga_drake.tasks.snapshots import TABLE, read_snapshot

EDGE, MASS = 0.04, 0.1
INERTIA = MASS * EDGE**2 / 6
_INERTIAL = f"""<inertial><mass>{MASS}</mass><inertia>
<ixx>{INERTIA}</ixx><iyy>{INERTIA}</iyy><izz>{INERTIA}</izz></inertia></inertial>"""
_PLAIN = f"<box><size>{EDGE} {EDGE} {EDGE}</size></box>"


def _link(geometry: str, name: str = "cube", inertial: str = _INERTIAL) -> str:
    return f"""<link name="{name}">{inertial}
<visual name="look"><geometry>{geometry}</geometry></visual>
<collision name="body"><geometry>{geometry}</geometry></collision></link>"""


def _sdf(*parts: str) -> str:
    return f'<sdf version="1.9"><model name="thing">{"".join(parts)}</model></sdf>'


def _mesh(uri: str) -> str:
    return f"<mesh><uri>{uri}</uri></mesh>"


def _urdf(uri: str) -> str:
    mesh = f'<geometry><mesh filename="{uri}"/></geometry>'
    return f"""<robot name="thing"><link name="cube"><inertial><mass value="{MASS}"/>
<inertia ixx="{INERTIA}" iyy="{INERTIA}" izz="{INERTIA}" ixy="0" ixz="0" iyz="0"/></inertial>
<visual>{mesh}</visual><collision name="body">{mesh}</collision></link></robot>"""


TWO_LINKS = _sdf(
    _link(_PLAIN, "lower"),
    _link(_PLAIN, "upper").replace('"upper">', f'"upper"><pose>0 0 {EDGE} 0 0 0</pose>', 1),
    '<joint name="glue" type="fixed"><parent>lower</parent><child>upper</child></joint>',
)
DIRECTIVES = """directives:
- add_model: {name: below, file: plain.sdf}
- add_model: {name: above, file: "package://our_models/plain.sdf"}
- add_weld:
    parent: below::cube
    child: above::cube
    X_PC: {translation: [0, 0, 0.04]}
"""
# File name -> text; all are the cube, or two of them, one on the other.
GOOD = {
    "plain.sdf": _sdf(_link(_PLAIN)),
    "relative.sdf": _sdf(_link(_mesh("cube.obj"))),
    "without_normals.sdf": _sdf(_link(_mesh("bare.obj"))),
    "stl.sdf": _sdf(_link(_mesh("cube.stl"))),
    "glb.sdf": _sdf(_link(_mesh("cube.glb"))),
    "include.sdf": _sdf("<include><name>inner</name><uri>relative.sdf</uri></include>"),
    "prefix.sdf": _sdf(_link(_PLAIN)).replace(
        "</geometry></collision>",
        "</geometry><drake:proximity_properties><drake:mu_dynamic>0.7</drake:mu_dynamic>"
        "</drake:proximity_properties></collision>",
    ),
    "package.urdf": _urdf("package://our_models/cube.obj"),
    "relative.urdf": _urdf("cube.stl"),
    "two_links.sdf": TWO_LINKS,
    "directives.dmd.yaml": DIRECTIVES,
}
DOUBLE = ("two_links.sdf", "directives.dmd.yaml")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A package with a name that needs care in URIs."""
    folder = tmp_path_factory.mktemp("of a user ä#") / "our_models"
    folder.mkdir()
    cube = trimesh.creation.box((EDGE, EDGE, EDGE))
    cube.export(folder / "cube.obj", include_normals=True)
    cube.export(folder / "cube.stl")
    cube.export(folder / "cube.glb")
    bare = trimesh.exchange.obj.export_obj(cube, include_normals=False)
    (folder / "bare.obj").write_text(f"mtllib bare.mtl\nusemtl red\n{bare}")
    (folder / "bare.mtl").write_text("newmtl red\nKd 1 0 0\n")
    for name, text in GOOD.items():
        (folder / name).write_text(text)
    return folder


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


@pytest.mark.parametrize("name", GOOD)
def test_every_kind_has_its_size_mass_and_inertia(folder: Path, name: str):
    shape, fixed = model_shape(read_model(folder / name), "thing", name)
    assert not fixed
    count = 2 if name in DOUBLE else 1
    height = EDGE * count
    np.testing.assert_allclose(
        shape.mesh.bounds, [[-EDGE / 2] * 3, [EDGE / 2, EDGE / 2, height - EDGE / 2]], atol=1e-6
    )
    mass = shape.mass_properties
    assert mass.mass == pytest.approx(count * MASS)
    np.testing.assert_allclose(mass.p_OCcm, [0, 0, (height - EDGE) / 2], atol=1e-9)
    across = count * MASS * (EDGE**2 + height**2) / 12
    along = count * MASS * EDGE**2 / 6
    np.testing.assert_allclose(mass.I_CcmO, np.diag([across, across, along]), rtol=1e-6)


def _plant():
    builder = DiagramBuilder()
    config = MultibodyPlantConfig(time_step=0.002, discrete_contact_approximation="sap")
    plant, _ = AddMultibodyPlant(config=config, builder=builder)
    plant.RegisterCollisionGeometry(
        plant.world_body(), RigidTransform([0, 0, -0.5]), Box(4, 4, 1), "floor",
        CoulombFriction(0.6, 0.6),
    )  # fmt: skip
    return builder, plant


def test_all_fall_freely_and_rest_on_the_table(folder: Path):
    builder, plant = _plant()
    drop = 0.05
    added = {}
    for index, name in enumerate(GOOD):
        X_WO = RigidTransform([0.15 * index - 0.8, 0.0, EDGE / 2 + drop])
        item = SceneObject(f"thing_{index}", "other", read_model(folder / name), X_WO, name)
        added[name] = add_object(plant, item)
    plant.Finalize()
    for index, thing in enumerate(added.values()):
        p = [0.15 * index - 0.8, 0.0, EDGE / 2 + drop]
        plant.SetDefaultFloatingBaseBodyPose(thing.base, RigidTransform(p))
    simulator = Simulator(builder.Build())
    context = plant.GetMyContextFromRoot(simulator.get_context())

    def heights() -> list[float]:
        return [
            float(thing.base.EvalPoseInWorld(context).translation()[2]) for thing in added.values()
        ]

    simulator.AdvanceTo(0.08)
    np.testing.assert_allclose(heights(), EDGE / 2 + drop - 9.81 * 0.08**2 / 2, atol=1e-3)
    # Drake's point contact has one point for two boxes: they rock by some millimetres.
    simulator.AdvanceTo(0.6)
    np.testing.assert_allclose(heights(), EDGE / 2, atol=5e-3)
    for thing in added.values():
        up = thing.base.EvalPoseInWorld(context).rotation().matrix()[2, 2]
        assert up > np.cos(np.radians(15))


STATIC_URDF = """<robot name="post"><link name="world"/><link name="post">
<collision name="body"><geometry><box size="0.1 0.2 0.04"/></geometry></collision></link>
<joint name="fix" type="fixed"><parent link="world"/><child link="post"/></joint></robot>"""


@pytest.mark.parametrize("kind", ["sdf", "urdf"])
def test_what_is_static_stands_where_it_is_put_and_has_its_name_in_contacts(
    folder: Path, tmp_path: Path, kind: str
):
    path = tmp_path / f"post.{kind}"
    plate = "<box><size>0.1 0.2 0.04</size></box>"
    path.write_text(
        STATIC_URDF if kind == "urdf" else _sdf("<static>true</static>", _link(plate, inertial=""))
    )
    X_WO = RigidTransform(RollPitchYaw(0, 0, 0.5), [0.5, 0.1, 0.02])
    builder, plant = _plant()
    item = SceneObject("post", "target", read_model(path), X_WO, str(path))
    assert names_the_world(item)
    post = add_object(plant, item)
    panda = add_panda(plant, visuals="none")
    above = RigidTransform([0.5, 0.1, 0.04 + EDGE / 2 - 1e-4])
    two = read_model(folder / "two_links.sdf")
    pile = add_object(plant, SceneObject("pile", "other", two, above))
    plant.Finalize()
    assert post.fixed and not pile.fixed
    plant.SetDefaultFloatingBaseBodyPose(pile.base, above)
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(0.002)  # contacts are those of the last step
    root = simulator.get_context()
    snapshot = read_snapshot(plant, plant.GetMyContextFromRoot(root), panda)
    assert snapshot.X_WO["post"].IsNearlyEqualTo(X_WO, 1e-9)
    assert snapshot.X_WO["pile"].IsNearlyEqualTo(above, 1e-3)
    assert snapshot.touches("pile", "post") and not snapshot.touches("pile", TABLE)
    _, fixed = model_shape(read_model(path), "post", str(path))
    assert fixed


def test_an_obj_gets_the_normals_of_its_faces_and_keeps_its_material(folder: Path):
    text = read_model(folder / "without_normals.sdf")
    uri = text.split("<visual")[1].split("<uri>")[1].split("</uri>")[0]
    made = Path(uri.removeprefix("file://"))
    assert made != folder / "bare.obj" and "usemtl red" in made.read_text()
    assert (made.parent / "bare.mtl").read_text() == (folder / "bare.mtl").read_text()
    lines = made.read_text().splitlines()
    v = np.array([line.split()[1:4] for line in lines if line.startswith("v ")], dtype=float)
    n = np.array([line.split()[1:4] for line in lines if line.startswith("vn ")], dtype=float)
    faces = [line.split()[1:] for line in lines if line.startswith("f ")]
    assert len(faces) == 12
    for corners in faces:
        index = np.array([[int(word.split("/")[k]) - 1 for k in (0, 2)] for word in corners])
        middle = v[index[:, 0]].mean(axis=0)
        normal = n[index[0, 1]]
        assert normal @ middle == pytest.approx(EDGE / 2)  # outwards, across the cube's side
    assert read_model(folder / "without_normals.sdf") == text  # made once


_BAD = _INERTIAL.replace(f"<izz>{INERTIA}", f"<izz>{5 * INERTIA}")
REFUSED = {
    "empty.sdf": ("", "not XML.*expected"),
    "words.sdf": ("cube.sdf", "not XML.*expected"),
    "other.sdf": ("<mujoco/>", "root is <mujoco>.*export"),
    "no_link.urdf": ('<robot name="a"/>', "no <link>"),
    "missing.sdf": (_sdf(_link(_mesh("none.obj"))), "none.obj.*doesn't exist: mend the path"),
    "package.sdf": (_sdf(_link(_mesh("package://nowhere/a.obj"))), "'nowhere' is unknown: state"),
    "scheme.sdf": (_sdf(_link(_mesh("http://a/b.obj"))), "'http' is no kind of URI.*use file"),
    "format.sdf": (_sdf(_link(_mesh("format.sdf"))), "'.sdf' can't be read; use one of .obj"),
    "no_inertial.sdf": (
        _sdf(_link(_PLAIN, inertial="")),
        "'cube' states no inertia.*state <inertial>",
    ),
    "massless.sdf": (_sdf(_link(_PLAIN).replace(f"<mass>{MASS}", "<mass>0")), "0 kg.*> 0"),
    "inertia.sdf": (_sdf(_link(_PLAIN, inertial=_BAD)), "principal moments.*compute them anew"),
    "loose.sdf": (_sdf(_link(_PLAIN, "a"), _link(_PLAIN, "b")), "'a', 'b' are not joined.*join"),
    "ghost.sdf": (_sdf(f'<link name="a">{_INERTIAL}</link>'), "no <collision>.*add one"),
    "large.sdf": (_sdf(_link("<box><size>40 40 40</size></box>", inertial=_INERTIAL)), "40 x 40"),
    "typo.sdf": (_sdf(_link(_PLAIN).replace("collision", "colision")), "colision.*not defined"),
    "list.dmd.yaml": ("models: []\n", "no `directives:`.*name a file"),
    "lost.dmd.yaml": ("directives:\n- add_model: {name: a, file: none.sdf}\n", "none.sdf.*mend"),
    "thing.step": ("", "no model file; use one of .sdf"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_used_is_refused_with_file_reason_and_remedy(tmp_path: Path, name: str):
    text, reason = REFUSED[name]
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(StationError, match=f"(?s){reason}") as error:
        model_shape(read_model(path), "thing", str(path))
    assert str(path) in str(error.value)
