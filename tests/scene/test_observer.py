"""One object in the world, what is seen of it, and from where its parts are visible."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.assets.gripper import gripper_meshes
from fb3d_rl.camera.raycast import CameraOptions
from fb3d_rl.camera.views import View, ViewRange
from fb3d_rl.scene.observer import MIN_VISIBLE, TRIES, find_view, observe, visible
from fb3d_rl.scene.posed import Posed

CAMERA = CameraOptions(resolution=48)
FRONT = ViewRange((0.0, 0.0), (30.0, 30.0))
BEHIND = ViewRange((180.0, 180.0), (0.0, 0.0))


@pytest.fixture(scope="module")
def microwave(procedural_objects: dict[str, ArticulatedObject]) -> Posed:
    return Posed(procedural_objects["Microwave"], CAMERA)


def test_a_closed_object_stands_on_the_ground(procedural_objects: dict[str, ArticulatedObject]) -> None:
    for obj in procedural_objects.values():
        posed = Posed(obj)
        bounds, opened = posed.bounds(posed.closed), posed.bounds(posed.opened)
        assert bounds[0, 2] == pytest.approx(0.0, abs=1e-9) and (bounds[1] > bounds[0]).all()
        assert not np.allclose(bounds, opened), "what opens takes more room"
        poses = posed.poses(posed.opened)
        vertices = np.concatenate(
            [mesh.vertices @ pose[:3, :3].T + pose[:3, 3] for link, pose in zip(obj.links, poses, strict=True)
             for mesh in link.visuals]
        )  # fmt: skip
        assert (vertices >= opened[0] - 1e-9).all() and (vertices <= opened[1] + 1e-9).all()


def test_bodies_that_are_not_there_hide_nothing(microwave: Posed) -> None:
    crowded = Posed(microwave.obj, CAMERA, gripper_meshes())
    poses = crowded.poses_alone(crowded.closed)
    assert len(poses) == len(microwave.obj.links) + 3 == len(crowded.visuals)
    rngs = (np.random.default_rng(0) for _ in range(3))
    alone = observe(microwave, microwave.poses(microwave.closed), View(10.0, 80.0), 300, next(rngs))
    with_far = observe(crowded, poses, View(10.0, 80.0), 300, next(rngs))
    np.testing.assert_array_equal(with_far.points, alone.points)
    np.testing.assert_array_equal(with_far.links, alone.links)
    # Just before the lens it hides all.
    poses[-3:] = np.eye(4)
    poses[-3:, :3, 3] = crowded.camera.pose(View(10.0, 80.0))[:3] @ [0.0, 0.0, 0.15, 1.0]
    assert (observe(crowded, poses, View(10.0, 80.0), 300, next(rngs)).links >= 0).sum() < (alone.links >= 0).sum()


def test_the_truth_is_of_the_joints_that_are_asked_for(procedural_objects: dict[str, ArticulatedObject]) -> None:
    posed = Posed(procedural_objects["StorageFurniture"], CAMERA)
    view, state = View(20.0, 30.0), 0.5 * (posed.closed + posed.opened)
    cloud = observe(posed, posed.poses(state), view, 400, np.random.default_rng(0))
    masks = []
    for link in posed.openable:
        truth = cloud.with_truth(posed.direction(link))
        expected = np.isin(cloud.links, posed.obj.descendants(link))
        np.testing.assert_array_equal(truth["part_mask"].numpy(), expected)
        assert (truth["flow"][~truth["part_mask"]] == 0).all()
        back = cloud.with_truth(-posed.direction(link))
        assert torch.equal(back["flow"], -truth["flow"]) and torch.equal(back["part_mask"], truth["part_mask"])
        masks.append(truth["part_mask"])
        assert cloud.shows(link) == (int(expected.sum()) >= MIN_VISIBLE)
    assert torch.equal(cloud.with_truth(posed.direction())["part_mask"], torch.stack(masks).any(0))


def test_visible_from_the_least_number_of_points_on() -> None:
    links = np.array([3] * (MIN_VISIBLE - 1) + [5] * 100 + [-1] * 50)
    assert not visible(links, (3, 4))
    links[-1] = 4
    assert visible(links, (3, 4)) and not visible(links, (4,)) and visible(links, (5,))


@pytest.mark.parametrize("count", [None, 300])
def test_views_are_drawn_until_one_shows_the_part(microwave: Posed, count: int | None) -> None:
    door = microwave.openable[0]

    def found(views: ViewRange, seed: int = 0) -> tuple[View, bool]:
        return find_view(microwave, door, microwave.closed, views, np.random.default_rng(seed), count)

    assert found(FRONT) == (View(0.0, 30.0), True) and found(BEHIND) == (View(180.0, 0.0), False)
    around = ViewRange((-180.0, 180.0), (5.0, 10.0))
    views = [found(around, seed) for seed in range(12)]
    first = [around.sample(np.random.default_rng(seed)) for seed in range(12)]
    assert all(shown for _, shown in views) and TRIES > 1
    again = [view != drawn for (view, _), drawn in zip(views, first, strict=True)]
    assert any(again) and not all(again), "a view from behind is drawn anew, one from the front is kept"


def test_a_part_must_be_visible_in_the_cloud_where_that_is_asked_for(microwave: Posed) -> None:
    """The picture shows hundreds of the door's points, a cloud of few points shows few of them."""
    door, rng = microwave.openable[0], np.random.default_rng(0)
    assert find_view(microwave, door, microwave.closed, FRONT, rng, None)[1]
    assert not find_view(microwave, door, microwave.closed, FRONT, rng, MIN_VISIBLE - 1)[1]
