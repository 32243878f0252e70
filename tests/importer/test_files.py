"""Files of other makers: found in any layout, brought to metres and the project's axes, written as folders."""

from __future__ import annotations

import json
import math
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.assets.options import AssetsOptions
from fb3d_rl.assets.partnet_mobility import load_object
from fb3d_rl.errors import UserError
from fb3d_rl.importer.catalog import files_catalog, find_objects, path_catalog
from fb3d_rl.importer.files import find_files
from fb3d_rl.importer.folders import write_folder
from fb3d_rl.importer.frames import Frame, front_of, scaled, unit_of
from fb3d_rl.importer.reading import examine_file, read_file
from fb3d_rl.kinematics.opening import standing_bounds
from fb3d_rl.kinematics.tree import KinematicTree

# A cupboard, 0.5 m deep, 0.75 m wide and 1 m high, that faces -x: a door above, a drawer below, and a knob.
CUPBOARD = """<robot name="r"><link name="body">BODY</link><link name="upper_door">DOOR</link>
<link name="drawer_1">DRAWER</link><link name="knob_1">KNOB</link>
<joint name="hinge" type="revolute"><origin xyz="-0.25 0.375 0.75"/><parent link="body"/><child link="upper_door"/>
<axis xyz="0 0 -1"/><limit lower="0" upper="1.5"/></joint>
<joint name="rail" type="prismatic"><origin xyz="-0.25 0 0.25"/><parent link="body"/><child link="drawer_1"/>
<axis xyz="-1 0 0"/><limit lower="0" upper="0.25"/></joint>
<joint name="turn" type="revolute"><origin xyz="0 0 1.0"/><parent link="body"/><child link="knob_1"/><axis xyz="0 0 1"/>
<limit lower="0" upper="3"/></joint></robot>"""
BOXES = {
    "BODY": ((0.5, 0.75, 1.0), (0.0, 0.0, 0.5)),
    "DOOR": ((0.02, 0.75, 0.5), (-0.01, -0.375, 0.0)),
    "DRAWER": ((0.25, 0.75, 0.5), (0.1, 0.0, 0.0)),
    "KNOB": ((0.05, 0.05, 0.05), (0.0, 0.0, 0.025)),
}


def cupboard(unit: float = 1.0) -> str:
    """The cupboard of primitives; its lengths are ``unit`` times as large."""
    text = CUPBOARD
    for name, (size, centre) in BOXES.items():
        box = f'<origin xyz="{words(centre, unit)}"/><geometry><box size="{words(size, unit)}"/></geometry>'
        text = text.replace(name, f"<visual>{box}</visual><collision>{box}</collision>")
    text = re.sub(
        r'<origin xyz="([^"]*)"/><parent',
        lambda m: m.group().replace(m[1], words(map(float, m[1].split()), unit)),
        text,
    )
    return text.replace('upper="0.25"', f'upper="{0.25 * unit}"')


def words(values: object, unit: float) -> str:
    return " ".join(str(unit * value) for value in values)  # type: ignore[attr-defined]


def put(path: Path, text: str | None = None) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(cupboard() if text is None else text, encoding="utf-8")
    return path


def read(path: Path, *frame: object) -> ArticulatedObject:
    (source,) = find_files(path)
    return read_file(source, Frame(*frame))  # type: ignore[arg-type]


def assert_same(one: ArticulatedObject, two: ArticulatedObject, turn: np.ndarray | None = None) -> None:
    """Poses and surfaces of all links of ``one`` are those of ``two``, turned by T [4, 4], in several joint states."""
    assert [two.links[i].name for i in two.movable] == [one.links[i].name for i in one.movable]
    np.testing.assert_allclose(one.limits, two.limits, atol=1e-6)
    for share in (0.0, 0.3, 1.0):
        low, high = np.clip(two.limits, -7, 7).T  # of those without limits, too
        state = torch.as_tensor(low + share * (high - low))
        poses = [KinematicTree.from_object(obj).forward(state).numpy() for obj in (one, two)]
        for i, link in enumerate(two.links):
            j = one.index(link.name)
            np.testing.assert_allclose(poses[0][j], (np.eye(4) if turn is None else turn) @ poses[1][i], atol=1e-6)
            for a, b in ((one.links[j].visuals, link.visuals), (one.links[j].collisions, link.collisions)):
                for made, wanted in zip(a, b, strict=True):
                    np.testing.assert_allclose(made.vertices[made.faces], wanted.vertices[wanted.faces], atol=1e-6)


