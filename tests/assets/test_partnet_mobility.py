"""The reader of PartNet-Mobility folders: conventions, flaws that end in one sentence, and real objects."""

from __future__ import annotations

import math
import os
import re
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from fb3d_rl.assets import partnet_mobility, urdf
from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.assets.folders import find_folders
from fb3d_rl.assets.partnet_mobility import load_object, load_objects
from fb3d_rl.errors import UserError

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 2 0\nv 0 0 3\nf 1 2 3\nf 1 3 4\n"
SHAPE = """<{tag}><origin xyz="0.5 -1 2" rpy="0.3 -0.7 1.9"/>
<geometry><mesh filename="textured_objs/a.obj"{scale}/></geometry></{tag}>"""
LINK = f"""<link name="LINK">{SHAPE.format(tag="visual", scale="")}{SHAPE.format(tag="collision", scale="")}</link>"""


def joint(name: str, kind: str, parent: str, child: str, inside: str = "") -> str:
    return f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>{inside}</joint>'


def link(name: str) -> str:
    return LINK.replace("LINK", name)


DOOR = '<origin xyz="1 2 3" rpy="0.1 0.2 0.3"/><axis xyz="0 3 4"/><limit lower="-0.5" upper="1.25"/>'
# Children come before their parents, as in the dataset.
GOOD = (
    '<robot name="r"><link name="base"/>' + link("knob") + link("door") + link("body") + link("wheel")
    + joint("j_knob", "prismatic", "door", "knob", '<axis xyz="0 0 -2"/><limit lower="0" upper="0.1"/>')
    + joint("j_door", "revolute", "body", "door", DOOR)
    + joint("j_body", "fixed", "base", "body", '<origin rpy="1.5707963 0 -1.5707963" xyz="0 0 0"/>')
    + joint("j_wheel", "continuous", "body", "wheel", '<limit lower="0" upper="1"/>')
    + "</robot>"
)  # fmt: skip


def write(folder: Path, urdf: str | bytes = GOOD, mesh: str | bytes = TRIANGLE) -> Path:
    (folder / "textured_objs").mkdir(parents=True, exist_ok=True)
    (folder / "mobility.urdf").write_bytes(urdf.encode() if isinstance(urdf, str) else urdf)
    (folder / "textured_objs/a.obj").write_bytes(mesh.encode() if isinstance(mesh, str) else mesh)
    (folder / "semantics.txt").write_text("door hinge rotation_door\nknob slider knob\nbroken\n\n")
    (folder / "meta.json").write_text('{"model_cat": "Safe"}')
    return folder


def refuse(folder: Path) -> str:
    """The sentence with which the object is refused; it names the object."""
    with pytest.raises(UserError) as error:
        load_object(folder)
    sentence = str(error.value)
    assert folder.name in sentence and "\n" not in sentence
    return sentence


@pytest.fixture
def good(tmp_path: Path) -> ArticulatedObject:
    return load_object(write(tmp_path / "a17"))


def test_links_come_parents_first_with_names_and_category(good: ArticulatedObject) -> None:
    assert good.id == "a17" and good.category == "Safe"
    assert {x.name for x in good.links} == {"base", "body", "door", "knob", "wheel"}
    parents = {x.name: good.links[x.parent].name if x.parent >= 0 else None for x in good.links}
    assert parents == {"base": None, "body": "base", "door": "body", "knob": "door", "wheel": "body"}
    assert all(x.parent < i for i, x in enumerate(good.links))
    assert {x.name: x.semantic for x in good.links if x.semantic} == {"door": "rotation_door", "knob": "knob"}
    assert [good.links[i].name for i in good.descendants(good.index("door"))] == ["door", "knob"]
    assert not good.dropped


