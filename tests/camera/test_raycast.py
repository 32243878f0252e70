"""The ray-casting camera, on shapes whose picture is known."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from pkgutil import resolve_name

import numpy as np
import pytest
import torch
import trimesh
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from fb3d_rl.assets.articulation import ArticulatedObject, Joint, Link, Mesh
from fb3d_rl.camera.embree import triangle_scene
from fb3d_rl.camera.options import SENSORS
from fb3d_rl.camera.raycast import CameraOptions, RaycastCamera
from fb3d_rl.camera.views import View
from fb3d_rl.kinematics.opening import opening_range, standing_pose
from fb3d_rl.kinematics.tree import KinematicTree
from fb3d_rl.perception.depth import Intrinsics, points_of

OPTIONS = CameraOptions(resolution=33)
FRONT = View(0.0, 0.0)


def mesh_of(made: trimesh.Trimesh, at: ArrayLike = (0, 0, 0)) -> Mesh:
    return Mesh(np.array(made.vertices) + np.array(at, dtype=float), np.array(made.faces, dtype=np.int64))


def box(extents: ArrayLike, at: ArrayLike = (0, 0, 0)) -> Mesh:
    return mesh_of(trimesh.creation.box(extents=extents), at)


def rigid_object(*meshes: Sequence[Mesh]) -> ArticulatedObject:
    """An object of fixed links, one for each list of meshes."""
    links = [
        Link(f"l{i}", "", i - 1, None if i == 0 else Joint("j", "fixed", np.eye(4), np.zeros(3), (0, 0)), tuple(m), ())
        for i, m in enumerate(meshes)
    ]
    return ArticulatedObject("made", "Test", Path("none"), tuple(links))


def drawer() -> ArticulatedObject:
    """A body of 1 m with a front of a drawer before it, which slides out along -x."""
    slide = Joint("j", "prismatic", np.eye(4), np.array([-1.0, 0, 0]), (0.0, 0.5))
    links = (
        Link("body", "", -1, None, (box((1, 1, 1), (0, 0, 0.5)),), ()),
        Link("drawer", "drawer", 0, slide, (box((0.1, 0.8, 0.4), (-0.55, 0, 0.5)),), ()),
    )
    return ArticulatedObject("made", "Test", Path("none"), links)


def still(count: int, *poses: np.ndarray) -> np.ndarray:
    return np.stack([np.eye(4)] * count + list(poses))


def local(points: np.ndarray, pose: np.ndarray) -> np.ndarray:
    return (points - pose[:3, 3]) @ pose[:3, :3]


@pytest.mark.parametrize("view", [FRONT, View(40.0, 35.0)])
def test_a_depth_image_is_the_cloud_by_pixels(view: View) -> None:
    obj, bar = drawer(), [box((0.1, 0.1, 2.0), (-1.0, 0.3, 0.0))]
    camera = RaycastCamera(obj, [bar], OPTIONS)
    points, bodies = camera.capture(still(3), view)
    depth, labels = camera.depth_image(still(3), view)
    assert depth.shape == labels.shape == (33, 33) and depth.dtype == np.float32
    np.testing.assert_array_equal(depth > 0, labels >= 0)
    np.testing.assert_array_equal(labels[labels >= 0], bodies)
    assert {*bodies} == {0, 1, 2}
    organised = points_of(depth, Intrinsics(*OPTIONS.pinhole), 1.0)
    pose = camera.pose(view)
    np.testing.assert_allclose(
        organised[depth.ravel() > 0] @ pose[:3, :3].T + pose[:3, 3], points, atol=2e-6
    )  # the camera's own and that of files agree where a pixel's centre is


@pytest.mark.parametrize("view", [FRONT, View(40.0, 35.0), View(-120.0, 70.0), View(10.0, -20.0)])
def test_points_lie_on_the_surface_of_a_box_and_on_its_visible_side(view: View) -> None:
    half = np.array([0.3, 0.5, 0.2])
    obj = rigid_object([box(2 * half)])
    camera = RaycastCamera(obj, options=OPTIONS)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_euler("xyz", [0.4, -0.2, 0.9]).as_matrix(), camera.centre + 0.05
    points, links = camera.capture(pose[None], view)
    assert len(points) > 150 and (links == 0).all()
    inside = np.abs(local(points, pose)) / half
    depth = np.abs(local(points, pose)) - half
    np.testing.assert_allclose(depth.max(-1), 0.0, atol=1e-4)
    # The face that a point lies on faces the camera.
    eye = local(camera.pose(view)[:3, 3], pose)
    face = inside.argmax(-1)
    rows = np.arange(len(points))
    side = np.sign(local(points, pose)[rows, face])
    ends = np.sort(inside, axis=-1)
    clear = ends[:, 2] - ends[:, 1] > 1e-3  # not on an edge
    assert clear.mean() > 0.9 and (side[clear] * eye[face[clear]] > half[face[clear]]).all()


def test_points_lie_on_the_near_side_of_a_sphere() -> None:
    obj = rigid_object([mesh_of(trimesh.creation.icosphere(subdivisions=5, radius=0.5))])
    camera = RaycastCamera(obj, options=OPTIONS)
    centre = np.array([0.0, 0.0, 0.5])
    np.testing.assert_allclose(camera.centre, centre, atol=1e-3)
    for view in (FRONT, View(70.0, 20.0)):
        poses = still(1)
        poses[0, :3, 3] = centre
        points, _ = camera.capture(poses, view)
        np.testing.assert_allclose(np.linalg.norm(points - centre, axis=-1), 0.5, atol=1e-3)  # the facets' height
        assert (((points - centre) * (camera.pose(view)[:3, 3] - points)).sum(-1) > -1e-3).all()
        share = len(points) / OPTIONS.resolution**2
        radius = np.tan(np.arcsin(0.5 / camera.distance)) / np.tan(np.radians(OPTIONS.fov / 2))
        assert share == pytest.approx(np.pi * radius**2 / 4, rel=0.05)  # the disc that a sphere's outline makes


def test_azimuth_and_elevation_choose_the_side_that_is_seen() -> None:
    obj = rigid_object([box((1, 1, 1))])
    camera = RaycastCamera(obj, options=OPTIONS)
    poses = standing_pose(obj)[None]
    for view, axis, value in (
        (FRONT, 0, -0.5),
        (View(90.0, 0.0), 1, -0.5),
        (View(-90.0, 0.0), 1, 0.5),
        (View(180.0, 0.0), 0, 0.5),
        (View(0.0, 90.0), 2, 1.0),
    ):
        points, _ = camera.capture(poses, view)
        assert len(points) > 100
        np.testing.assert_allclose(points[:, axis], value, atol=1e-4)
    above, _ = camera.capture(poses, View(0.0, 45.0))
    assert (above[:, 2] > 1.0 - 1e-4).any() and (above[:, 0] < -0.5 + 1e-4).any()
    assert not ((above[:, 0] > 0.5 - 1e-4) & (above[:, 2] < 1.0 - 1e-3)).any()


@pytest.mark.parametrize("view", [FRONT, View(33.0, 21.0)])
def test_the_centre_of_the_image_is_the_centre_of_the_object(view: View) -> None:
    obj = rigid_object([box((0.2, 0.9, 0.6))])
    camera = RaycastCamera(obj, options=OPTIONS)
    points, _ = camera.capture(standing_pose(obj)[None], view)
    pose = camera.pose(view)
    seen = local(points, pose)
    off_axis = np.linalg.norm(seen[:, :2], axis=-1)
    assert off_axis.min() < 1e-6 and camera.distance - 1.0 < seen[off_axis.argmin(), 2] < camera.distance
    # y down, z forward, rows from the top: the first points are the highest.
    assert seen[0, 1] < 0 < seen[-1, 1] and points[0, 2] > points[-1, 2]


def test_the_whole_closed_object_is_in_the_image_whatever_the_view() -> None:
    obj = rigid_object([box((0.4, 2.0, 0.7))])
    camera = RaycastCamera(obj, options=CameraOptions(resolution=33, margin=1.15))
    slope = np.tan(np.radians(20.0))
    for azimuth in range(0, 360, 45):
        view = View(float(azimuth), 25.0)
        corners = local(obj.links[0].visuals[0].vertices + standing_pose(obj)[:3, 3], camera.pose(view))
        assert (np.abs(corners[:, :2]) < slope * corners[:, 2:]).all()


def test_what_stands_in_front_hides_what_is_behind() -> None:
    near, far = box((0.1, 1.2, 1.2), (-1, 0, 0.6)), box((0.1, 1, 1), (1, 0, 0.6))
    camera = RaycastCamera(rigid_object([far], [near], []), options=OPTIONS)
    for view, seen, x in ((FRONT, 1, -1.05), (View(180.0, 0.0), 0, 1.05)):
        points, links = camera.capture(still(3), view)
        assert set(links) == {seen}
        np.testing.assert_allclose(points[:, 0], x, atol=1e-4)
    aside = still(3)
    aside[1, 1, 3] = 0.9  # the near plate, moved off, hides a part of the far one
    points, links = camera.capture(aside, FRONT)
    assert set(links) == {0, 1}
    np.testing.assert_allclose(points[links == 0, 0], 0.95, atol=1e-4)
    np.testing.assert_allclose(points[links == 1, 0], -1.05, atol=1e-4)
    eye = camera.pose(FRONT)[:3, 3]
    through = eye + (points[links == 0] - eye) * ((-1.05 - eye[0]) / (0.95 - eye[0]))
    assert (through[:, 1] < 0.3 + 1e-3).all()  # the sight of no far point passes through the near plate
    # The order of the links makes no difference.
    swapped = RaycastCamera(rigid_object([near], [far], []), options=OPTIONS)
    assert set(swapped.capture(still(3), FRONT)[1]) == {0}


def test_further_bodies_are_numbered_on_and_hide_the_object() -> None:
    obj = rigid_object([box((1, 1, 1), (0, 0, 0.5))])
    camera = RaycastCamera(obj, bodies=[[], [box((0.02, 0.3, 0.3))]], options=OPTIONS)
    before = np.eye(4)
    before[:3, 3] = (-1.0, 0.0, 0.5)
    points, links = camera.capture(still(2, before), FRONT)
    assert set(links) == {0, 2}
    np.testing.assert_allclose(points[links == 2, 0], -1.01, atol=1e-4)
    on_object = points[links == 0]
    hidden = np.abs(on_object[:, 1:] - [0, 0.5]).max(-1) < 0.15
    assert not hidden.any()
    before[0, 3] = 1.0  # behind the object
    assert set(camera.capture(still(2, before), FRONT)[1]) == {0}


def test_points_on_further_bodies_can_be_left_out() -> None:
    camera = RaycastCamera(
        rigid_object([box((1, 1, 1), (0, 0, 0.5))]), bodies=[[box((0.02, 0.3, 0.3))]], options=OPTIONS
    )
    before = np.eye(4)
    before[:3, 3] = (-1.0, 0.0, 0.5)
    points, links = camera.capture(still(1, before), FRONT)
    alone, ids = camera.capture(still(1, before), FRONT, further=False)
    assert (links == 1).any() and len(ids) > 100 and (ids == 0).all()
    np.testing.assert_array_equal(alone, points[links == 0])


def random_pose(rng: np.random.Generator, centre: ArrayLike, spread: float) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.random(rng=rng).as_matrix(), centre + spread * rng.normal(size=3)
    return pose


def depths_of_box(half: np.ndarray, pose: np.ndarray, eye: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Where rays [R, 3] from ``eye`` meet a box's surface first, in lengths of the ray; infinite if they miss it."""
    start, along = local(eye[None], pose), rays @ pose[:3, :3]
    ends = np.sort([(-half - start) / along, (half - start) / along], axis=0)
    enter, leave = ends[0].max(-1), ends[1].min(-1)
    return np.where((enter > leave) | (leave < 0), np.inf, np.where(enter > 0, enter, leave))