@pytest.fixture
def original(tmp_path: Path) -> ArticulatedObject:
    return read(put(tmp_path / "original/cupboard.urdf"))


def about_z(quarters: int) -> np.ndarray:
    return np.round(trimesh.transformations.rotation_matrix(quarters * math.pi / 2, (0, 0, 1)), 12)


# ----------------------------------------------------------------------------------------------- finding files


def test_files_are_found_in_any_layout(tmp_path: Path) -> None:
    put(tmp_path / "side.urdf")
    put(tmp_path / "by side.URDF")
    put(tmp_path / "Microwave/mw 1/model.urdf")
    put(tmp_path / "safe/model.urdf")
    put(tmp_path / "other.xml")
    put(tmp_path / "scene.xml", "<!-- <robot> --><sdf/>")
    put(tmp_path / "part.xml", "<mujocoinclude/>")
    put(tmp_path / "Oven/7/mobility.urdf")
    put(tmp_path / ".hidden/x.urdf")
    found = {source.id: source for source in find_files(tmp_path)}
    assert sorted(found) == ["7", "by side", "mw 1_model", "other", "safe_model", "side"]
    assert {name: source.category for name, source in found.items() if source.category != "unknown"} == {
        "7": "Oven", "mw 1_model": "Microwave",
    }  # fmt: skip
    assert found["7"].partnet and not found["side"].partnet


def test_a_file_a_folder_and_a_list_are_named_alike(tmp_path: Path) -> None:
    one, two = put(tmp_path / "a/one.anything"), put(tmp_path / "b/two.urdf")
    assert [source.id for source in find_files(one)] == ["one"]
    assert [source.id for source in find_files([str(one), tmp_path / "b", two])] == ["one", "two"]
    with pytest.raises(UserError, match="does not exist"):
        find_files(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match="no object is described"):
        find_files(tmp_path / "empty")
    with pytest.raises(UserError, match="assets.packages"):
        find_files(one, [tmp_path / "nowhere"])


def test_a_package_is_read_if_it_was_named(tmp_path: Path) -> None:
    """Meshes beside the folder of the URDF, as in ROS, and shared ones: never outside of what was named."""
    box = trimesh.creation.box((0.5, 0.75, 1.0)).export(file_type="obj")
    package = tmp_path / "ws/my_cab"
    (package / "meshes").mkdir(parents=True)
    (package / "meshes/a.obj").write_text(box)
    shape = re.compile(r'<box size="0.5 0.75 1.0"/>')
    for number, name in enumerate(("package://my_cab/meshes/a.obj", "../meshes/a.obj")):
        put(package / f"urdf/cab{number}.urdf", shape.sub(f'<mesh filename="{name}"/>', cupboard()))
    assert all(examine_file(source).usable for source in find_files(package))
    assert all(examine_file(source).usable for source in find_files(tmp_path))
    for source in find_files(package / "urdf"):
        assert re.search("leaves|missing", examine_file(source).findings[0].what)
    assert all(examine_file(source).usable for source in find_files(package / "urdf", [package]))
    shared = put(tmp_path / "x/cab.urdf", shape.sub('<mesh filename="package://my_cab/meshes/a.obj"/>', cupboard()))
    assert examine_file(find_files(shared, [tmp_path / "ws"])[0]).usable
    outside = put(tmp_path / "x/y/cab.urdf", shape.sub('<mesh filename="../../ws/my_cab/meshes/a.obj"/>', cupboard()))
    assert "leaves" in examine_file(find_files(outside)[0]).findings[0].what


# ---------------------------------------------------------------------------------------------- units and axes