def test_joints_have_urdfs_conventions(good: ArticulatedObject) -> None:
    by_name = {x.name: good.joint_of(good.index(x.name)) for x in good.links if x.parent >= 0}
    door = by_name["door"]
    np.testing.assert_allclose(door.axis, [0.0, 0.6, 0.8])
    np.testing.assert_allclose(door.origin[:3, 3], [1, 2, 3])
    # rpy turns about the fixed axes: roll about x first, yaw about z last.
    roll, pitch, yaw = (Rotation.from_rotvec(angle * np.eye(3)[i]) for i, angle in enumerate((0.1, 0.2, 0.3)))
    np.testing.assert_allclose(door.origin[:3, :3], (yaw * pitch * roll).as_matrix(), atol=1e-12)
    assert door.limits == (-0.5, 1.25) and door.type == "revolute"
    np.testing.assert_allclose(by_name["knob"].axis, [0, 0, -1])
    assert by_name["knob"].limits == (0.0, 0.1)
    assert by_name["wheel"].limits == (-math.inf, math.inf) and by_name["wheel"].type == "continuous"
    np.testing.assert_allclose(by_name["wheel"].axis, [1, 0, 0])  # URDF's default
    assert by_name["body"].limits == (0.0, 0.0) and not by_name["body"].movable
    np.testing.assert_allclose(by_name["body"].origin[:3, :3] @ [0, 0, 1], [-1, 0, 0], atol=1e-6)  # front faces -x
    np.testing.assert_allclose(by_name["body"].origin[:3, :3] @ [0, 1, 0], [0, 0, 1], atol=1e-6)
    assert [good.links[i].name for i in good.movable] == [x.name for x in good.links if x.name not in ("base", "body")]
    np.testing.assert_array_equal(good.limits, [by_name[good.links[i].name].limits for i in good.movable])


def test_meshes_stand_in_their_links_frame(tmp_path: Path) -> None:
    scaled = GOOD.replace('a.obj"/>', 'a.obj" scale="2 -1 0.5"/>', 1)
    obj = load_object(write(tmp_path / "a", scaled))
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]], dtype=float)
    turn = Rotation.from_euler("ZYX", [1.9, -0.7, 0.3])
    (visual,) = obj.links[obj.index("knob")].visuals
    (collision,) = obj.links[obj.index("knob")].collisions
    np.testing.assert_allclose(visual.vertices, turn.apply(vertices * [2, -1, 0.5]) + [0.5, -1, 2], atol=1e-12)
    np.testing.assert_allclose(collision.vertices, turn.apply(vertices) + [0.5, -1, 2], atol=1e-12)
    np.testing.assert_array_equal(collision.faces, [[0, 1, 2], [0, 2, 3]])
    np.testing.assert_array_equal(visual.faces, [[2, 1, 0], [3, 2, 0]])  # its scale mirrors


@pytest.mark.parametrize("scale", ["1 1 1", "-1 2 1", "1 -1 -0.5", "-1 -1 -1"])
def test_a_solid_stays_a_solid_whatever_its_scale(tmp_path: Path, scale: str) -> None:
    box = trimesh.creation.box((1, 2, 3)).export(file_type="obj")
    urdf = GOOD.replace('a.obj"/>', f'a.obj" scale="{scale}"/>')
    knob = (obj := load_object(write(tmp_path / "a", urdf, box))).links[obj.index("knob")]
    for mesh in (*knob.visuals, *knob.collisions):
        volume = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).volume
        assert volume == pytest.approx(6.0 * abs(np.prod([float(word) for word in scale.split()])))


def test_what_is_looked_at_has_each_point_and_triangle_once(tmp_path: Path) -> None:
    """As in the dataset: a point for each corner, and triangles for both sides."""
    mesh = "v 0 0 0\nv 1 0 0\nv 0 2 0\nv 0 0 0\nv 0 2 0\nv 0 0 3\nf 1 2 3\nf 4 5 6\nf 3 2 1\nf 1 3 6\n"
    door = next(item for item in load_object(write(tmp_path, mesh=mesh)).links if item.name == "door")
    (seen,), (touched,) = door.visuals, door.collisions
    assert (len(seen.vertices), len(seen.faces)) == (4, 2)
    assert (len(touched.vertices), len(touched.faces)) == (6, 4)  # for PhysX a triangle has one side
    np.testing.assert_array_equal(seen.vertices[seen.faces], touched.vertices[touched.faces[:2]])
    np.testing.assert_array_equal(seen.vertices.max(0), touched.vertices.max(0))


