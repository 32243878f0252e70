"""The ground-truth flow: closed forms, equivariance, and the finite difference of the kinematic chain."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.flow.articulation_flow import STEP, articulation_flow, normalize_flow
from fb3d_rl.geometry.transforms import apply, inverse
from fb3d_rl.kinematics.tree import KinematicTree
from tests.kinematics.chains import pose, random_chain

# A chord is shorter than its arc by STEP^2 / 24, some 4e-6 of the displacement of at most 0.1 m in these scenes.
ATOL = 1e-6
EXACT = 1e-14


class Scene:
    """A random chain in a random pose and state, with points on every link and padding."""

    def __init__(self, seed: int, count: int = 60) -> None:
        self.rng = np.random.default_rng(seed)
        self.obj: ArticulatedObject = random_chain(self.rng)
        self.tree = KinematicTree.from_object(self.obj)
        self.base = torch.as_tensor(pose(self.rng.normal(size=3), Rotation.random(rng=self.rng)))
        self.qpos = torch.as_tensor(self.rng.normal(size=len(self.obj.movable)))
        self.points = torch.as_tensor(self.rng.normal(size=(count, 3)))
        self.links = torch.as_tensor(self.rng.integers(-1, len(self.obj.links), size=count))

    def poses(self, qpos: Tensor) -> Tensor:
        return self.base @ self.tree.forward(qpos)

    def flow(self, direction: Tensor) -> Tensor:
        return articulation_flow(self.tree, self.points, self.links, self.poses(self.qpos), direction)

    def one(self, joint: int, sign: float = 1.0) -> Tensor:
        direction = torch.zeros(len(self.obj.movable), dtype=torch.float64)
        direction[joint] = sign
        return direction

    def tangent(self, joint: int) -> Tensor:
        """Velocity [N, 3] of each point per unit of joint speed: the axis times the radius, or the axis."""
        link = self.obj.movable[joint]
        frame = self.base @ self.tree.forward(self.qpos)[link]
        axis = frame[:3, :3] @ torch.as_tensor(self.obj.joint_of(link).axis)
        if self.obj.joint_of(link).type == "prismatic":
            velocity = axis.expand_as(self.points).clone()
        else:
            velocity = torch.linalg.cross(axis.expand_as(self.points), self.points - frame[:3, 3])
        carried = torch.isin(self.links, torch.tensor(self.obj.descendants(link)))
        return velocity * carried[:, None]


def close(actual: Tensor, expected: Tensor, atol: float = ATOL) -> None:
    torch.testing.assert_close(actual, expected, atol=atol, rtol=0.0)


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_flow_is_the_closed_form_for_every_joint_type(seed: int, sign: float) -> None:
    scene = Scene(seed)
    types = set()
    for j, link in enumerate(scene.obj.movable):
        flow = scene.flow(scene.one(j, sign))
        close(flow, sign * STEP * scene.tangent(j))
        types.add(scene.obj.joint_of(link).type)
        carried = torch.isin(scene.links, torch.tensor(scene.obj.descendants(link)))
        assert (flow[~carried] == 0).all()  # exactly: other parts and padding
    assert types == {"revolute", "prismatic", "continuous"}


@pytest.mark.parametrize("seed", range(4))
def test_several_joints_add_up(seed: int) -> None:
    scene = Scene(seed)
    direction = torch.as_tensor(scene.rng.choice([-1.0, 0.0, 1.0], size=len(scene.obj.movable)))
    expected = sum(direction[j] * STEP * scene.tangent(j) for j in range(len(direction)))
    assert isinstance(expected, Tensor)
    close(scene.flow(direction), expected, atol=3e-6)


@pytest.mark.parametrize("seed", range(4))
def test_flow_is_the_finite_difference_of_forward_kinematics(seed: int) -> None:
    scene = Scene(seed)
    scene.links.clamp_(min=0)
    local = apply(inverse(scene.poses(scene.qpos))[scene.links], scene.points[:, None])
    for j in range(len(scene.obj.movable)):
        direction = scene.one(j)
        for step, atol in ((STEP, EXACT), (1e-5, ATOL)):  # the same step, to the last digit, and a small one
            ends = [
                apply(scene.poses(scene.qpos + sign * 0.5 * step * direction)[scene.links], local).squeeze(1)
                for sign in (1, -1)
            ]
            close(scene.flow(direction), (ends[0] - ends[1]) * (STEP / step), atol=atol)


def test_flow_of_a_hinge_is_across_axis_and_radius_and_grows_with_it() -> None:
    scene = Scene(5)
    j = next(k for k, link in enumerate(scene.obj.movable) if scene.obj.joint_of(link).type == "revolute")
    link = scene.obj.movable[j]
    scene.links[:] = link
    frame = scene.base @ scene.tree.forward(scene.qpos)[link]
    axis = frame[:3, :3] @ torch.as_tensor(scene.obj.joint_of(link).axis)
    radius = scene.points - frame[:3, 3]
    radius = radius - (radius @ axis)[:, None] * axis
    flow = scene.flow(scene.one(j))
    close(flow @ axis, torch.zeros(len(flow)).double(), atol=1e-12)
    close((flow * radius).sum(-1), torch.zeros(len(flow)).double(), atol=1e-12)
    close(flow.norm(dim=-1), STEP * radius.norm(dim=-1))


def test_flow_turns_with_the_scene() -> None:
    scene = Scene(6)
    direction = torch.ones(len(scene.obj.movable)).double()
    before = scene.flow(direction)
    turn = torch.as_tensor(pose((3.0, -1.0, 2.0), Rotation.from_euler("xyz", [0.5, -1.1, 2.3])))
    scene.points, scene.base = apply(turn, scene.points), turn @ scene.base
    close(scene.flow(direction), before @ turn[:3, :3].T, atol=1e-12)


def test_opposite_directions_give_opposite_flows() -> None:
    scene = Scene(7)
    close(scene.flow(scene.one(1)), -scene.flow(scene.one(1, -1.0)), atol=1e-15)


def test_batches_equal_single_clouds() -> None:
    scene = Scene(8)
    rng = scene.rng
    qpos = torch.as_tensor(rng.normal(size=(4, 2, len(scene.obj.movable))))
    direction = torch.as_tensor(rng.choice([-1.0, 0.0, 1.0], size=qpos.shape))
    points = torch.as_tensor(rng.normal(size=(4, 2, 20, 3)))
    links = torch.as_tensor(rng.integers(-1, len(scene.obj.links), size=(4, 2, 20)))
    base = [torch.as_tensor(pose(rng.normal(size=3), Rotation.random(rng=rng))) for _ in range(4)]
    poses = torch.stack(base)[:, None, None] @ scene.tree.forward(qpos)
    batched = articulation_flow(scene.tree, points, links, poses, direction)
    for i in np.ndindex(4, 2):
        one = articulation_flow(scene.tree, points[i], links[i], poses[i], direction[i])
        close(batched[i], one, atol=EXACT)


def test_dtype_is_that_of_the_points_and_precision_that_of_the_tree() -> None:
    scene = Scene(9)
    direction = scene.one(0)
    exact = scene.flow(direction)
    scene.points = scene.points.float()
    rounded = scene.flow(direction)
    assert rounded.dtype == torch.float32
    close(rounded.double(), exact, atol=2e-8)


def test_normalised_flow_has_norm_one_and_keeps_directions() -> None:
    scene = Scene(10)
    raw = torch.stack([scene.flow(scene.one(j)) for j in range(3)] + [torch.zeros_like(scene.points)])
    normal = normalize_flow(raw)
    close(normal.norm(dim=-1).amax(-1), torch.tensor([1.0, 1.0, 1.0, 0.0]).double(), atol=1e-12)
    assert (normal[3] == 0).all()
    for i in range(3):
        scale = raw[i].norm(dim=-1).max()
        close(normal[i] * scale, raw[i], atol=1e-14)
    close(normalize_flow(1e-3 * raw), normal, atol=1e-12)