def test_parts_are_known_by_the_names_of_their_links(original: ArticulatedObject) -> None:
    assert {link.name: link.semantic for link in original.links} == {
        "body": "", "upper_door": "door", "drawer_1": "drawer", "knob_1": "knob",
    }  # fmt: skip
    assert not original.dropped and front_of(original) == "-x"


def test_millimetres_are_recognised_and_said(tmp_path: Path, original: ArticulatedObject) -> None:
    obj = read(put(tmp_path / "a.urdf", cupboard(1000.0)))
    assert_same(obj, original)
    assert len(obj.dropped) == 1 and "millimetres" in obj.dropped[0]
    rail = read(put(tmp_path / "b.urdf", cupboard(1000.0).replace('upper="250.0"', 'upper="0.25"')))
    assert_same(rail, original)
    assert any("rail" in remark for remark in rail.dropped)
    far = read(put(tmp_path / "c.urdf", cupboard().replace('upper="0.25"', 'upper="250"')))
    assert_same(far, original)
    assert_same(
        read(put(tmp_path / "d.urdf", cupboard(39.37)), 0.0254),
        read(put(tmp_path / "e.urdf", cupboard(39.37 * 0.0254))),
    )


@pytest.mark.parametrize(
    ("per_metre", "board", "taken", "other"),
    [
        (100.0, 0.02, "centimetres", "inches"),
        (1 / 0.0254, 0.02, "inches", "centimetres"),
        (100.0, 0.2, "centimetres", "inches"),
        (1000.0, 0.02, "millimetres", None),
    ],
)
def test_units_are_recognised_by_size_and_boards(
    tmp_path: Path, per_metre: float, board: float, taken: str, other: str | None
) -> None:
    """What fits as well is named, with the word that settles it; that word gives the same object without a doubt."""
    text, metres = (
        cupboard(unit).replace(f'size="{unit * 0.02} ', f'size="{unit * board} ') for unit in (per_metre, 1.0)
    )
    obj = read(put(tmp_path / "a.urdf", text))
    assert_same(obj, read(put(tmp_path / "b.urdf", metres)))
    [remark] = obj.dropped
    assert f"taken as {taken}" in remark and ("may be" in remark) == (other is not None)
    if other is not None:
        assert other in remark
        unit = {"centimetres": "cm", "inches": "inch"}[taken]
        told = read(put(tmp_path / "c.urdf", text), AssetsOptions(scale=unit).metres)
        assert_same(told, obj)
        assert "may be" not in told.dropped[0]


@pytest.mark.parametrize(
    ("size", "unit", "others"),
    [
        (1.9, "m", []), (4.9, "m", []), (12.0, "m", ["inch"]), (19.9, "m", ["inch"]), (20.1, "cm", ["inch"]),
        (60.0, "cm", ["inch"]), (198.0, "cm", []), (210.0, "mm", ["cm"]), (499.0, "mm", ["cm"]), (2000.0, "mm", []),
        (30000.0, "mm", []),
    ],
)  # fmt: skip
def test_which_sizes_are_plausible(original: ArticulatedObject, size: float, unit: str, others: list[str]) -> None:
    """Of an object whose boards tell nothing: they are too thin in all units."""
    found, said = unit_of(scaled(original, 1e-4, {}), size)
    assert found == unit and re.findall(r"scale=(\w+)", said) == others
    assert bool(said) == (unit != "m" or bool(others))


@pytest.mark.parametrize(("per_metre", "word"), [(100.0, "centimetres"), (1000.0, "millimetres")])
def test_meshes_in_other_units_than_the_joints(
    tmp_path: Path, original: ArticulatedObject, per_metre: float, word: str
) -> None:
    text = cupboard()
    for number, (size, _) in enumerate(BOXES.values()):
        solid = trimesh.creation.box(np.array(size) * per_metre)
        (tmp_path / f"{number}.obj").write_text(solid.export(file_type="obj", digits=12))
        text = text.replace(f'<box size="{words(size, 1.0)}"/>', f'<mesh filename="{number}.obj"/>')
    obj = read(put(tmp_path / "a.urdf", text))
    np.testing.assert_allclose(standing_bounds(obj), standing_bounds(original), atol=1e-6)
    assert any("meshes" in remark and word in remark for remark in obj.dropped)