def test_flaws_that_do_no_harm_are_named_and_dropped(tmp_path: Path) -> None:
    urdf = GOOD.replace('<limit lower="-0.5" upper="1.25"/>', '<limit lower="1" upper="-1"/>')
    urdf = urdf.replace("<visual>", "<visual><geometry><torus/></geometry></visual><visual>", 1)
    obj = load_object(write(tmp_path / "a", urdf))
    assert obj.joint_of(obj.index("door")).limits == (-1.0, 1.0)
    assert len(obj.links[obj.index("knob")].visuals) == 1
    for word in ("j_door", "knob"):
        assert any(word in entry for entry in obj.dropped)
    flat = load_object(write(tmp_path / "b", mesh="v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n"))
    assert not any(x.visuals for x in flat.links) and any("a.obj" in entry for entry in flat.dropped)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("<visual>", "<visual><geometry><torus/></geometry></visual><visual>", "1 visual of knob: <torus> in place"),
        ("<collision>", 2 * "<collision><geometry><plane/></geometry></collision>" + "<collision>",
         "2 collisions of knob: <plane> in place"),
        ("<visual>", "<visual/><visual>", "1 visual of knob: no shape"),
        ("</geometry>", "<cone/></geometry>", "1 visual of knob: <cone>"),
    ],
)  # fmt: skip
def test_geometry_that_is_lost_is_told_from_harmless_flaws(tmp_path: Path, old: str, new: str, says: str) -> None:
    folder = write(tmp_path / "a", GOOD.replace(old, new, 1))
    (folder / "semantics.txt").unlink()
    obj = load_object(folder)
    assert len(obj.lost) == 1 and says in obj.lost[0]
    assert sorted(obj.dropped) == sorted([*obj.lost, "semantics.txt: missing"])


def test_an_object_without_a_mesh_is_skipped_by_name(tmp_path: Path) -> None:
    urdf = re.sub(r"<mesh [^>]*/>", "<torus/>", GOOD)
    objects, skipped = load_objects([write(tmp_path / "good"), write(tmp_path / "boxes", urdf)])
    assert [obj.id for obj in objects] == ["good"]
    (boxes,) = skipped
    for words in ("object boxes: no link has a visual mesh", "<torus> in place of a mesh", "and 5 more"):
        assert words in boxes.reason


def test_triangles_are_remarked_and_kept(tmp_path: Path) -> None:
    obj = load_object(write(tmp_path / "a", mesh="v 0 0 0\nv 1 0 0\nv 0 2 0\nv 0 2 0\nf 1 2 4\n"))
    assert all(link.collisions for link in obj.links if link.name != "base")
    (remark,) = obj.dropped
    assert "a.obj" in remark and "plate" in remark and not obj.lost


def test_missing_side_files_leave_names_empty(tmp_path: Path) -> None:
    folder = write(tmp_path / "a")
    (folder / "semantics.txt").unlink()
    (folder / "meta.json").unlink()
    obj = load_object(folder)
    assert obj.category == "unknown" and not any(x.semantic for x in obj.links)


BOMB = '<!DOCTYPE r [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;&a;">]><robot name="&b;"/>'
OUTSIDE = '<!DOCTYPE r [<!ENTITY a SYSTEM "file:///etc/passwd">]><robot>&a;</robot>'
LOOP = joint("l1", "fixed", "x", "y") + joint("l2", "fixed", "y", "x")


