"""MJCFs as people write them: each ends in the object that a hand-made URDF describes too, or in one sentence."""

from __future__ import annotations

import math
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import cKDTree

from fb3d_rl.assets.articulation import ArticulatedObject, Mesh
from fb3d_rl.assets.options import AssetsOptions
from fb3d_rl.errors import UserError
from fb3d_rl.importer.catalog import files_catalog
from fb3d_rl.importer.files import Source, find_files
from fb3d_rl.importer.reading import examine_file, read_file
from fb3d_rl.kinematics.tree import KinematicTree
from tests.assets.test_urdf import SOLID, geometry, mutated, written

pytest.importorskip("mujoco")

HINGE = '<joint name="hinge" axis="0 0 1" range="0 1.5"/>'
CUBE = '<geom type="box" size=".25 .25 .25"/>'
RADIAN = '<compiler angle="radian"/>'


def mjcf(
    door: str = CUBE, hinge: str = HINGE, head: str = RADIAN, more: str = "", at: str = 'pos="1 0 0"', world: str = ""
) -> str:
    """A box with a door; ``more`` is beside the door, ``world`` beside the box."""
    return (
        f'<mujoco>{head}<worldbody>{world}<body name="body">{CUBE}<body name="door" {at}>{hinge}{door}</body>{more}'
        "</body></worldbody></mujoco>"
    )


BOX = geometry('<box size="0.5 0.5 0.5"/>')


def urdf(
    door: str = BOX,
    kind: str = "revolute",
    origin: str = 'xyz="1 0 0"',
    axis: str = "0 0 1",
    limit: str = 'lower="0" upper="1.5"',
    more: str = "",
) -> str:
    """The reference: the same box with a door."""
    return (
        f'<robot name="r"><link name="body">{BOX}</link><link name="door">{door}</link><joint name="hinge" '
        f'type="{kind}"><origin {origin}/><parent link="body"/><child link="door"/><axis xyz="{axis}"/>'
        f"<limit {limit}/></joint>{more}</robot>"
    )


def part(name: str, origin: str, kind: str = "fixed", inside: str = "", shape: str = BOX, parent: str = "body") -> str:
    return (
        f'<link name="{name}">{shape}</link><joint name="j_{name}" type="{kind}"><origin {origin}/>'
        f'<parent link="{parent}"/><child link="{name}"/>{inside}</joint>'
    )


def shape(text: str, origin: str = "") -> str:
    return geometry(text, origin=f"<origin {origin}/>" if origin else "")


MESH = '<asset><mesh name="m" file="{}" {}/></asset>'
OF_MESH = '<geom type="mesh" mesh="m"/>'
FILE = shape('<mesh filename="a.obj"/>')
ELLIPSOID = trimesh.creation.icosphere(radius=1.0).apply_scale((0.25, 0.5, 0.125))
FILES = {**written("obj"), **written("stl"), "e.obj": ELLIPSOID.export(file_type="obj", digits=12).encode()}
TWIN = '<body name="twin" pos="0 2 0"><joint name="j_twin" axis="1 0 0" range="-3 3"/>' + CUBE + "</body>"

