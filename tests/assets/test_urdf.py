"""URDFs as people write them: each ends in the object that a hand-made reference is, or in one sentence."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from fb3d_rl.assets.articulation import ArticulatedObject, Mesh
from fb3d_rl.assets.partnet_mobility import load_object
from fb3d_rl.errors import UserError
from fb3d_rl.kinematics.tree import KinematicTree
from tests.assets.test_partnet_mobility import refuse

SOLID = trimesh.creation.box((0.5, 0.25, 1.0), transform=trimesh.transformations.translation_matrix((0.5, 1.0, 0.25)))
"""What the mesh files hold: numbers that every format keeps exactly."""

DOOR = (
    '<joint name="hinge" type="revolute"><origin xyz="1 0 0"/><parent link="body"/><child link="door"/>'
    '<axis xyz="0 0 1"/><limit lower="0" upper="1.5"/></joint>'
)


def geometry(shape: str, tags: tuple[str, ...] = ("visual", "collision"), origin: str = "") -> str:
    return "".join(f"<{tag}>{origin}<geometry>{shape}</geometry></{tag}>" for tag in tags)


def mesh(name: str, more: str = "") -> str:
    return geometry(f'<mesh filename="{name}" {more}/>')


BOX = geometry('<box size="0.5 0.5 0.5"/>')


def robot(door: str = BOX, hinge: str = DOOR, more: str = "", head: str = '<robot name="r">') -> str:
    """A box with a door."""
    return f'{head}<link name="body">{BOX}</link><link name="door">{door}</link>{hinge}{more}</robot>'


def written(kind: str) -> dict[str, bytes]:
    """The solid in a format, as the files that it takes."""
    if kind == "gltf":
        files = trimesh.Scene(SOLID).export(file_type="gltf")
        return {name.replace("model.gltf", "a.gltf"): bytes(content) for name, content in files.items()}
    content = SOLID.export(file_type=kind)
    return {f"a.{kind}": content.encode() if isinstance(content, str) else bytes(content)}


def put(folder: Path, urdf: str | bytes, files: Mapping[str, bytes] | None = None) -> Path:
    for name, content in {"mobility.urdf": urdf, **(written("obj") if files is None else files)}.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content.encode() if isinstance(content, str) else content)
    (folder / "semantics.txt").write_text("")
    return folder


def assert_surface(meshes: tuple[Mesh, ...], *solids: trimesh.Trimesh) -> None:
    """The meshes are these solids, with their outside out."""
    assert len(meshes) == len(solids)
    for made, wanted in zip(meshes, solids, strict=True):
        corners = [
            np.unique(np.round(np.asarray(v, dtype=float), 6) + 0.0, axis=0) for v in (made.vertices, wanted.vertices)
        ]
        np.testing.assert_allclose(corners[0], corners[1], atol=1e-6)
        surface = trimesh.Trimesh(made.vertices, made.faces, process=False)
        assert surface.area == pytest.approx(wanted.area, rel=1e-6)
        assert surface.volume == pytest.approx(abs(wanted.volume), rel=1e-6)


def moved(solid: trimesh.Trimesh, transform: np.ndarray) -> trimesh.Trimesh:
    return solid.copy().apply_transform(transform)


def door_of(obj: ArticulatedObject) -> tuple[Mesh, ...]:
    link = obj.links[obj.index("door")]
    for seen, touched in zip(link.visuals, link.collisions, strict=True):
        np.testing.assert_array_equal(np.unique(seen.vertices, axis=0), np.unique(touched.vertices, axis=0))
    return link.visuals


FORMATS = ["obj", "stl", "dae", "ply", "off", "glb", "gltf"]


@pytest.mark.parametrize("kind", FORMATS)
def test_every_format_of_a_mesh_is_read(tmp_path: Path, kind: str) -> None:
    if kind not in trimesh.available_formats():
        pytest.skip(f"trimesh reads no .{kind} here")
    folder = put(tmp_path / "a", robot(mesh(f"a.{kind}")), written(kind))
    assert_surface(door_of(load_object(folder)), SOLID)


def test_a_collada_file_says_its_unit(tmp_path: Path) -> None:
    pytest.importorskip("collada")
    text = written("dae")["a.dae"].replace(b"<up_axis>", b'<unit name="millimeter" meter="0.001"/><up_axis>')
    assert_surface(
        door_of(load_object(put(tmp_path, robot(mesh("a.dae")), {"a.dae": text}))), SOLID.copy().apply_scale(1e-3)
    )


def test_a_format_whose_reader_is_not_installed_names_the_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trimesh, "available_formats", lambda: {"obj"})
    assert re.search(
        r"pycollada.*pip install 'fb3d_rl\[meshes\]'", refuse(put(tmp_path, robot(mesh("a.dae")), {"a.dae": b"<x/>"}))
    )


SHAPES = [
    ('<box size="1 2 3"/>', trimesh.creation.box((1, 2, 3))),
    ('<cylinder radius="0.5" length="2"/>', trimesh.creation.cylinder(0.5, 2.0)),
    ('<sphere radius="0.5"/>', trimesh.creation.icosphere(radius=0.5)),
    ('<capsule radius="0.5" length="2"/>', None),
]


@pytest.mark.parametrize(("shape", "solid"), SHAPES)
def test_primitives_are_meshes(tmp_path: Path, shape: str, solid: trimesh.Trimesh | None) -> None:
    origin = '<origin xyz="1 2 3" rpy="0.1 0.2 0.3"/>'
    (made,) = door_of(load_object(put(tmp_path, robot(geometry(shape, origin=origin)))))
    place = np.eye(4)
    place[:3, :3], place[:3, 3] = Rotation.from_euler("xyz", (0.1, 0.2, 0.3)).as_matrix(), (1, 2, 3)
    if solid is not None:
        assert_surface((made,), moved(solid, place))
        return
    local = (made.vertices - place[:3, 3]) @ place[:3, :3]
    np.testing.assert_allclose([local.min(0)[2], local.max(0)[2]], [-1.5, 1.5], atol=1e-9)  # length is without the caps
    ends = np.clip(local[:, 2], -1.0, 1.0)[:, None] * [0, 0, 1]
    np.testing.assert_allclose(np.linalg.norm(local - ends, axis=1), 0.5, atol=1e-9)
    volume = trimesh.Trimesh(made.vertices, made.faces).volume
    assert volume == pytest.approx(math.pi * (0.5**2 * 2 + 4 / 3 * 0.5**3), rel=0.02)


def test_a_link_has_as_many_shapes_as_its_file(tmp_path: Path) -> None:
    shapes = mesh("a.obj") + geometry('<box size="1 2 3"/>') + geometry('<sphere radius="0.5"/>')
    solids = SOLID, trimesh.creation.box((1, 2, 3)), trimesh.creation.icosphere(radius=0.5)
    assert_surface(door_of(load_object(put(tmp_path, robot(shapes)))), *solids)


NAMED = [
    ("meshes/a.obj", "meshes/a.obj"),
    ("./meshes/../meshes/a.obj", "meshes/a.obj"),
    ("meshes\\a.obj", "meshes/a.obj"),
    ("my meshes/tür 1.obj", "my meshes/tür 1.obj"),
    ("my%20meshes/t%C3%BCr.obj", "my meshes/tür.obj"),
    ("100%25.obj", "100%25.obj"),
    ("a.OBJ", "a.OBJ"),
    ("package://my_cab/meshes/a.obj", "meshes/a.obj"),
    ("package://my_cab//meshes/a.obj", "meshes/a.obj"),
    ("package://other/meshes/a%20b.obj", "meshes/a b.obj"),
    ("package://other/a.obj", "other/a.obj"),
    ("model://my_cab/a.obj", "a.obj"),
    ("file://meshes/a.obj", "meshes/a.obj"),
    ("file://FOLDER/meshes/a.obj", "meshes/a.obj"),
    ("file://localhostFOLDER/a%20b.obj", "a b.obj"),
    ("FOLDER/meshes/a.obj", "meshes/a.obj"),
]
"""What a mesh is called, and the file that is meant; FOLDER is the object's."""