@pytest.mark.parametrize(
    ("urdf", "word"),
    [
        ("", "XML"),
        (b"\x89PNG\r\n\x1a\n\x00\x00", "XML"),
        (GOOD[:-20], "XML"),
        ('<?xml version="1.0" encoding="nonsense"?>' + GOOD, "XML"),
        ('<?xml version="1.0" encoding="big5"?>' + GOOD, "XML"),
        (BOMB, "XML"),
        (OUTSIDE, "XML"),
        ("<html/>", "no <robot>"),
        ("<robot/>", "roots"),
        (GOOD.replace("a.obj", "b.obj"), "b.obj is missing"),
        (GOOD.replace("textured_objs/a.obj", "../secret.obj"), "leaves"),
        (GOOD.replace("textured_objs/a.obj", "/etc/passwd"), "leaves"),
        (GOOD.replace("textured_objs/a.obj", "meta.json"), "no .obj"),
        (GOOD.replace("</robot>", link("x") + link("y") + LOOP + "</robot>"), "loop"),
        (GOOD.replace("</robot>", link("x") + "</robot>"), "2 roots"),
        (GOOD.replace("</robot>", link("knob") + "</robot>"), "two links"),
        (GOOD.replace("</robot>", joint("twice", "fixed", "body", "knob") + "</robot>"), "two joints"),
        (GOOD.replace("</robot>", joint("self", "fixed", "base", "base") + "</robot>"), "roots"),
        (GOOD.replace('parent link="body"', 'parent link="bdoy"'), "bdoy"),
        (GOOD.replace('<child link="door"/>', ""), "j_door"),
        (GOOD.replace('axis xyz="0 3 4"', 'axis xyz="0 0 0"'), "axis"),
        (GOOD.replace('axis xyz="0 3 4"', 'axis xyz="0 nan 4"'), "nan"),
        (GOOD.replace('axis xyz="0 3 4"', 'axis xyz="0 4"'), "0 4"),
        (GOOD.replace('xyz="1 2 3"', 'xyz="1 2 inf"'), "inf"),
        (GOOD.replace('rpy="0.1 0.2 0.3"', 'rpy="0.1 0.2 x"'), "0.1 0.2 x"),
        (GOOD.replace('upper="1.25"', 'upper="nan"'), "j_door"),
        (GOOD.replace('upper="1.25"', 'upper="wide"'), "j_door"),
        (GOOD.replace('"prismatic"', '"screw"'), "screw"),
        (GOOD.replace('a.obj"/>', 'a.obj" scale="1 0 1"/>'), 'scale="1 0 1"'),
        (GOOD.replace('name="j_knob" ', ""), "name"),
    ],
)  # fmt: skip
def test_broken_urdfs_end_in_one_sentence(tmp_path: Path, urdf: str | bytes, word: str) -> None:
    (tmp_path / "secret.obj").write_text(TRIANGLE)
    assert urdf != GOOD
    assert word in refuse(write(tmp_path / "a17", urdf))


def test_a_link_out_of_the_folder_is_refused(tmp_path: Path) -> None:
    folder = write(tmp_path / "a17")
    (tmp_path / "secret.obj").write_text(TRIANGLE)
    (folder / "textured_objs/a.obj").unlink()
    (folder / "textured_objs/a.obj").symlink_to(tmp_path / "secret.obj")
    assert "leaves" in refuse(folder)


@pytest.mark.parametrize(
    "mesh",
    [
        "v 0 0 0\nv 1 0 0\nf 1 2 9\n",
        "v a b c\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
        "v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
        "v 0 0\nv 1 0\nv 0 1\nf 1 2 3\n",
        "v 0 0\nv 1 0\nv 0 1\nv 1 1\nf 1 2 3\n",
        "v 0 0 0\nv 1 0 0\nv 0 2 0\nv 0 003\nf 1 2 3\nf 1 3 4\n",
    ],
)
def test_broken_meshes_end_in_one_sentence(tmp_path: Path, mesh: str) -> None:
    assert "a.obj" in refuse(write(tmp_path / "a17", mesh=mesh))