SAME = {
    "box": (mjcf(), urdf()),
    "cylinder": (
        mjcf('<geom type="cylinder" size=".5 1"/>'), urdf(shape('<cylinder radius="0.5" length="2"/>'))),
    "sphere": (mjcf('<geom size=".5"/>'), urdf(shape('<sphere radius="0.5"/>'))),
    "capsule": (mjcf('<geom type="capsule" size=".5 1"/>'), urdf(shape('<capsule radius="0.5" length="2"/>'))),
    "ellipsoid": (
        mjcf('<geom type="ellipsoid" size=".25 .5 .125" pos="0 0 1"/>'),
        urdf(shape('<mesh filename="e.obj"/>', 'xyz="0 0 1"'))),
    "from one end to the other": (
        mjcf('<geom type="cylinder" fromto="0 0 1 0 0 3" size=".5"/>'),
        urdf(shape('<cylinder radius="0.5" length="2"/>', 'xyz="0 0 2"'))),
    "several geoms, placed": (
        mjcf('<geom size=".5"/><geom type="box" size=".5 1 1.5" pos="1 2 3" euler=".1 0 0"/>'),
        urdf(shape('<sphere radius="0.5"/>') + shape('<box size="1 2 3"/>', 'xyz="1 2 3" rpy="0.1 0 0"'))),
    "obj": (mjcf(OF_MESH, head=RADIAN + MESH.format("a.obj", "")), urdf(FILE)),
    "stl": (mjcf(OF_MESH, head=RADIAN + MESH.format("a.stl", "")), urdf(FILE)),
    "mesh named after its file": (
        mjcf('<geom type="mesh" mesh="a"/>', head=RADIAN + '<asset><mesh file="a.obj"/></asset>'), urdf(FILE)),
    "mesh as a distance field": (
        mjcf('<geom type="sdf" mesh="m"/>', head=RADIAN + MESH.format("a.obj", "")), urdf(FILE)),
    "mirrored mesh": (
        mjcf(OF_MESH, head=RADIAN + MESH.format("a.obj", 'scale="2 -1 1"')),
        urdf(shape('<mesh filename="a.obj" scale="2 -1 1"/>'))),
    "mesh moved by refpos": (
        mjcf(OF_MESH, head=RADIAN + MESH.format("a.obj", 'refpos="1 0 2"')),
        urdf(shape('<mesh filename="a.obj"/>', 'xyz="-1 0 -2"'))),
    "mesh of a class's scale": (
        mjcf(OF_MESH, head=f'{RADIAN}<default><mesh scale="3 3 3"/></default>' + MESH.format("a.obj", "")),
        urdf(shape('<mesh filename="a.obj" scale="3"/>'))),
    "mesh in the text": (
        mjcf(OF_MESH, head=f'{RADIAN}<asset><mesh name="m" vertex="{" ".join(map(str, SOLID.vertices.ravel()))}" '
             f'face="{" ".join(map(str, SOLID.faces.ravel()))}"/></asset>'),
        urdf(FILE)),
    "meshdir": (
        mjcf(OF_MESH, head='<compiler angle="radian" meshdir="sub"/>' + MESH.format("b.obj", "")), urdf(FILE)),
    "assetdir, stripped path": (
        mjcf(OF_MESH, head='<compiler angle="radian" assetdir="sub" strippath="true"/>' + MESH.format("x/b.obj", "")),
        urdf(FILE)),
    "degrees": (
        mjcf(hinge='<joint name="hinge" axis="0 0 1" range="0 90"/>', head=""),
        urdf(limit=f'lower="0" upper="{math.pi / 2}"')),
    "no unit, so small that it is radians": (mjcf(head="", at='pos="1 0 0" euler="0 0 1"'),
                                             urdf(origin='xyz="1 0 0" rpy="0 0 1"')),
    "no unit, but its angles are degrees": (
        mjcf(hinge='<joint name="hinge" axis="0 0 1" range="0 6"/>', head="", at='pos="1 0 0" euler="0 0 90"'),
        urdf(origin=f'xyz="1 0 0" rpy="0 0 {math.pi / 2}"', limit=f'lower="0" upper="{math.radians(6)}"')),
    "classes": (
        mjcf('<geom class="ball"/>', '<joint name="hinge"/>',
             f'{RADIAN}<default><default class="d"><joint axis="0 1 0" range="0 1"/><default class="ball">'
             '<geom size=".5"/></default></default></default>', at='childclass="d"'),
        urdf(shape('<sphere radius="0.5"/>'), origin="", axis="0 1 0", limit='lower="0" upper="1"')),
    "includes": (
        '<mujoco><include file="sub/head.xml"/><worldbody><body name="body"><include file="sub/shape.xml"/>'
        f'<body name="door" pos="1 0 0">{HINGE}{OF_MESH}</body></body></worldbody></mujoco>', urdf(FILE)),
    "slide": (
        mjcf(hinge='<joint name="hinge" type="slide" axis="0 2 0" range="-.5 .25"/>'),
        urdf(kind="prismatic", axis="0 1 0", limit='lower="-0.5" upper="0.25"')),
    "slide without a range": (
        mjcf(hinge='<joint name="hinge" type="slide" axis="0 1 0"/>'),
        urdf(kind="prismatic", axis="0 1 0", limit='lower="0" upper="0.5"')),
    "hinge without a range": (
        mjcf(hinge='<joint name="hinge" axis="0 1 0"/>'), urdf(kind="continuous", axis="0 1 0", limit="")),
    "anchor": (
        mjcf(hinge='<joint name="hinge" pos=".25 .5 0" axis="0 0 1" range="0 1.5"/>'),
        urdf(shape('<box size="0.5 0.5 0.5"/>', 'xyz="-0.25 -0.5 0"'), origin='xyz="1.25 0.5 0"')),
    "turned bodies": (
        mjcf(at='pos="1 0 0" xyaxes="0 1 0 -1 0 0"'), urdf(origin=f'xyz="1 0 0" rpy="0 0 {math.pi / 2}"')),
    "reference position": (
        mjcf(hinge='<joint name="hinge" axis="0 0 1" range="0 1.5" ref="0.5"/>'),
        urdf(limit='lower="-0.5" upper="1"')),
    "several joints of a body": (
        mjcf(hinge='<joint name="rail" type="slide" axis="1 0 0" range="0 .5"/>'
             '<joint name="hinge" pos="0 1 0" axis="0 0 1" range="0 1"/>'),
        '<robot name="r"><link name="body">' + BOX + "</link>" + part(
            "door:1", 'xyz="1 0 0"', "prismatic", '<axis xyz="1 0 0"/><limit lower="0" upper="0.5"/>', "") + part(
            "door", 'xyz="0 1 0"', "revolute", '<axis xyz="0 0 1"/><limit lower="0" upper="1"/>',
            shape('<box size="0.5 0.5 0.5"/>', 'xyz="0 -1 0"'), "door:1") + "</robot>"),
    "a joint that follows": (
        mjcf(more=TWIN).replace("</mujoco>", '<equality><joint joint1="j_twin" joint2="hinge" '
                                'polycoef=".1 -2 0 0 0"/></equality></mujoco>'),
        urdf(more=part("twin", 'xyz="0 2 0"', "revolute", '<axis xyz="1 0 0"/><limit lower="-3" upper="3"/>'
             '<mimic joint="hinge" multiplier="-2" offset="0.1"/>'))),
    "a joint that is held": (
        mjcf(more=TWIN).replace(
            "</mujoco>", '<equality><joint joint1="j_twin" polycoef=".3 0 0 0 0"/></equality></mujoco>'),
        urdf(more=part("twin", 'xyz="0 2 0" rpy="0.3 0 0"'))),
    "equalities that do not count": (
        mjcf(more=TWIN).replace(
            "</mujoco>", '<equality><joint joint1="j_twin" joint2="hinge" active="false"/><joint joint1="hinge" '
            'joint2="j_twin" polycoef="0 1 1 0 0"/><weld body1="twin" body2="door"/></equality></mujoco>'),
        urdf(more=part("twin", 'xyz="0 2 0"', "revolute", '<axis xyz="1 0 0"/><limit lower="-3" upper="3"/>'))),
    "ball and free joints": (
        mjcf(more=TWIN.replace("name=\"j_twin\" axis=\"1 0 0\" range=\"-3 3\"", 'type="ball"')).replace(
            '<body name="body">', '<body name="body"><freejoint/>'),
        urdf(more=part("twin", 'xyz="0 2 0"'))),
    "a floor": (mjcf(world='<geom type="plane" size="9 9 1"/>'), urdf()),
    "frames and copies": (
        mjcf('<frame pos="0 0 1"><geom size=".5"/></frame><replicate count="2" offset="0 1 0"><geom size=".1"/>'
             "</replicate>"),
        urdf(shape('<sphere radius="0.5"/>', 'xyz="0 0 1"') + shape('<sphere radius="0.1"/>')
             + shape('<sphere radius="0.1"/>', 'xyz="0 1 0"'))),
    "shapes for the eye, others for the hand": (
        mjcf('<geom size=".5" contype="0" conaffinity="0" group="1"/><geom type="box" size=".4 .4 .4"/>'),
        urdf('<visual><geometry><sphere radius="0.5"/></geometry></visual>'
             '<collision><geometry><box size="0.8 0.8 0.8"/></geometry></collision>')),
    "a badge on a door hides nothing": (
        mjcf('<geom size=".1" contype="0" conaffinity="0"/><geom type="box" size=".4 .4 .4"/>'),
        urdf('<visual><geometry><sphere radius="0.1"/></geometry></visual><visual><geometry><box size="0.8 0.8 0.8"/>'
             '</geometry></visual><collision><geometry><box size="0.8 0.8 0.8"/></geometry></collision>')),
    "hidden groups and glass of no colour": (
        mjcf('<geom size=".5"/><geom size=".9" group="3"/><geom size=".7" rgba="1 0 0 0" contype="0" '
             'conaffinity="0"/>'),
        urdf('<visual><geometry><sphere radius="0.5"/></geometry></visual><collision><geometry><sphere radius="0.5"/>'
             '</geometry></collision><collision><geometry><sphere radius="0.9"/></geometry></collision>')),
    "hidden alone": (mjcf('<geom size=".5" group="4"/>'), urdf(shape('<sphere radius="0.5"/>'))),
    "what is no geometry": (
        mjcf('<geom size=".5" material="wood"/><site name="s"/><camera name="c"/>',
             head=f'{RADIAN}<option timestep="1"/><visual/><statistic extent="2"/><asset><texture name="t" type="2d" '
             'file="../../no.png"/><material name="wood" texture="t"/></asset><custom/><default><motor/></default>',
             world='<light pos="0 0 3"/>').replace(
                 "</mujoco>", '<actuator><motor joint="hinge"/></actuator><sensor><jointpos joint="hinge"/></sensor>'
                 "<keyframe/><contact/><tendon/></mujoco>"),
        urdf(shape('<sphere radius="0.5"/>'))),
    "comments of dashes": ("<!-- ---- <robot> -->" + mjcf(more="<!------>"), urdf()),
    "bodies without mass": (
        mjcf('<geom size=".5" mass="0"/>'), urdf(shape('<sphere radius="0.5"/>'))),
    "no names at all": (
        f"<mujoco>{RADIAN}<worldbody><body>{CUBE}<body pos=\"1 0 0\"><joint range=\"0 1\"/>{CUBE}</body></body>"
        "</worldbody></mujoco>",
        '<robot name="r"><link name="body_1">' + BOX + "</link>" + part(
            "body_2", 'xyz="1 0 0"', "revolute", '<axis xyz="0 0 1"/><limit lower="0" upper="1"/>').replace(
                '"body"', '"body_1"') + "</robot>"),
}  # fmt: skip