@pytest.mark.parametrize(("name", "file"), NAMED)
def test_a_mesh_is_found_however_it_is_named(tmp_path: Path, name: str, file: str) -> None:
    folder = tmp_path / "my_cab"
    urdf = robot(mesh(name.replace("FOLDER", folder.as_posix())))
    assert_surface(door_of(load_object(put(folder, urdf, {file: written("obj")["a.obj"]}))), SOLID)


SCALES = ["2 0.5 4", "-1 1 1", "-1 -2 1", "1 -1 -1", "-1 -1 -1", "0.001"]


@pytest.mark.parametrize("scale", SCALES)
def test_a_scale_keeps_the_outside_out(tmp_path: Path, scale: str) -> None:
    factors = np.broadcast_to([float(word) for word in scale.split()], 3)
    (made,) = door_of(load_object(put(tmp_path, robot(mesh("a.obj", f'scale="{scale}"')))))
    surface = trimesh.Trimesh(made.vertices, made.faces, process=False)
    np.testing.assert_allclose(surface.bounds, np.sort(SOLID.bounds * factors, axis=0), atol=1e-9)
    assert surface.volume == pytest.approx(SOLID.volume * abs(np.prod(factors)))


@pytest.mark.parametrize("tag", ["visual", "collision"])
def test_a_link_without_one_kind_of_shape_gets_the_other(tmp_path: Path, tag: str) -> None:
    obj = load_object(put(tmp_path, robot(geometry('<mesh filename="a.obj"/>', (tag,)))))
    door = obj.links[obj.index("door")]
    assert_surface(door.visuals, SOLID)
    assert_surface(door.collisions, SOLID)
    (remark,) = obj.dropped
    assert "link door: no" in remark and not obj.lost


