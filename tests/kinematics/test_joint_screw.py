"""Screw and flow: each gives the other back."""

from __future__ import annotations

import math

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.camera.raycast import CameraOptions
from fb3d_rl.data.samples import SampleOptions, draw_sample
from fb3d_rl.kinematics.joint_screw import JointScrew, flow_of_screw, screw_of_flow
from fb3d_rl.scene.posed import Posed

COUNT = 60


def scene(seed: int, size: float = 1.0) -> tuple[JointScrew, torch.Tensor, torch.Tensor]:
    """Random screws of eight clouds, every other one revolute, with points of the part and others [8, COUNT, 3]."""
    generator = torch.Generator().manual_seed(seed)
    axis = torch.nn.functional.normalize(torch.randn(8, 3, generator=generator), dim=-1)
    origin = 0.5 * torch.randn(8, 3, generator=generator)
    points = size * torch.rand(8, COUNT, 3, generator=generator) + torch.randn(8, 1, 3, generator=generator)
    part = torch.rand(8, COUNT, generator=generator) < 0.6
    return JointScrew(torch.arange(8) % 2 == 0, axis, origin), points, part


@given(seed=st.integers(0, 2**32), size=st.sampled_from([0.1, 1.0, 2.0]))
@settings(max_examples=30, deadline=None)
def test_a_screw_is_found_again_in_its_flow_and_the_flow_in_the_screw(seed: int, size: float) -> None:
    screw, points, part = scene(seed, size)
    flow = flow_of_screw(screw, points, part)
    torch.testing.assert_close(flow.norm(dim=-1).amax(-1), torch.ones(8))
    assert not flow[~part].any()
    dirty = points.masked_fill(~part[..., None], math.nan)
    found, unexplained = screw_of_flow(dirty, flow, part)
    assert unexplained.max() < 1e-5
    assert torch.equal(found.revolute, screw.revolute)
    torch.testing.assert_close(found.axis, screw.axis, atol=2e-3, rtol=0)
    apart = torch.linalg.cross(found.origin - screw.origin, screw.axis).norm(dim=-1)[screw.revolute]
    assert apart.max() < 1e-2, "the origin lies on the axis"
    torch.testing.assert_close(flow_of_screw(found, points, part), flow, atol=1e-3, rtol=0)


def test_a_drawer_slides_along_its_axis_and_a_door_turns_by_the_right_hand() -> None:
    points = torch.tensor([[[0.5, 0.0, 0.0], [1.0, 0.0, 0.3], [9.0, 9.0, 9.0]]])
    part, up, origin = torch.tensor([[True, True, False]]), torch.tensor([[0.0, 0.0, 1.0]]), torch.zeros(1, 3)
    sliding = flow_of_screw(JointScrew(torch.tensor([False]), up, origin), points, part)
    assert torch.equal(sliding, torch.tensor([[[0.0, 0, 1], [0, 0, 1], [0, 0, 0]]]))
    turning = flow_of_screw(JointScrew(torch.tensor([True]), up, origin), points, part)
    assert torch.equal(turning, torch.tensor([[[0.0, 0.5, 0], [0, 1, 0], [0, 0, 0]]]))


def test_two_parts_that_move_by_different_joints_are_not_explained() -> None:
    screw, points, part = scene(1)
    other = flow_of_screw(JointScrew(screw.revolute, screw.axis.roll(1, 0), screw.origin), points, part)
    first = torch.arange(COUNT)[None, :, None] < COUNT // 2
    mixed = torch.where(first, flow_of_screw(screw, points, part), other)
    assert screw_of_flow(points, mixed, part)[1].min() > 0.1
    nothing, unexplained = screw_of_flow(points, torch.zeros_like(points), part)
    assert not nothing.axis.any() and not unexplained.any()


def test_the_joints_of_objects_are_found(procedural_objects: dict[str, ArticulatedObject]) -> None:
    kinds = set()
    for obj in procedural_objects.values():
        view = Posed(obj, CameraOptions(resolution=48))
        for number in range(4):
            options = SampleOptions(points=400, all_parts_share=0.0)
            sample = draw_sample(view, options, np.random.default_rng(number))
            assert sample is not None
            points, part = sample["observation", "points"][None], sample["observation", "part_mask"][None]
            found, unexplained = screw_of_flow(points, sample["privileged", "flow"][None], part)
            joint = obj.joint_of(int(sample["target"]))
            assert bool(found.revolute) == (joint.type == "revolute") and unexplained < 1e-4
            flow = flow_of_screw(found, points, part)[0]
            torch.testing.assert_close(flow, sample["privileged", "flow"], atol=1e-3, rtol=0)
            kinds.add(joint.type)
    assert kinds == {"revolute", "prismatic"}
