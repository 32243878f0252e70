"""UMPNet's scenes: the table, the objects in them, what is left out, and its camera."""

from __future__ import annotations

import gzip
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.camera.umpnet import BASE, SCALE, TURN, UmpnetCamera
from fb3d_rl.camera.views import View
from fb3d_rl.data.samples import SampleOptions, draw_sample
from fb3d_rl.env.umpnet.scenes import CAMERA, JointState, place, read_scenes, sorted_out
from fb3d_rl.errors import UserError
from fb3d_rl.scene.posed import Posed

from .made import scene_of

FOCAL = 320 / math.tan(math.radians(34.7))


def test_the_table_has_the_scenes_of_21_categories() -> None:
    for mode in ("manipulation", "exploration"):
        scenes = read_scenes(mode)  # type: ignore[arg-type]
        assert len(scenes) == 2100 and len({scene.name for scene in scenes}) == 2100
        assert {scene.mode for scene in scenes} == {mode} and "Toy" not in {scene.category for scene in scenes}
        assert all((scene.selected is None) == (mode == "exploration") for scene in scenes)
    assert [scene.name for scene in read_scenes("manipulation") if scene.ranges == 0] == ["manipulation Door 58"]


def test_what_is_left_out_is_counted_by_name() -> None:
    scenes = read_scenes("manipulation")
    kept, left = sorted_out(scenes, {scene.object for scene in scenes if scene.category == "Door"})
    assert len(kept) == 99 and left.missing == {name: 100 for name in sorted({s.category for s in scenes} - {"Door"})}
    assert left.unmovable == ("manipulation Door 58",)
    assert "2000 scenes" in left.sentences()[0] and "Toilet 100" in left.sentences()[0]
    with pytest.raises(UserError, match="none of UMPNet's scenes"):
        sorted_out(scenes, ["nobody's"])


@pytest.mark.parametrize(
    "broken", ["x", {}, {"limits": [1.0, 0.0, 0.5, 0.5]}, {"nan": math.nan}, {"selected_joint": 7}]
)
def test_a_broken_table_is_named_in_one_sentence(tmp_path: Path, broken: Any) -> None:
    row: Any = {
        "mode": "manipulation", "category": "Door", "number": 0, "object": "1", "scale": 0.55,
        "base_position": [0, -0.5, 0.4], "base_orientation_xyzw": [0, 0, 0, 1], "selected_joint": 1,
        "joints": {"1": [0.0, 1.0, 0.1, 0.9]},
    }  # fmt: skip
    file = tmp_path / "scenes.json.gz"
    file.write_bytes(gzip.compress(json.dumps([row]).encode()))
    assert read_scenes("manipulation", file)[0].joints[1] == JointState(0.0, 1.0, 0.1, 0.9)
    if broken == {} or isinstance(broken, str):
        row = broken
    else:
        ((key, value),) = broken.items()
        row |= {"limits": {"joints": {"1": value}}, "nan": {"scale": value}}.get(key, broken)
    file.write_bytes(gzip.compress(json.dumps([row]).encode()))
    with pytest.raises(UserError, match="a scene is broken"):
        read_scenes("manipulation", file)
    file.write_bytes(b"no archive")
    with pytest.raises(UserError, match="no table"):
        read_scenes("manipulation", file)


def test_a_scene_places_its_object(objects: dict[str, ArticulatedObject]) -> None:
    for obj in objects.values():
        placed = place(scene_of(obj), obj)
        low, high = obj.limits[0]
        assert placed.start[0] == pytest.approx(low + 0.2 * (high - low))
        assert placed.goal[0] == pytest.approx(low + 0.9 * (high - low))
        assert placed.link == obj.movable[0] and placed.movable == (placed.link,)
        np.testing.assert_array_equal(placed.start[1:], placed.goal[1:])
        # UMPNet's transform of the origin of the base and of a point in front of it, and the way back.
        for point in (np.zeros(3), np.array([-1.0, 0.2, 0.3])):
            turn = Rotation.from_euler("z", 100.0, degrees=True).as_matrix()
            umpnet = turn @ (SCALE * point) + [0.0, -0.5, 0.5]
            world = placed.posed.T_world_base[:3, :3] @ point + placed.posed.T_world_base[:3, 3]
            np.testing.assert_allclose(TURN.T @ world * SCALE + BASE, umpnet, atol=1e-12)