@pytest.mark.parametrize("seed", range(6))
def test_every_pixel_shows_the_nearest_body_wherever_bodies_are(seed: int) -> None:
    """Also beside, around and behind the lens; the picture's own rays, met by the boxes' formula."""
    rng = np.random.default_rng(seed)
    halves = rng.uniform(0.02, 0.5, size=(9, 3))
    halves[-2:, 0] = 8.0  # beams that pass the lens from far ahead to far behind
    meshes = [[box(2 * half)] for half in halves]
    camera = RaycastCamera(rigid_object(*meshes[:5]), bodies=meshes[5:], options=OPTIONS)
    view = View(float(rng.uniform(-180, 180)), float(rng.uniform(-80, 80)))
    frame, n = camera.pose(view), OPTIONS.resolution
    eye = frame[:3, 3]
    poses = [random_pose(rng, camera.centre, 0.5) for _ in range(5)] + [random_pose(rng, eye, 0.4) for _ in range(4)]
    points, links = camera.capture(np.stack(poses), view)
    x, y = np.meshgrid(*[((np.arange(n) + 0.5) / n * 2 - 1) * np.tan(np.radians(OPTIONS.fov / 2))] * 2)
    rays = np.stack([x.ravel(), y.ravel(), np.ones(n * n)], axis=-1) @ frame[:3, :3].T
    depth = np.stack([depths_of_box(half, pose, eye, rays) for half, pose in zip(halves, poses, strict=True)])
    nearest = depth.min(0)
    seen = np.flatnonzero(np.isfinite(nearest))
    # Rays that graze an edge may hit or miss; none does in these scenes.
    assert len(seen) == len(points) > 100
    np.testing.assert_allclose(points, eye + rays[seen] * nearest[seen, None], atol=1e-4)
    np.testing.assert_array_equal(links, depth.argmin(0)[seen])