@pytest.mark.parametrize(("front", "quarters"), [("+y", 3), ("+x", 2), ("-y", 1)])
def test_a_front_is_turned_to_face_the_camera(
    tmp_path: Path, original: ArticulatedObject, front: str, quarters: int
) -> None:
    """An object whose parts open towards another side is turned back, unasked and when told."""
    angle = quarters * math.pi / 2
    world = (
        f'<joint name="w" type="fixed"><origin rpy="0 0 {angle}"/><parent link="world"/><child link="body"/></joint>'
    )
    turned = put(tmp_path / "a.urdf", cupboard().replace("</robot>", f'<link name="world"/>{world}</robot>'))
    assert front_of(read(turned, "auto", "z", "-x")) == front
    for obj in (read(turned), read(turned, "auto", "z", front)):
        assert front_of(obj) == "-x" and any(front in remark for remark in obj.dropped)
        base = np.eye(4)
        for link in original.links:
            at = KinematicTree.from_object(obj).forward(torch.zeros(3)).numpy()[obj.index(link.name)]
            before = KinematicTree.from_object(original).forward(torch.zeros(3)).numpy()[original.index(link.name)]
            np.testing.assert_allclose(at, base @ before, atol=1e-6)


def test_a_root_that_is_seen_is_turned_too(tmp_path: Path, original: ArticulatedObject) -> None:
    obj = read(put(tmp_path / "a.urdf"), "auto", "z", "+y")
    assert_same(obj, original, about_z(1))


def test_y_up(tmp_path: Path, original: ArticulatedObject) -> None:
    """The cupboard lies on its back in a file whose y points up; the file's +z is -y then."""
    ends = '<parent link="world"/><child link="body"/></joint>'
    world = f'<joint name="w" type="fixed"><origin rpy="-1.5707963267948966 0 0"/>{ends}'
    lying = put(tmp_path / "a.urdf", cupboard().replace("</robot>", f'<link name="world"/>{world}</robot>'))
    obj = read(lying, "auto", "y")
    np.testing.assert_allclose(standing_bounds(obj), standing_bounds(original), atol=1e-6)
    assert any("y pointed up" in remark for remark in obj.dropped)


def test_the_front_of_procedural_objects(objects: dict[str, ArticulatedObject]) -> None:
    assert {name: front_of(obj) for name, obj in objects.items()} == dict.fromkeys(objects, "-x")


def test_lids_and_sashes_have_a_front(tmp_path: Path) -> None:
    """A lid opens towards the side opposite its hinge; a sash that slides within its frame lies on the front."""
    lid = cupboard().replace('<axis xyz="0 0 -1"/>', '<axis xyz="1 0 0"/>')
    lid = re.sub(r"<joint name=.rail.*?</joint>|<link name=.drawer.*?</link>", "", lid, flags=re.DOTALL)
    lid = lid.replace('xyz="-0.25 0.375 0.75"/><parent', 'xyz="0 0.375 1.1"/><parent')
    lid = lid.replace('size="0.02 0.75 0.5"', 'size="0.5 0.75 0.02"')
    assert front_of(read(put(tmp_path / "lid.urdf", lid), "auto", "z", "-x")) == "-y"
    sash = re.sub(r"<joint name=.rail.*?</joint>|<link name=.drawer.*?</link>", "", cupboard(), flags=re.DOTALL)
    sash = sash.replace('name="hinge" type="revolute"', 'name="hinge" type="prismatic"').replace(
        'axis xyz="0 0 -1"', 'axis xyz="0 -1 0"'
    )
    sash = sash.replace('size="0.02 0.75 0.5"', 'size="0.02 0.3 0.5"').replace(
        'xyz="-0.01 -0.375 0.0"', 'xyz="-0.01 -0.15 0.0"'
    )
    sash = sash.replace('upper="1.5"', 'upper="0.4"')
    assert front_of(read(put(tmp_path / "sash.urdf", sash), "auto", "z", "-x")) == "-x"