def test_other_limits_and_other_joints(objects: dict[str, ArticulatedObject]) -> None:
    obj = objects["Drawers"] if "Drawers" in objects else next(iter(objects.values()))
    wide = place(scene_of(obj, upper=7.0, goal=6.0), obj)
    unit = SCALE if obj.joint_of(obj.movable[0]).type == "prismatic" else 1.0
    assert wide.posed.obj.limits[0, 1] == pytest.approx(7.0 / unit) and obj.limits[0, 1] < 7.0 / unit
    scene = scene_of(obj)
    with pytest.raises(UserError, match="no joint number 99"):
        place(replace(scene, joints={99: scene.joints[scene.selected or 0]}, selected=99), obj)


def test_the_camera_is_umpnets_by_closed_form(objects: dict[str, ArticulatedObject]) -> None:
    """A pinhole of 462 pixels at (0, -2, 2), 45 degrees down, whose middle looks at the origin of UMPNet's world."""
    for obj in objects.values():
        placed = place(scene_of(obj), obj)
        camera = placed.posed.camera
        assert isinstance(camera, UmpnetCamera)
        depth, bodies = camera.depth_image(placed.posed.poses(placed.start), View(0.0, 0.0))
        rows, columns = np.nonzero(bodies >= 0)
        assert len(rows) > 500 and rows.min() >= 80 and rows.max() < 560  # 480 rows in the middle of 640
        points, links = camera.capture(placed.posed.poses(placed.start), View(0.0, 0.0))
        world = points @ TURN * SCALE + BASE - np.array([0.0, -2.0, 2.0])
        forward = np.array([0.0, 1.0, -1.0]) / math.sqrt(2)
        right, down = np.array([1.0, 0.0, 0.0]), np.array([0.0, -1.0, -1.0]) / math.sqrt(2)
        z = world @ forward
        np.testing.assert_allclose(FOCAL * (world @ right) / z + 320, columns + 0.5, atol=1e-3)
        np.testing.assert_allclose(FOCAL * (world @ down) / z + 240, rows - 80 + 0.5, atol=1e-3)
        np.testing.assert_allclose(z, depth[rows, columns] * SCALE, rtol=1e-6)
        np.testing.assert_array_equal(links, bodies[rows, columns])


def test_training_samples_are_seen_as_scenes_are(objects: dict[str, ArticulatedObject]) -> None:
    """A sample's view turns the object before the camera: its points lie on the object turned by that yaw."""
    obj = objects["Oven"] if "Oven" in objects else next(iter(objects.values()))
    posed = Posed(obj, CAMERA)
    view, state = View(30.0, 0.0), posed.closed
    points, _ = posed.camera.capture(posed.poses(state), view)
    turn = posed.camera.turn(view)
    assert turn is not None
    yaw = -90.0 - 30.0 + 180.0  # the front, -x of the base, faces -y of UMPNet's world at 90 degrees, less the azimuth
    placed = place(scene_of(obj, yaw=yaw), obj)
    placed.posed.T_world_base[2, 3] = posed.T_world_base[2, 3]
    seen, _ = placed.posed.camera.capture(placed.posed.poses(state), View(0.0, 0.0))
    np.testing.assert_allclose(points @ turn.T, seen, atol=2e-5)
    sample = draw_sample(posed, SampleOptions(camera=CAMERA), np.random.default_rng(0))
    assert sample is not None
    flow, valid = sample["privileged", "flow"], sample["observation", "valid"]
    assert float(flow[valid].norm(dim=-1).max()) == pytest.approx(1.0, abs=1e-5)