def test_a_picture_follows_from_poses_and_view_alone(procedural_objects: dict[str, ArticulatedObject]) -> None:
    """A camera with a long past and a new one give the same bits, whatever moves, rests and comes back."""
    obj = procedural_objects["StorageFurniture"]
    tree, rng = KinematicTree.from_object(obj), np.random.default_rng(0)
    closed, opened = opening_range(obj)
    gripper = [[box((0.2, 0.1, 0.1))], [box((0.3, 0.02, 0.02))]]
    old = RaycastCamera(obj, gripper, OPTIONS)
    qpos, view = closed.copy(), View(10.0, 30.0)
    hand = random_pose(rng, old.centre, 0.3)
    pictures = set()
    for frame in range(60):
        if frame % 20 == 19:
            view = View(float(rng.uniform(-40, 40)), 30.0)
        if frame % 3:  # one joint, at times back to where it was
            j = rng.integers(len(qpos))
            qpos[j] = closed[j] + rng.choice([0.0, 0.5, rng.random()]) * (opened[j] - closed[j])
        if frame % 4:  # in view, out of it, or around the lens
            hand = random_pose(rng, rng.choice([old.centre, old.centre + 9.0, old.pose(view)[:3, 3]]), 0.1)
        poses = np.concatenate([standing_pose(obj) @ tree.forward(torch.as_tensor(qpos)).numpy(), [hand, hand]])
        taken = [camera.capture(poses, view) for camera in (old, RaycastCamera(obj, gripper, OPTIONS))]
        bits = [points.tobytes() + links.tobytes() for points, links in taken]
        assert bits[0] == bits[1], f"frame {frame}"
        pictures.add(bits[0])
        poses[:] = 0.0  # the camera keeps no array of its caller
    assert len(pictures) > 30