def test_missing_folders_and_broken_side_files_end_in_one_sentence(tmp_path: Path) -> None:
    assert "does not exist" in refuse(tmp_path / "nowhere")
    for text in ("{", "[" * 100_000):
        folder = write(tmp_path / "a17")
        (folder / "meta.json").write_text(text)
        assert "meta.json" in refuse(folder)


def test_load_objects_skips_and_names_broken_ones(tmp_path: Path) -> None:
    for name in ("good", "fine"):
        write(tmp_path / name)
    write(tmp_path / "bad", "<robot>")
    objects, skipped = load_objects([tmp_path / name for name in ("good", "bad", "fine")])
    assert [obj.id for obj in objects] == ["good", "fine"]
    assert [item.id for item in skipped] == ["bad"] and "bad" in skipped[0].reason
    with pytest.raises(UserError, match="object bad"):
        load_objects([tmp_path / "bad"])


def test_sizes_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Before a file is read: the limits are far above what real objects have."""
    folder = write(tmp_path / "a17")
    monkeypatch.setattr(urdf, "MOST_LINKS", 4)
    assert "5 links" in refuse(write(folder, GOOD + " "))  # not yet in the cache
    monkeypatch.undo()
    size = (folder / "textured_objs/a.obj").stat().st_size
    monkeypatch.setattr(partnet_mobility, "LARGEST_OBJECT", size)
    load_object(folder)
    monkeypatch.setattr(partnet_mobility, "LARGEST_OBJECT", size - 1)
    assert "meshes" in refuse(folder)
    monkeypatch.setattr(partnet_mobility, "LARGEST_TEXT", 20)
    assert "larger" in refuse(folder)


@pytest.mark.parametrize(
    ("good", "bad", "word"),
    [
        ('xyz="1 2 3"', 'xyz="1 2 1e200"', "1e\\+200 m away"),
        ('a.obj"/>', 'a.obj" scale="1 1 1e300"/>', "from its link"),
    ],
)
def test_objects_beyond_measure_are_refused(tmp_path: Path, good: str, bad: str, word: str) -> None:
    assert re.search(word, refuse(write(tmp_path / "a17", GOOD.replace(good, bad))))


def test_limits_beyond_measure_count_as_missing(tmp_path: Path) -> None:
    obj = load_object(write(tmp_path / "a17", GOOD.replace('upper="1.25"', 'upper="1e300"')))
    assert obj.joint_of(obj.index("door")).limits == pytest.approx((-0.5, math.pi / 2 - 0.5))
    assert "j_door" in obj.dropped[0]


def test_a_decomposed_part_collides_piece_by_piece(tmp_path: Path) -> None:
    """ManiSkill's mobility_cvx.urdf goes before mobility.urdf; several convex pieces lie in one collision file."""
    two = TRIANGLE + "v 5 0 0\nv 6 0 0\nv 5 2 0\nv 5 0 3\nf 5 6 7\nf 5 7 8\n"
    folder = write(tmp_path / "a17", GOOD.replace('lower="-0.5"', 'lower="-0.25"'), two)
    (folder / "mobility.urdf").rename(folder / "mobility_cvx.urdf")
    write(folder, mesh=two)
    obj = load_object(folder)
    assert obj.urdf.name == "mobility_cvx.urdf"
    door = obj.links[obj.index("door")]
    assert obj.joint_of(obj.index("door")).limits == (-0.25, 1.25)
    assert len(door.visuals) == 1 and len(door.collisions) == 2
    assert sorted(len(mesh.vertices) for mesh in door.collisions) == [4, 4]
    # A third piece has no volume.
    three = load_object(write(folder, mesh=two + "v 9 0 0\nv 9 1 0\nv 9 0 1\nf 9 10 11\n"))
    assert len(three.links[three.index("door")].collisions) == 3 and "plate" in three.dropped[0]
    write(folder, mesh=two)
    (folder / "mobility_cvx.urdf").unlink()
    whole = load_object(folder)
    assert len(whole.links[whole.index("door")].collisions) == 1