LIMITS = [
    ("revolute", '<limit lower="0" upper="90"/>', (0.0, math.pi / 2)),
    ("revolute", '<limit lower="110" upper="-10"/>', (math.radians(-10), math.radians(110))),
    ("revolute", '<limit lower="-360" upper="0"/>', (-2 * math.pi, 0.0)),
    ("revolute", "", (0.0, math.pi / 2)),
    ("revolute", '<limit effort="1" velocity="1"/>', (0.0, math.pi / 2)),
    ("revolute", '<limit lower="-inf" upper="inf"/>', (0.0, math.pi / 2)),
    ("revolute", '<limit lower="-1e16" upper="1e16"/>', (0.0, math.pi / 2)),
    ("revolute", '<limit lower="-0.5" upper="inf"/>', (-0.5, math.pi / 2 - 0.5)),
    ("revolute", '<limit lower="-inf" upper="0"/>', (-math.pi / 2, 0.0)),
    ("prismatic", "", (0.0, 0.5)),
    ("prismatic", '<limit lower="1e9" upper="-0.25"/>', (-0.25, 0.25)),
    ("revolute", '<limit lower="1.5" upper="0"/>', (0.0, 1.5)),
]
"""Of a joint of some type, and what is made of them."""


@pytest.mark.parametrize(("kind", "limit", "wanted"), LIMITS)
def test_limits_are_mended_and_it_is_said(tmp_path: Path, kind: str, limit: str, wanted: tuple[float, float]) -> None:
    hinge = DOOR.replace("revolute", kind).replace('<limit lower="0" upper="1.5"/>', limit)
    obj = load_object(put(tmp_path, robot(hinge=hinge)))
    assert obj.joint_of(obj.index("door")).limits == pytest.approx(wanted)
    assert obj.dropped and all("limits of joint hinge" in remark for remark in obj.dropped)


def test_limits_that_can_be_meant_stay(tmp_path: Path) -> None:
    for kind, lower, upper in (("revolute", -6.3, 12.5), ("revolute", 0.0, 0.0), ("prismatic", -50.0, 50.0)):
        hinge = DOOR.replace("revolute", kind).replace('lower="0" upper="1.5"', f'lower="{lower}" upper="{upper}"')
        obj = load_object(put(tmp_path, robot(hinge=hinge)))
        assert obj.joint_of(obj.index("door")).limits == (lower, upper) and not obj.dropped


def test_the_range_of_a_drawer_is_that_of_all_that_is_fixed_to_it(tmp_path: Path) -> None:
    hinge = DOOR.replace("revolute", "prismatic").replace('<limit lower="0" upper="1.5"/>', "")
    front = (
        '<link name="front">' + geometry('<box size="0.5 0.5 2"/>') + "</link>"
        '<joint name="glue" type="fixed"><origin xyz="0 0 1"/><parent link="door"/><child link="front"/></joint>'
    )
    obj = load_object(put(tmp_path, robot(door="", hinge=hinge, more=front)))
    assert obj.joint_of(obj.index("door")).limits == pytest.approx((0.0, 2.0))