def test_a_frame_that_fails_leaves_no_trace() -> None:
    camera = RaycastCamera(drawer(), options=OPTIONS)
    before = camera.capture(still(2), FRONT)
    with pytest.raises(ValueError, match="1 poses .* 2 links"):
        camera.capture(still(1), View(40.0, 35.0))
    with pytest.raises(ValueError, match="shapes"):
        camera.capture(np.zeros((2, 3, 3)), View(40.0, 35.0))
    for a, b in zip(before, camera.capture(still(2), FRONT), strict=True):
        np.testing.assert_array_equal(a, b)


def test_of_two_bodies_in_one_place_the_first_is_seen_whichever_moved_last() -> None:
    cube = [box((1, 1, 1), (0, 0, 0.5))]
    camera = RaycastCamera(rigid_object(cube, cube, cube), bodies=[cube], options=OPTIONS)
    aside = np.eye(4)
    aside[0, 3] = 5.0
    for moved in (0, 1, 2, 3, 1, 0):
        poses = still(4)
        poses[moved] = aside
        assert set(camera.capture(poses, FRONT)[1]) == {1 if moved == 0 else 0}
        assert set(camera.capture(still(4), FRONT)[1]) == {0}


def test_points_move_with_their_joint() -> None:
    obj = drawer()
    tree, camera = KinematicTree.from_object(obj), RaycastCamera(obj, options=OPTIONS)
    for q in (0.0, 0.2, 0.5):
        points, links = camera.capture(tree.forward(torch.tensor([q])).numpy(), FRONT)
        assert set(links) == {0, 1}
        np.testing.assert_allclose(points[links == 1, 0], -0.6 - q, atol=1e-4)
        np.testing.assert_allclose(points[links == 0, 0], -0.5, atol=1e-4)