def test_binary_meshes_are_read(tmp_path: Path) -> None:
    folder = write(tmp_path / "a17", GOOD.replace("a.obj", "a.STL"))
    trimesh.creation.box((1, 2, 3)).export(folder / "textured_objs/a.STL", file_type="stl")
    (mesh,) = (obj := load_object(folder)).links[obj.index("door")].collisions
    assert len(mesh.faces) == 12
    (folder / "textured_objs/a.STL").write_bytes(b"solid\0" * 30)
    empty = load_object(folder)
    assert not any(link.visuals for link in empty.links) and "textured_objs/a.STL: no surface" in empty.dropped


def mutated(rng: np.random.Generator) -> bytes:
    """A good URDF with some bytes flipped, a tag dropped or doubled, or a value swapped for another."""
    data = bytearray(GOOD.encode())
    kind = rng.integers(4)
    if kind == 0:
        for place in rng.integers(len(data), size=rng.integers(1, 6)):
            data[place] = rng.integers(256)
        return bytes(data)
    pattern = (rb"<[^>]*>", rb"<(\w+)[^>]*/>", rb'"[^"]*"')[kind - 1]
    hits = list(re.finditer(pattern, bytes(data)))
    a = hits[rng.integers(len(hits))]
    b = hits[rng.integers(len(hits))]
    return bytes(data[: a.start()] + (b.group() if rng.random() < 0.7 else b"") + data[a.end() :])


def test_mutated_urdfs_end_in_an_object_or_a_sentence(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    outcomes: Counter[bool] = Counter()
    for _ in range(1000):
        folder = write(tmp_path / "a17", mutated(rng))
        try:
            obj = load_object(folder)
        except UserError as error:
            outcomes[False] += 1
            assert "a17" in str(error)
            continue
        outcomes[True] += 1
        for i, part in enumerate(obj.links):
            assert part.parent < i
            if part.joint is not None and part.joint.movable:
                assert np.linalg.norm(part.joint.axis) == pytest.approx(1.0)
                assert part.joint.limits[0] <= part.joint.limits[1]
    assert min(outcomes.values()) > 20  # the mutations are neither all harmless nor all fatal


def test_mutated_meshes_end_in_an_object_or_a_sentence(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    outcomes: Counter[bool] = Counter()
    for _ in range(200):
        data = bytearray(TRIANGLE.encode())
        for place in rng.integers(len(data), size=rng.integers(1, 5)):
            data[place] = rng.choice(list(b"0123456789 -/.\nvf#e")) if rng.random() < 0.8 else rng.integers(256)
        try:
            obj = load_object(write(tmp_path / "a17", mesh=bytes(data)))
        except UserError as error:
            outcomes[False] += 1
            assert "a17" in str(error)
        else:
            meshes = [m for part in obj.links for m in part.visuals]
            outcomes[True] += bool(meshes)
            for mesh in meshes:
                assert np.isfinite(mesh.vertices[mesh.faces]).all()
    assert min(outcomes[False], outcomes[True]) > 20


@pytest.mark.slow
def test_every_real_object_loads_with_the_joints_of_its_file(real_root: Path) -> None:
    folders = find_folders(real_root)
    objects, skipped = load_objects(folders.values())
    assert not skipped and [obj.id for obj in objects] == list(folders)
    for obj in objects:
        # Counted in the raw text, not by an XML parser.
        raw = Counter(re.findall(r'<joint\b[^>]*\btype="(\w+)"', obj.urdf.read_text(encoding="utf-8")))
        assert Counter(x.joint.type for x in obj.links if x.joint is not None) == raw
        assert len(obj.links) == sum(raw.values()) + 1
        assert os.path.samefile(obj.urdf.parent, real_root / obj.id)
        assert obj.category != "unknown"
        assert any(x.visuals for x in obj.links)