def put(folder: Path, text: str | bytes, name: str = "a.xml") -> Path:
    """The file, beside meshes and files to include."""
    parts = {
        **FILES,
        "sub/b.obj": FILES["a.obj"],
        "sub/head.xml": f'<mujoco>{RADIAN}<include file="more.xml"/></mujoco>'.encode(),
        "sub/more.xml": f"<mujocoinclude>{MESH.format('a.obj', '')}</mujocoinclude>".encode(),
        "sub/shape.xml": f"<mujocoinclude>{CUBE}</mujocoinclude>".encode(),
        "u.xml": urdf().encode(),
        name: text.encode() if isinstance(text, str) else text,
    }
    for path, content in parts.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_bytes(content)
    return folder / name


def read(path: Path, body: str | None = None) -> ArticulatedObject:
    return read_file(Source(path, path.stem, "unknown", (), body))


def assert_same_shape(meshes: tuple[Mesh, ...], others: tuple[Mesh, ...], pose: np.ndarray, other: np.ndarray) -> None:
    """Shapes at two poses are one and the same surface, each with its outside out."""
    assert len(meshes) == len(others)
    for one, two in zip(meshes, others, strict=True):
        surfaces = [
            trimesh.Trimesh(mesh.vertices @ at[:3, :3].T + at[:3, 3], mesh.faces)
            for mesh, at in ((one, pose), (two, other))
        ]
        corners = [surface.vertices for surface in surfaces]
        assert cKDTree(corners[0]).query(corners[1])[0].max() < 1e-6
        assert cKDTree(corners[1]).query(corners[0])[0].max() < 1e-6
        assert surfaces[0].area == pytest.approx(surfaces[1].area, rel=1e-5)
        assert surfaces[0].volume == pytest.approx(surfaces[1].volume, rel=1e-5)
        assert surfaces[0].volume > 0