def test_partnet_objects_keep_their_axes(procedural_root: Path, tmp_path: Path) -> None:
    shutil.copytree(procedural_root, tmp_path / "root")
    for entry in files_catalog(AssetsOptions(source="files", root=str(tmp_path / "root"))):
        obj, plain = entry.load(), load_object(tmp_path / "root" / entry.id)
        assert_same(obj, plain)
        assert obj.category == plain.category and obj.content == plain.content


# -------------------------------------------------------------------------------------------- folders, catalogs


def test_a_written_folder_is_the_object(tmp_path: Path) -> None:
    text = cupboard().replace(
        '<axis xyz="0 0 1"/>', '<axis xyz="0.6 0 0.8"/><mimic joint="hinge" multiplier="-0.7" offset="0.3"/>'
    )
    text = text.replace('xyz="0 0 1.0"/>', 'xyz="0.1 0 1.0" rpy="0.3 1.5707963267948966 -0.7"/>').replace(
        "upper_door", "upper door"
    )
    obj = replace(read(put(tmp_path / "tür 1.urdf", text), "auto", "z", "+y"), category="Safe")
    folder = write_folder(obj, tmp_path / "out")
    again = load_object(folder)
    assert (again.id, again.category) == ("tür 1", "Safe")
    names = {link.name: "_".join(link.name.split()) for link in obj.links}
    assert_same(again, replace(obj, links=tuple(replace(link, name=names[link.name]) for link in obj.links)))
    assert again.followers and again.links[again.index("upper_door")].semantic == "door"
    assert json.loads((folder / "meta.json").read_text())["remarks"] == list(obj.dropped)
    with pytest.raises(UserError, match="exists already"):
        write_folder(obj, tmp_path / "out")
    write_folder(obj, tmp_path / "out", replaced=True)
    assert [entry.name for entry in (tmp_path / "out").iterdir()] == ["tür 1"]


def test_a_catalog_of_files(tmp_path: Path) -> None:
    put(tmp_path / "in/a.urdf")
    put(tmp_path / "in/Safe/b.urdf", cupboard(1000.0))
    put(tmp_path / "in/broken.urdf", "<robot")
    assets = AssetsOptions(source="files", root=[str(tmp_path / "in")])
    made = files_catalog(assets, out=tmp_path / "out")
    assert [(entry.id, entry.category, entry.split) for entry in made] == [
        ("a", "unknown", "test"),
        ("b", "Safe", "test"),
    ]
    assert [entry.folder for entry in made] == [tmp_path / "out/a", tmp_path / "out/b"]
    for held, written in zip(files_catalog(assets), made, strict=True):
        assert_same(held.load(), written.load())
    assert [entry.id for entry in files_catalog(assets, "Safe")] == ["b"]
    assert {entry.category for entry in files_catalog(replace(assets, category="Table"))} == {"Table"}
    assert [entry.id for entry in path_catalog(tmp_path / "in")] == ["a", "b"]
    assert [obj.id for obj in find_objects(tmp_path / "in/a.urdf")] == ["a"]
    with pytest.raises(UserError, match="no object can be used.*broken"):
        files_catalog(replace(assets, root=str(tmp_path / "in/broken.urdf")))


@pytest.mark.parametrize(("word", "metres"), [("m", 1.0), ("mm", 0.001), ("cm", 0.01), ("inch", 0.0254), ("0.5", 0.5)])
def test_a_scale_is_a_unit_or_a_number(word: str, metres: float) -> None:
    assert AssetsOptions(source="files", root="a", scale=word).metres == metres


@pytest.mark.parametrize("scale", ["0", "-1", "inf", "big", None])
def test_a_scale_that_is_none_is_refused(scale: object) -> None:
    with pytest.raises(UserError, match="assets.scale"):
        _ = AssetsOptions(source="files", root="a", scale=scale).metres
