"""Screw, flow and projection: each gives the others back."""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.assets.partnet_mobility import load_object
from fb3d_rl.camera.raycast import CameraOptions
from fb3d_rl.camera.views import ViewRange
from fb3d_rl.data.samples import SampleOptions, draw_sample
from fb3d_rl.geometry.transforms import dot, length, normalize
from fb3d_rl.kinematics.joint_screw import (
    JointScrew,
    flow_of_screw,
    projection_of_flow,
    projection_of_screw,
    screw_of_flow,
    screw_of_projection,
)
from fb3d_rl.procedural import FAMILIES, generate
from fb3d_rl.scene.observer import find_view, observe
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


class View(NamedTuple):
    category: str
    screw: JointScrew
    points: torch.Tensor
    flow: torch.Tensor
    part: torch.Tensor

    def off(self, axis: torch.Tensor, origin: torch.Tensor) -> tuple[float, float]:
        """Angle (degrees) and distance (m) of an axis from the true one."""
        cross = torch.linalg.cross(axis.double(), self.screw.axis.double()).norm()
        angle = torch.atan2(cross, (axis.double() * self.screw.axis).sum())
        apart = torch.linalg.cross((origin - self.screw.origin).double(), self.screw.axis.double()).norm()
        return math.degrees(angle), float(apart)


def turned(vectors: torch.Tensor, degrees: float, generator: torch.Generator) -> torch.Tensor:
    """Vectors [..., 3] in other directions: off by a Gaussian of this many degrees in each of two ways."""
    noise = math.radians(degrees) * torch.randn(vectors.shape, generator=generator, dtype=vectors.dtype)
    unit = normalize(vectors)
    return length(vectors) * normalize(unit + noise - dot(noise, unit) * unit)


@pytest.fixture(scope="module")
def views(tmp_path_factory: pytest.TempPathFactory) -> list[View]:
    """Clouds of all visible openable links of one object of each family, closed and half open, with the true screws."""
    root, found = tmp_path_factory.mktemp("families"), []
    for name in generate(root, [*FAMILIES], 1, seed=1):
        posed = Posed(load_object(root / name))
        for link, share in itertools.product(posed.openable, (0.0, 0.5)):
            state = posed.closed + share * (posed.opened - posed.closed)
            rng = np.random.default_rng(0)
            view, shown = find_view(posed, link, state, ViewRange(), rng, 1200)
            if shown:
                poses, direction = posed.poses(state), posed.direction(link)
                truth = observe(posed, poses, view, 1200, rng).with_truth(direction)
                joint, pose = posed.obj.joint_of(link), torch.from_numpy(poses[link])
                axis = direction.sum() * pose[:3, :3] @ torch.from_numpy(joint.axis)
                revolute = torch.tensor([joint.type != "prismatic"])
                screw = JointScrew(revolute, axis[None].float(), pose[None, :3, 3].float())
                cloud = tuple(truth[key][None] for key in ("points", "flow", "part_mask"))
                found.append(View(posed.obj.category, screw, *cloud))
    return found


def test_the_axes_of_all_families_are_found_in_flow_and_projection(views: list[View]) -> None:
    assert {view.category for view in views} == {*FAMILIES}
    for view in views:
        projection = projection_of_screw(view.screw, view.points, view.part)
        foot = view.points + projection - view.screw.origin[:, None]
        turns = bool(view.screw.revolute)
        if turns:
            assert torch.linalg.cross(foot, view.screw.axis[:, None])[view.part].norm(dim=-1).max() < 1e-5
            assert (projection * view.screw.axis[:, None]).sum(-1).abs().max() < 1e-5
            assert (projection * view.flow).sum(-1).abs().max() < 1e-5
        found, residual = screw_of_projection(view.points, view.flow, projection, view.part)
        angle, apart = view.off(found.axis, found.origin)
        assert bool(found.revolute) == turns and residual < 1e-5, view.category
        assert angle < 0.1 and (apart < 1e-4 or not turns), view.category
        label, labelled = projection_of_flow(view.points, view.flow, view.part)
        assert bool(labelled) == turns
        torch.testing.assert_close(label, projection, atol=1e-4, rtol=0)


def test_gram_schmidt_beats_the_plain_product_on_noisy_predictions(views: list[View]) -> None:
    generator = torch.Generator().manual_seed(0)
    ours, plain = [], []
    for view in views:
        if not view.screw.revolute:
            continue
        projection = projection_of_screw(view.screw, view.points, view.part)
        for _ in range(4):
            flow, noisy = (turned(vectors, 5.0, generator) for vectors in (view.flow, projection))
            dirty = [x.masked_fill(~view.part[..., None], math.nan) for x in (view.points, flow, noisy)]
            found, residual = screw_of_projection(*dirty, view.part)
            assert found.revolute and 0.05 < residual < 0.2
            ours.append(view.off(found.axis, found.origin))
            product = torch.linalg.cross(flow, noisy).sum(1)
            plain.append(view.off(normalize(product), found.origin)[0])
    angles, apart = np.array(ours).T
    assert angles.mean() < 0.9 * np.mean(plain) and np.median(angles) < 0.9 * np.median(plain)
    assert angles.mean() < 1.0 and apart.mean() < 0.01


def test_a_door_that_is_flat_turns_though_all_of_its_flow_has_one_direction() -> None:
    y, z = torch.meshgrid(torch.linspace(0.1, 1.0, 10), torch.linspace(-0.5, 0.5, 10), indexing="ij")
    door = torch.stack([torch.zeros_like(y), y, z], -1).reshape(1, -1, 3)
    part = torch.ones(door.shape[:2], dtype=torch.bool)
    up = JointScrew(torch.tensor([True]), torch.tensor([[0.0, 0.0, 1.0]]), torch.zeros(1, 3))
    flow, projection = flow_of_screw(up, door, part), projection_of_screw(up, door, part)
    assert torch.equal(normalize(flow), torch.tensor([-1.0, 0, 0]).expand_as(flow))
    assert screw_of_projection(door, flow, projection, part)[0].revolute
    nothing, residual = screw_of_projection(door, torch.zeros_like(flow), projection, part)
    assert not nothing.axis.any() and residual == 1.0


@pytest.mark.parametrize("pitch", [0.05, 0.5])
def test_the_axis_of_a_thread_is_found_and_its_angle_is_the_residual(pitch: float) -> None:
    angle = torch.arange(24) * (2 * math.pi / 24)
    rim = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], -1)[None]
    part = torch.ones(rim.shape[:2], dtype=torch.bool)
    up = JointScrew(torch.tensor([True]), torch.tensor([[0.0, 0.0, 1.0]]), torch.zeros(1, 3))
    flow = flow_of_screw(up, rim, part) + pitch * up.axis[:, None]
    found, residual = screw_of_projection(rim, flow, projection_of_screw(up, rim, part), part)
    assert found.revolute
    torch.testing.assert_close(found.axis, up.axis, atol=1e-5, rtol=0)
    torch.testing.assert_close(found.origin, up.origin, atol=1e-5, rtol=0)
    assert math.asin(float(residual)) == pytest.approx(math.atan(pitch), abs=1e-4)