def assert_same(made: ArticulatedObject, wanted: ArticulatedObject) -> None:
    """Both have the same joints, and the same links stand and look alike wherever the joints are."""
    assert [made.links[i].name for i in made.movable] == [wanted.links[i].name for i in wanted.movable]
    assert [made.joint_of(i).type for i in made.movable] == [wanted.joint_of(i).type for i in wanted.movable]
    np.testing.assert_allclose(made.limits, wanted.limits, atol=1e-6)
    bounded = np.clip(wanted.limits, -2.0, 2.0)
    for share in (0.0, 0.4, 1.0):
        state = torch.as_tensor(bounded[:, 0] + share * np.ptp(bounded, axis=1))
        poses, others = (KinematicTree.from_object(obj).forward(state).numpy() for obj in (made, wanted))
        for i, link in enumerate(wanted.links):
            if link.name == "base_0":  # turns the reference, what MuJoCo's world does
                continue
            j = made.index(link.name)
            np.testing.assert_allclose(poses[j], others[i], atol=1e-6)
            assert_same_shape(made.links[j].visuals, link.visuals, poses[j], others[i])
            assert_same_shape(made.links[j].collisions, link.collisions, poses[j], others[i])


@pytest.mark.parametrize("case", SAME)
def test_a_file_is_the_object_of_its_reference(tmp_path: Path, case: str) -> None:
    text, reference = SAME[case]
    assert_same(read(put(tmp_path / "a", text)), read(put(tmp_path / "b", reference, "a.urdf")))