@pytest.mark.parametrize("kind", ["planar", "floating"])
def test_joints_of_many_ways_are_fixed(tmp_path: Path, kind: str) -> None:
    obj = load_object(put(tmp_path, robot(hinge=DOOR.replace("revolute", kind))))
    assert not obj.movable and obj.dropped == (f"joint hinge: {kind}, read as fixed",)
    np.testing.assert_array_equal(obj.joint_of(obj.index("door")).origin[:3, 3], [1, 0, 0])


def test_links_without_a_body(tmp_path: Path) -> None:
    """A world that nothing joins is left out; links that only carry others stay."""
    alone = load_object(put(tmp_path / "a", robot(more='<link name="world"/>')))
    assert [link.name for link in alone.links] == ["body", "door"] and "world" in alone.dropped[0]
    fixed = '<link name="world"/><joint name="w" type="fixed"><parent link="world"/><child link="body"/></joint>'
    joined = load_object(put(tmp_path / "b", robot(more=fixed)))
    assert [link.name for link in joined.links] == ["world", "body", "door"] and not joined.dropped


def test_namespaces_and_tags_of_others_do_not_matter(tmp_path: Path) -> None:
    head = '<robot name="r" xmlns="http://example.org/urdf" xmlns:xacro="http://www.ros.org/wiki/xacro">'
    more = '<!-- ${width} --><gazebo reference="door"><material>X</material></gazebo><transmission name="t"/>'
    assert load_object(put(tmp_path, robot(head=head, more=more))).movable == (1,)


# ------------------------------------------------------------------------------------------------ followers


def follower(name: str, parent: str, mimic: str, kind: str = "revolute") -> str:
    return (
        f'<link name="{name}">{BOX}</link><joint name="j_{name}" type="{kind}"><origin xyz="0 1 0" rpy="0.3 0 0"/>'
        f'<parent link="{parent}"/><child link="{name}"/><axis xyz="0 1 0"/>{mimic}</joint>'
    )


def test_a_follower_moves_along(tmp_path: Path) -> None:
    more = follower("twin", "body", '<mimic joint="hinge" multiplier="-2" offset="0.25"/>')
    more += follower("rack", "twin", '<mimic joint="j_twin" multiplier="0.5" offset="1"/>', "prismatic")
    more += '<link name="stick"/><joint name="s" type="fixed"><parent link="rack"/><child link="stick"/></joint>'
    obj = load_object(put(tmp_path, robot(more=more)))
    door, twin, rack, stick = (obj.index(name) for name in ("door", "twin", "rack", "stick"))
    assert obj.movable == (door,) and obj.followers == {twin: door, rack: door}
    assert obj.descendants(door) == tuple(sorted((door, twin, rack, stick)))
    np.testing.assert_allclose(obj.limits, [(0.0, 1.5)])
    assert obj.joint_of(twin).limits == pytest.approx((-2.75, 0.25))
    assert sum("mimic" in remark for remark in obj.dropped) == 2
    q = 0.6
    poses = KinematicTree.from_object(obj).forward(torch.tensor([q])).numpy()
    origin = np.eye(4)
    origin[:3, :3], origin[:3, 3] = Rotation.from_rotvec((0.3, 0, 0)).as_matrix(), (0, 1, 0)
    turned, slid = np.eye(4), np.eye(4)
    turned[:3, :3] = Rotation.from_rotvec((0, -2 * q + 0.25, 0)).as_matrix()
    slid[1, 3] = 0.5 * (-2 * q + 0.25) + 1
    np.testing.assert_allclose(poses[twin], origin @ turned, atol=1e-12)
    np.testing.assert_allclose(poses[stick], origin @ turned @ origin @ slid, atol=1e-12)
    assert load_object(tmp_path).followers == obj.followers  # out of the cache


