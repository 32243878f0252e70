"""Forward kinematics: its own formula link by link, and what each joint carries."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.kinematics.tree import KinematicTree

from .chains import joint, make, pose, random_chain


def by_hand(obj: ArticulatedObject, qpos: np.ndarray) -> np.ndarray:
    """Link poses [L, 4, 4], by recursion to the root and scipy's rotations."""

    def place(link: int) -> np.ndarray:
        part = obj.links[link]
        if part.joint is None:
            return np.eye(4)
        if part.joint.type == "fixed":
            moved = np.eye(4)
        elif part.joint.type == "prismatic":
            moved = pose(qpos[obj.movable.index(link)] * part.joint.axis)
        else:
            moved = pose(turn=Rotation.from_rotvec(qpos[obj.movable.index(link)] * part.joint.axis))
        return place(part.parent) @ part.joint.origin @ moved

    return np.stack([place(i) for i in range(len(obj.links))])


@pytest.mark.parametrize("seed", range(10))
def test_poses_are_those_of_the_chain(seed: int) -> None:
    rng = np.random.default_rng(seed)
    obj = random_chain(rng)
    qpos = rng.normal(size=len(obj.movable)) * 2
    poses = KinematicTree.from_object(obj).forward(torch.as_tensor(qpos))
    np.testing.assert_allclose(poses.numpy(), by_hand(obj, qpos), atol=1e-12)


def test_batches_equal_single_states() -> None:
    rng = np.random.default_rng(1)
    obj = random_chain(rng)
    tree = KinematicTree.from_object(obj)
    qpos = torch.as_tensor(rng.normal(size=(2, 3, len(obj.movable))))
    batched = tree.forward(qpos)
    assert batched.shape == (2, 3, len(obj.links), 4, 4)
    for i in range(2):
        for j in range(3):
            assert torch.equal(batched[i, j], tree.forward(qpos[i, j]))


def test_a_joint_moves_exactly_what_it_carries() -> None:
    rng = np.random.default_rng(2)
    obj = random_chain(rng, links=9)
    tree = KinematicTree.from_object(obj)
    qpos = torch.as_tensor(rng.normal(size=len(obj.movable)))
    for j, link in enumerate(obj.movable):
        moved = qpos.clone()
        moved[j] += 0.3
        change = (tree.forward(moved) - tree.forward(qpos)).abs().amax((-1, -2)) > 1e-9
        assert torch.equal(change, tree.descendants[j])
        assert change[link] and not change[obj.links[link].parent]


def test_float32_states_are_computed_in_the_trees_precision() -> None:
    obj = random_chain(np.random.default_rng(3))
    tree = KinematicTree.from_object(obj)
    assert tree.forward(torch.zeros(len(obj.movable))).dtype == torch.float64
    assert KinematicTree.from_object(obj, torch.float32).forward(torch.zeros(len(obj.movable))).dtype == torch.float32


def test_an_object_without_joints_has_one_pose() -> None:
    obj = make((-1, None, "", ()), (0, joint("fixed", origin=pose((1, 2, 3))), "", ()))
    tree = KinematicTree.from_object(obj)
    assert tree.descendants.shape == (0, 2)
    np.testing.assert_array_equal(tree.forward(torch.zeros(5, 0))[4, 1], pose((1, 2, 3)))
