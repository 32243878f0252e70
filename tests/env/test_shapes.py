"""What PhysX is given of an object: every mesh makes a shape, and a wall has two sides."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from fb3d_rl.assets.articulation import ArticulatedObject, Joint, Link, Mesh
from fb3d_rl.env.model import PLATE, _hull, _other_sides, _surface
from fb3d_rl.env.options import EnvOptions, default_trial
from fb3d_rl.env.task import OpenArticulatedEnv

from .conftest import velocity

TRIANGLE = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.2, 0.0]])
THIN = {
    "a triangle": TRIANGLE,
    "a triangle, each corner twice": np.tile(TRIANGLE, (2, 1)),
    "a triangle, each corner nearly twice": np.concatenate([TRIANGLE, TRIANGLE + 1e-8]),
    "a strip": np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1e-6, 0.0], [0.0, 1e-6, 0.0]]),
    "a rod": np.outer(np.linspace(0.0, 1.0, 5), [0.3, 0.0, 0.0]),
    "a point": np.tile(TRIANGLE[1], (5, 1)),
    "a crumb": 1e-7 * np.random.default_rng(0).random((8, 3)),
}


@pytest.mark.parametrize("name", THIN)
def test_whatever_is_too_thin_becomes_a_plate(name: str) -> None:
    for seed in range(20):
        turn = Rotation.random(rng=seed)
        points = turn.apply(THIN[name]) + np.random.default_rng(seed).random(3)
        for shape in (_hull(Mesh(points, np.array([[0, 1, 2]]))), _surface(Mesh(points, np.array([[0, 1, 2]])))):
            assert len(shape.vertices) >= 3
            size = np.ptp(shape.vertices - points.mean(0), axis=0)
            assert (size <= np.ptp(points, axis=0) + 1.8 * PLATE).all()  # its diagonal, if it is a cube
        hull = _hull(Mesh(points, np.array([[0, 1, 2]])))
        assert trimesh.convex.convex_hull(hull.vertices).volume > 0


def test_only_sides_that_are_missing_are_added() -> None:
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    sheet = Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))
    assert _other_sides(sheet).tolist() == [[2, 1, 0], [3, 2, 0]]
    # The second face's other side is there already: with corners of its own, and told from another corner on.
    both = Mesh(np.concatenate([corners, corners]), np.array([[0, 1, 2], [0, 2, 3], [7, 6, 4]]))
    assert _other_sides(both).tolist() == [[2, 1, 0]]


def blocked(wall: Mesh) -> float:
    """How far the hand gets against a wall at x = -0.15."""
    lid = trimesh.creation.box((0.3, 0.4, 0.02))
    lid.apply_translation((-0.15, 0.0, 0.01))
    origin = np.eye(4)
    origin[:3, 3] = 0.15, 0.0, 0.6
    hinge = Joint("hinge", "revolute", origin, np.array([0.0, 1.0, 0.0]), (0.0, 1.5))
    meshes = (Mesh(np.asarray(lid.vertices), np.asarray(lid.faces)),)
    links = (Link("base", "", -1, None, (wall,), (wall,)), Link("lid", "lid", 0, hinge, meshes, meshes))
    obj = ArticulatedObject("box", "Box", Path(), links)
    env = OpenArticulatedEnv([obj], EnvOptions(points=64))
    env.reset(options={"trials": [default_trial(obj)]})
    for _ in range(40):
        obs, *_ = env.step(velocity(x=0.5))
    env.close()
    return float(obs["observation"]["qpos"][0, 0])


def test_a_wall_stops_the_hand_whichever_way_its_faces_look() -> None:
    box = trimesh.creation.box((0.3, 0.4, 0.6))
    box.apply_translation((0.0, 0.0, 0.3))
    solid = Mesh(np.asarray(box.vertices), np.asarray(box.faces))
    front = np.array([[-0.15, -0.2, 0.0], [-0.15, 0.2, 0.0], [-0.15, 0.2, 0.6], [-0.15, -0.2, 0.6]])
    sheet = Mesh(front, np.array([[0, 3, 2], [0, 2, 1]]))
    expected = blocked(solid)
    assert expected < -0.2
    for wall in (solid, sheet):
        assert blocked(dataclasses.replace(wall, faces=wall.faces[:, ::-1])) == pytest.approx(expected, abs=0.02)


def test_an_object_with_a_triangle_is_played(objects: dict[str, ArticulatedObject]) -> None:
    """Such as the letters on a safe's door."""
    obj = objects["Oven"]
    letter = Mesh(Rotation.random(rng=1).apply(TRIANGLE), np.array([[0, 1, 2]]))
    links = tuple(dataclasses.replace(link, collisions=(*link.collisions, letter)) for link in obj.links)
    env = OpenArticulatedEnv([dataclasses.replace(obj, links=links)], EnvOptions(points=64))
    env.reset(seed=0)
    assert torch.isfinite(env.step(velocity(x=0.1))[0]["observation"]["qpos"]).all()