# ------------------------------------------------------------------------------------------------- what is said


@pytest.mark.parametrize(
    ("case", "says"),
    [
        ("a floor", "a plane, left out"),
        ("ball and free joints", "ball, read as fixed"),
        ("ball and free joints", "free, read as fixed"),
        ("a joint that follows", "moves along with hinge"),
        ("a joint that is held", "fixed at 0.3"),
        ("equalities that do not count", "not linear"),
        ("equalities that do not count", "a <weld>, not read"),
        ("no unit, so small that it is radians", "taken as radians"),
        ("hinge without a range", "turns without end"),
        ("slide without a range", "the part's length"),
        ("hidden alone", "no visual"),
    ],
)
def test_what_was_changed_is_said(tmp_path: Path, case: str, says: str) -> None:
    assert any(says in remark for remark in read(put(tmp_path, SAME[case][0])).dropped)


def test_a_mesh_is_read_anew_for_each_file(tmp_path: Path) -> None:
    """MuJoCo keeps the meshes that it has read."""
    for scale, text in ((1.0, "obj"), (1.0, "mesh moved by refpos"), (1.0, "obj"), (3.0, "obj")):
        path = put(tmp_path, SAME[text][0])
        larger = trimesh.Trimesh(SOLID.vertices * scale, SOLID.faces)
        (tmp_path / "a.obj").write_text(larger.export(file_type="obj"))
        moved = larger.vertices - (np.array([1.0, 0.0, 2.0]) if text != "obj" else 0.0)
        (door,) = [link for link in read(path).links if link.name == "door"]
        np.testing.assert_allclose(np.sort(door.visuals[0].vertices, 0), np.sort(moved, 0), atol=1e-6)


def test_little_is_said_of_a_plain_file(tmp_path: Path) -> None:
    assert not read(put(tmp_path, mjcf())).dropped and not read(put(tmp_path, mjcf())).lost


ROOM = mjcf(
    at='pos="1 0 0" euler="0 0 .5"',
    world='<geom size="3"/><body name="robot"><joint range="0 1"/><geom size="2"/></body>',
)


def test_one_body_of_a_room_is_taken_from_where_it_stands(tmp_path: Path) -> None:
    path = put(tmp_path, ROOM)
    assert any("robot, body stand side by side" in remark for remark in read(path).dropped)
    assert not read(path, "robot").dropped and not any("robot" in remark for remark in read(path, "body").dropped)
    assert_same(read(path, "body"), read(put(tmp_path / "b", urdf(origin='xyz="1 0 0" rpy="0 0 0.5"'), "a.urdf")))
    door = read(path, "door")  # with the joint that carries it
    assert [link.name for link in door.links] == ["world", "door"] and door.joint_of(1).limits == (0.0, 1.5)
    np.testing.assert_allclose(door.joint_of(1).origin[:3, 3], (1, 0, 0), atol=1e-9)
    (entry,) = files_catalog(AssetsOptions(source="files", root=str(path), body="body"))
    assert [entry.load().links[i].name for i in entry.load().movable] == ["door"]