@pytest.mark.parametrize(
    ("mimic", "hinge", "says", "place"),
    [
        ('<mimic joint="nobody"/>', DOOR, "moves by itself", None),
        ('<mimic joint="hinge" multiplier="0" offset="0.5"/>', DOOR, "fixed at 0.5", 0.5),
        ('<mimic joint="hinge" offset="0.5"/>', DOOR.replace("revolute", "floating"), "fixed at 0.5", 0.5),
    ],
)
def test_followers_of_nothing(tmp_path: Path, mimic: str, hinge: str, says: str, place: float | None) -> None:
    more = follower("twin", "body", '<limit lower="0" upper="1"/>' + mimic)
    obj = load_object(put(tmp_path, robot(hinge=hinge, more=more)))
    twin = obj.index("twin")
    assert any(says in remark for remark in obj.dropped) and not obj.followers
    assert (twin in obj.movable) == (place is None)
    if place is not None:
        expected = Rotation.from_rotvec((0.3, 0, 0)) * Rotation.from_rotvec((0, place, 0))
        np.testing.assert_allclose(obj.joint_of(twin).origin[:3, :3], expected.as_matrix(), atol=1e-12)


# ------------------------------------------------------------------------------------------------ sentences


BROKEN = [
    (robot(mesh("b.obj")), "b.obj is missing"),
    (robot(mesh("package://nowhere/b.obj")), r"missing in .* assets.packages"),
    (robot(mesh("a.step")), "no .obj, .stl"),
    (robot(mesh("http://example.org/a.obj")), "no file of this machine"),
    (robot(mesh("../secret.obj")), "leaves"),
    (robot(mesh("%2e%2e/secret.obj")), "leaves"),
    (robot(mesh("package://a/../secret.obj")), "leaves"),
    (robot(mesh("package://../secret.obj")), "leaves"),
    (robot(mesh("file:///etc/passwd")), "leaves"),
    (robot(mesh("link.obj")), "leaves"),
    (robot(mesh("up/secret.obj")), "leaves"),
    (robot(mesh("b&#0;.obj".replace("&#0;", "x" * 5000))), "cannot be followed|missing"),
    (robot(mesh("a.obj", 'scale="0 1 1"')), "scale"),
    (robot(mesh("a.obj", 'scale="0"')), "scale"),
    (robot(mesh("a.obj", 'scale="1 1"')), "1 1"),
    (robot(mesh("a.obj", 'scale="a b c"')), "a b c"),
    (robot(geometry("<mesh/>")), "filename"),
    (robot(geometry("<box/>")), "size"),
    (robot(geometry('<box size="1 2"/>')), "1 2"),
    (robot(geometry('<box size="1 0 1"/>')), "size 1 0 1"),
    (robot(geometry('<sphere radius="-1"/>')), "size -1"),
    (robot(geometry('<cylinder radius="1"/>')), "length"),
    (robot(geometry('<cylinder radius="1" length="nan"/>')), "nan"),
    (robot(geometry('<capsule radius="1e9" length="1"/>')), "1e"),
    (robot(hinge=DOOR.replace("revolute", "helical")), "helical"),
    (robot(hinge=DOOR.replace('upper="1.5"', 'upper="wide"')), "no numbers"),
    (robot(hinge=DOOR.replace("</joint>", "<mimic/></joint>")), "joint"),
    (robot(hinge=DOOR.replace("</joint>", '<mimic joint="hinge"/></joint>')), "follows itself"),
    (robot(hinge=DOOR.replace("</joint>", '<mimic joint="x" multiplier="y"/></joint>')), "y"),
    (robot(more=f'<link name="stray">{BOX}</link>'), "2 roots"),
    (robot(more="<xacro:include/>"), "xacro"),
    (robot(head='<robot xmlns:xacro="http://ros.org/wiki/xacro">', more="<xacro:include/>"), "xacro .* expanded"),
    (robot(geometry('<box size="${width} 1 1"/>')), "xacro"),
    (robot(mesh("$(find my_cab)/a.obj")), "xacro"),
    ("<mujoco/>", "no URDF"),
    ("<sdf/>", "no URDF"),
    ("", "XML"),
]  # fmt: skip
"""Files that cannot be read, and what is said."""


@pytest.mark.parametrize(("urdf", "word"), BROKEN)
def test_what_cannot_be_read_ends_in_one_sentence(tmp_path: Path, urdf: str, word: str) -> None:
    folder = put(tmp_path / "a", urdf)
    (tmp_path / "secret.obj").write_bytes(written("obj")["a.obj"])
    (folder / "link.obj").symlink_to(tmp_path / "secret.obj")
    (folder / "up").symlink_to(tmp_path, target_is_directory=True)
    assert re.search(word, refuse(folder))