def test_links_of_points_are_those_whose_surface_they_lie_on(procedural_objects: dict[str, ArticulatedObject]) -> None:
    for obj in procedural_objects.values():
        closed, opened = opening_range(obj)
        tree = KinematicTree.from_object(obj)
        qpos = torch.as_tensor(closed + 0.4 * (opened - closed))
        poses = standing_pose(obj) @ tree.forward(qpos).numpy()
        points, links = RaycastCamera(obj, options=OPTIONS).capture(poses, View(25.0, 35.0))
        assert len(set(links)) >= 2
        for link in set(links.tolist()):
            triangles = np.concatenate([m.vertices[m.faces] for m in obj.links[link].visuals])
            for point in local(points[links == link][::10], poses[link]):
                nearest = trimesh.triangles.closest_point(triangles, np.tile(point, (len(triangles), 1)))
                assert np.linalg.norm(nearest - point, axis=-1).min() < 1e-4


def test_nothing_in_sight_is_an_empty_cloud() -> None:
    camera = RaycastCamera(rigid_object([box((1, 1, 1))]), options=OPTIONS)
    away = np.eye(4)
    away[:3, 3] = (0.0, 0.0, 50.0)
    points, links = camera.capture(away[None], FRONT)
    assert points.shape == (0, 3) and links.shape == (0,)


def test_pictures_repeat_bit_for_bit(procedural_objects: dict[str, ArticulatedObject]) -> None:
    obj = procedural_objects["Microwave"]
    poses = KinematicTree.from_object(obj).forward(torch.zeros(len(obj.movable))).numpy()
    first, second = (RaycastCamera(obj, options=OPTIONS).capture(poses, View(13.0, 29.0)) for _ in range(2))
    assert len(first[0]) > 100
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_process_may_have_more_scenes_than_thread_local_keys() -> None:
    """An Embree device for each scene would end in a crash at about the thousandth."""
    triangle = np.array([[[0, 0, 1], [1, 0, 1], [0, 1, 1]]], dtype=np.float32)
    scenes = [triangle_scene(triangle) for _ in range(1500)]
    hit = scenes[-1].run(np.array([[0.2, 0.2, 0]], dtype=np.float32), np.array([[0, 0, 1]], dtype=np.float32))
    assert hit.tolist() == [0]


def test_every_kind_of_camera_has_a_class() -> None:
    assert all(issubclass(resolve_name(name), RaycastCamera) for name in SENSORS.values())