def test_a_body_that_there_is_not_is_answered_with_those_that_there_are(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no body 'cabinet'; its bodies are world, robot, body, door$"):
        read(put(tmp_path, ROOM), "cabinet")
    with pytest.raises(UserError, match="assets.body=door names a body of an MJCF"):
        read(put(tmp_path, urdf(), "a.urdf"), "door")


def test_a_height_field_is_lost_and_said(tmp_path: Path) -> None:
    lost = read(put(tmp_path, mjcf(CUBE + '<geom name="hills" type="hfield" hfield="h"/>'))).lost
    assert len(lost) == 1 and "hills" in lost[0]


def test_without_mujoco_the_way_to_install_it_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(UserError, match=r"pip install 'fb3d_rl\[mujoco\]'"):
        read(put(tmp_path, mjcf()))


def test_files_are_found_without_those_that_others_include(tmp_path: Path) -> None:
    put(tmp_path, '<mujoco><include file="whole.xml"/></mujoco>')
    put(tmp_path, mjcf(), "whole.xml")
    put(tmp_path, mjcf(), "other.mjcf")
    put(tmp_path, "<mujoco/>" + " " * 9000 + "<robot>", "sub/empty.xml")
    found = {source.id: source for source in find_files(tmp_path)}
    assert sorted(found) == ["a", "empty", "head", "other", "u"]
    assert examine_file(found["a"]).openable == examine_file(found["other"]).openable == 1


def test_warnings_of_the_compiler_leave_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    path = put(tmp_path / "a", mjcf('<geom size=".5" friction="nan 1 1"/>'))
    try:
        assert any("NaN" in remark for remark in read(path).dropped)
    except UserError as error:
        assert "nan" in str(error).lower()
    assert [entry.name for entry in tmp_path.iterdir()] == ["a"]


# ------------------------------------------------------------------------------------------------- sentences


def assets(inside: str, compiler: str = RADIAN) -> str:
    return mjcf(head=f"{compiler}<asset>{inside}</asset>")


def including(name: str) -> str:
    return mjcf(head=f'{RADIAN}<include file="{name}"/>')


BROKEN = {
    "missing mesh": (assets('<mesh file="b.obj"/>'), "the mesh b.obj is missing"),
    "mesh outside": (assets('<mesh file="../secret.obj"/>'), "leaves"),
    "absolute mesh": (assets('<mesh file="/etc/passwd"/>'), "leaves"),
    "mesh over a link": (assets('<mesh file="link.obj"/>'), "leaves"),
    "mesh over a linked folder": (assets('<mesh file="up/secret.obj"/>'), "leaves"),
    "meshdir outside": (assets('<mesh file="secret.obj"/>', '<compiler meshdir=".."/>'), "leaves"),
    "absolute assetdir": (assets('<mesh file="passwd"/>', '<compiler assetdir="/etc"/>'), "leaves"),
    "mesh of another kind": (assets('<mesh file="a.step"/>'), "no .obj, .stl or .msh"),
    "broken obj": (assets('<mesh file="broken.obj"/>'), "MuJoCo cannot compile it"),
    "broken stl": (assets('<mesh file="broken.stl"/>'), "MuJoCo cannot compile it"),
    "a flat mesh": (mjcf(OF_MESH, head=f'{RADIAN}<asset><mesh name="m" file="flat.obj"/></asset>'), "MuJoCo"),
    "half an stl": (assets('<mesh file="half.stl"/>'), "MuJoCo cannot compile it"),
    "mesh of no name": (mjcf(OF_MESH), "MuJoCo cannot compile it"),
    "include outside": (including("../secret.xml"), "the include path '../secret.xml' leaves"),
    "absolute include": (including("/etc/passwd"), "leaves"),
    "include over a link": (including("link.xml"), "leaves"),
    "missing include": (including("no.xml"), "the include no.xml is missing"),
    "include of itself": (including("a.xml"), "included twice"),
    "include in a circle": (including("sub/circle.xml"), "included twice"),
    "include of another kind": (including("a.obj"), "the include a.obj is no"),
    "include of a URDF": (including("u.xml"), "a URDF"),
    "include without a file": (mjcf(head="<include/>"), "no attribute 'file'"),
    "include of entities": (including("sub/entity.xml"), "XML"),
    "include that grows": (including("sub/huge.xml"), "MiB"),
    "extension": (mjcf(head='<extension><plugin plugin="x"/></extension>'), "a <extension>"),
    "plugin": (mjcf('<geom type="sdf"><plugin instance="x"/></geom>'), "a <plugin>"),
    "composite": (mjcf('<composite type="cloth" count="9 9 1"/>'), "a <composite>"),
    "flexcomp": (mjcf('<flexcomp type="grid" name="f" file="/etc/passwd"/>'), "a <flexcomp>"),
    "attached model": (assets('<model name="x" file="../secret.xml"/>'), "a <model>"),
    "unknown class": (mjcf('<geom class="x" size="1"/>'), "MuJoCo cannot compile it"),
    "unknown attribute": (mjcf('<geom siz="1"/>'), "unrecognized attribute"),
    "no size": (mjcf('<geom type="box"/>'), "size"),
    "size of no number": (mjcf('<geom size="nan"/>'), "size"),
    "size beyond measure": (mjcf('<geom size="1e9"/>'), "size 1e"),
    "far away": (mjcf(at='pos="1e9 0 0"'), "body_pos of 1e"),
    "an equality of no number": (
        mjcf().replace("</mujoco>", '<equality><joint joint1="hinge" polycoef="nan 1 0 0 0"/></equality></mujoco>'),
        "eq_data of nan"),
    "axis of no length": (mjcf(hinge='<joint name="hinge" axis="0 0 0" range="0 1"/>'), "axis"),
    "range upside down": (mjcf(hinge='<joint name="hinge" range="1 0" limited="true"/>'), "range"),
    "one name twice": (mjcf(more='<body name="door"/>'), "repeated name"),
    "joints that follow each other": (
        mjcf(more=TWIN).replace("</mujoco>", '<equality><joint joint1="j_twin" joint2="hinge"/><joint joint1="hinge" '
                                'joint2="j_twin"/></equality></mujoco>'), "follows itself"),
    "too many copies": (mjcf('<replicate count="1000000000"><geom size="1"/></replicate>'), "more than"),
    "copies of copies": (
        mjcf('<replicate count="200"><replicate count="200"><geom size="1"/></replicate></replicate>'), "more than"),
    "copies of nothing": (mjcf('<replicate count="100000000"/>'), "more than"),
    "copies of a long number": (mjcf(f'<replicate count="{"9" * 5000}"/>'), "count='999"),
    "copies of no number": (mjcf('<replicate count="-1"><geom size="1"/></replicate>'), "count='-1'"),
    "too many bodies": (mjcf(more="<body/>" * 1000), "more than"),
    "too deep": (mjcf(more="<frame>" * 2000 + "</frame>" * 2000), "deep"),
    "old coordinates": (mjcf(head='<compiler coordinate="global"/>'), "MuJoCo cannot compile it"),
    "no shapes": ("<mujoco/>", "no link has a shape"),
    "a floor alone": (
        '<mujoco><worldbody><geom type="plane" size="1 1 1"/></worldbody></mujoco>', "no link has a shape"),
    "a part": ("<mujocoinclude/>", "holds a <mujocoinclude>"),
    "entities": ('<!DOCTYPE m [<!ENTITY e "x">]>' + mjcf("&e;"), "XML"),
    "half a file": (mjcf()[:-40], "XML"),
    "an open comment": ("<mujoco><!-- " + mjcf(), "XML"),
}  # fmt: skip


@pytest.mark.parametrize("case", BROKEN)
def test_what_cannot_be_read_ends_in_one_sentence(tmp_path: Path, case: str, capfd: pytest.CaptureFixture[str]) -> None:
    text, word = BROKEN[case]
    path = put(tmp_path / "a17", text)
    (tmp_path / "secret.obj").write_bytes(FILES["a.obj"])
    (tmp_path / "secret.xml").write_text("<mujocoinclude/>")
    (path.parent / "link.obj").symlink_to(tmp_path / "secret.obj")
    (path.parent / "link.xml").symlink_to(tmp_path / "secret.xml")
    (path.parent / "up").symlink_to(tmp_path, target_is_directory=True)
    (path.parent / "broken.obj").write_text("v 0 0 0\nv 1 0 0\nf 1 2 9\n")
    (path.parent / "broken.stl").write_bytes(b"\xff" * 500)
    (path.parent / "flat.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nf 1 2 3\nf 2 4 3\n")
    (path.parent / "half.stl").write_bytes(FILES["a.stl"][:200])
    (path.parent / "sub/circle.xml").write_text('<mujocoinclude><include file="circle.xml"/></mujocoinclude>')
    (path.parent / "sub/entity.xml").write_text('<!DOCTYPE m [<!ENTITY e "x">]><m>&e;</m>')
    if case == "include that grows":
        (path.parent / "sub/huge.xml").write_text("<m>" + " " * 2**24 + "</m>")
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(UserError, match=word) as caught:
        read(path)
    assert "a17" in str(caught.value) or "object a" in str(caught.value)
    assert "\n" not in str(caught.value) and sorted(tmp_path.rglob("*")) == before
    assert capfd.readouterr() == ("", "")


def test_a_package_that_was_named_is_read(tmp_path: Path) -> None:
    path = put(tmp_path / "a/one", assets('<mesh file="../shared/s.obj"/>'))
    (tmp_path / "a/shared").mkdir()
    (tmp_path / "a/shared/s.obj").write_bytes(FILES["a.obj"])
    assert "leaves" in examine_file(find_files(path)[0]).findings[0].what
    assert examine_file(find_files(path, [tmp_path / "a/shared"])[0]).usable


# ------------------------------------------------------------------------------------------------- mutated files

RICH = f"""<mujoco><compiler angle="radian" meshdir="sub"/><default><geom group="1"/><default class="c">
<joint range="0 1.5"/><geom contype="0" conaffinity="0"/></default></default><include file="sub/more.xml"/>
<asset><mesh name="a" file="b.obj" scale="1 -1 1"/><mesh name="v" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/></asset>
<worldbody><geom type="plane" size="1 1 1"/><body name="body" pos="0 0 1" euler="0.1 0.2 0.3"><geom type="box"
size=".3 .4 .5"/><geom type="capsule" fromto="0 0 0 1 0 0" size=".1"/><body name="door" pos="1 0 0" childclass="c">
<joint name="hinge" pos=".1 0 0" axis="0 0 1" ref="0.1"/><joint name="s" type="slide" axis="1 0 0" range="0 .3"/>
<geom type="mesh" mesh="a"/><geom class="main" type="cylinder" size=".1 .2"/><replicate count="2" offset="0 0 .2">
<geom type="sphere" size=".05"/></replicate></body>{TWIN}<body name="x" quat="1 1 0 0"><joint type="ball" name="bl"/>
<geom type="ellipsoid" size=".1 .2 .3"/><geom type="mesh" mesh="v"/></body></body><body name="free"><freejoint/>
<geom size=".1"/></body></worldbody><equality><joint joint1="j_twin" joint2="hinge" polycoef="0.1 -1 0 0 0"/></equality>
</mujoco>""".replace('meshdir="sub"', 'meshdir="."').replace('file="b.obj"', 'file="sub/b.obj"')


def fuzz(folder: Path, seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    outcomes: Counter[bool] = Counter()
    path = put(folder, RICH)
    solid = FILES["a.obj"]
    for number in range(count):
        path.write_bytes(RICH.encode() if number % 4 == 0 else mutated(rng, RICH.encode()))
        mesh = bytearray(solid)
        for place in rng.integers(len(mesh), size=rng.integers(1, 6) * (number % 4 == 0)):
            mesh[place] = rng.integers(256)
        (folder / "sub/b.obj").write_bytes(mesh)
        try:
            obj = read(path)
        except UserError as error:
            outcomes[False] += 1
            assert "\n" not in str(error) and "object a" in str(error)
            continue
        outcomes[True] += 1
        assert KinematicTree.from_object(obj).forward(torch.zeros(len(obj.movable))).isfinite().all()
        assert (obj.limits[:, 0] <= obj.limits[:, 1]).all()
        for link in obj.links:
            assert all(np.isfinite(each.vertices).all() for each in (*link.visuals, *link.collisions))
    assert min(outcomes.values()) > count // 20


def test_mutated_files_end_in_an_object_or_a_sentence(tmp_path: Path) -> None:
    fuzz(tmp_path, 0, 200)


@pytest.mark.slow
def test_many_mutated_files_end_in_an_object_or_a_sentence(tmp_path: Path) -> None:
    fuzz(tmp_path, 1, 1000)