@pytest.mark.parametrize("kind", ["dae", "ply", "off", "glb", "gltf"])
@pytest.mark.parametrize("content", [b"", b"\x00\xff" * 50, b"half"], ids=["empty", "noise", "half"])
def test_a_broken_mesh_ends_in_one_sentence(tmp_path: Path, kind: str, content: bytes) -> None:
    if kind not in trimesh.available_formats():
        pytest.skip(f"trimesh reads no .{kind} here")
    whole = written(kind)[f"a.{kind}"]
    files = {f"a.{kind}": whole[: len(whole) // 2] if content == b"half" else content}
    assert f"a.{kind}" in refuse(put(tmp_path, robot(mesh(f"a.{kind}")), files))


def test_a_mesh_reads_no_file_outside(tmp_path: Path) -> None:
    files = written("gltf")
    (tmp_path / "secret.bin").write_bytes(next(content for name, content in files.items() if name.endswith(".bin")))
    text = re.sub(rb'"uri": *"[^"]*"', b'"uri":"../secret.bin"', files["a.gltf"])
    assert "leaves" in refuse(put(tmp_path / "a", robot(mesh("a.gltf")), {"a.gltf": text}))
    entity = b'<!DOCTYPE x [<!ENTITY e SYSTEM "file:///etc/passwd">]><COLLADA>&e;</COLLADA>'
    if "dae" in trimesh.available_formats():
        assert "entities" in refuse(put(tmp_path / "b", robot(mesh("a.dae")), {"a.dae": entity}))


RICH = robot(
    mesh("package://x/a.obj", 'scale="1 -1 1"') + geometry('<cylinder radius="0.5" length="2"/>'),
    more=follower("twin", "body", '<limit lower="0" upper="90"/><mimic joint="hinge" multiplier="-1" offset="0"/>')
    + follower("tray", "twin", '<limit lower="0" upper="1"/>', "prismatic")
    + '<link name="world"/>',
)


def mutated(rng: np.random.Generator, text: bytes = RICH.encode()) -> bytes:
    """A text, the rich URDF, with bytes changed, a tag dropped or doubled, or a value taken from elsewhere."""
    data = bytearray(text)
    for _ in range(rng.integers(1, 4)):
        kind = rng.integers(4)
        if kind == 0:
            for place in rng.integers(len(data), size=rng.integers(1, 4)):
                data[place] = rng.integers(32, 127)
            continue
        pattern = (rb"<[^>]*>", rb"<(\w+)[^>]*/>", rb'"[^"]*"')[kind - 1]
        hits = list(re.finditer(pattern, bytes(data)))
        if not hits:
            continue
        a, b = (hits[rng.integers(len(hits))] for _ in range(2))
        values = [b.group(), b"", b'"1e308"', b'"-0"', b'"nan"', b'"hinge"', b'"../a.obj"', b'""']
        other = values[rng.integers(len(values))] if kind == 3 else values[rng.integers(2)]
        data[a.start() : a.end()] = other
    return bytes(data)


def fuzz(folder: Path, seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    outcomes: Counter[bool] = Counter()
    for _ in range(count):
        put(folder, mutated(rng))
        try:
            obj = load_object(folder)
        except UserError as error:
            outcomes[False] += 1
            assert folder.name in str(error) and "\n" not in str(error)
            continue
        outcomes[True] += 1
        poses = KinematicTree.from_object(obj).forward(torch.zeros(len(obj.movable)))
        assert poses.isfinite().all()
        assert (obj.limits[:, 0] <= obj.limits[:, 1]).all()
        for link in obj.links:
            assert all(np.isfinite(each.vertices).all() for each in (*link.visuals, *link.collisions))
    assert min(outcomes.values()) > count // 20


def test_mutated_urdfs_end_in_an_object_or_a_sentence(tmp_path: Path) -> None:
    fuzz(tmp_path / "a17", 0, 300)


@pytest.mark.slow
def test_many_mutated_urdfs_end_in_an_object_or_a_sentence(tmp_path: Path) -> None:
    fuzz(tmp_path / "a17", 1, 2000)
