"""One flow sample: its mask, flow, joint state and view agree with each other and follow from the generator alone."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from fb3d_rl import contract
from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.camera.raycast import CameraOptions
from fb3d_rl.camera.views import View, ViewRange
from fb3d_rl.data.samples import SampleOptions, draw_sample
from fb3d_rl.errors import UserError
from fb3d_rl.scene.observer import MIN_VISIBLE, observe
from fb3d_rl.scene.posed import Posed

CAMERA = CameraOptions(resolution=32)
OPTIONS = SampleOptions(points=256, camera=CAMERA)


@pytest.fixture(scope="module")
def views(procedural_objects: dict[str, ArticulatedObject]) -> list[Posed]:
    return [Posed(obj, CAMERA) for obj in procedural_objects.values()]


def test_unmasked_samples_mark_every_point_and_move_all_parts(views: list[Posed]) -> None:
    """The other samples are what they are without the option."""
    options = dataclasses.replace(OPTIONS, unmasked_share=0.5)
    everything = dataclasses.replace(OPTIONS, all_parts_share=1.0)
    found = {True: 0, False: 0}
    for view in views:
        for seed in range(8):
            sample = draw_sample(view, options, np.random.default_rng(seed))
            usual = draw_sample(view, OPTIONS, np.random.default_rng(seed))
            every = draw_sample(view, everything, np.random.default_rng(seed))
            assert sample is not None and usual is not None and every is not None
            unmasked = torch.equal(sample["observation", "part_mask"], sample["observation", "valid"])
            found[unmasked] += 1
            like = every if unmasked else usual
            assert torch.equal(sample["privileged", "flow"], like["privileged", "flow"])
            assert unmasked or torch.equal(sample["observation", "part_mask"], usual["observation", "part_mask"])
    assert min(found.values()) >= 4
    with pytest.raises(UserError, match="unmasked_share"):
        dataclasses.replace(OPTIONS, all_parts_share=0.6, unmasked_share=0.5)


@pytest.mark.parametrize("all_parts", [0.0, 1.0])
def test_mask_is_where_the_flow_is(views: list[Posed], all_parts: float) -> None:
    options = dataclasses.replace(OPTIONS, all_parts_share=all_parts)
    for view in views:
        for seed in range(5):
            sample = draw_sample(view, options, np.random.default_rng(seed))
            assert sample is not None
            contract.check(sample, "sample")
            norm = sample["privileged", "flow"].norm(dim=-1)
            mask, valid = sample["observation", "part_mask"], sample["observation", "valid"]
            # No point of these objects lies on a joint's axis to 1e-4 of the farthest one's radius.
            assert torch.equal(mask, norm > 1e-4)
            assert (norm[~mask] == 0).all() and not (mask & ~valid).any()
            assert norm.max() == pytest.approx(1.0, abs=1e-6)
            assert (sample["observation", "points"][~valid] == 0).all()
            if all_parts:
                assert sample["target"] == -1
            else:
                assert int(sample["target"]) in view.openable and int(mask.sum()) >= MIN_VISIBLE


def test_some_parts_are_a_part_and_others_with_it(views: list[Posed]) -> None:
    view = next(v for v in views if v.obj.category == "StorageFurniture")
    options = dataclasses.replace(OPTIONS, all_parts_share=0.2, some_parts_share=0.5)
    counts, tree = [], view.tree.descendants.numpy()
    for seed in range(80):
        sample = draw_sample(view, options, np.random.default_rng(seed))
        alone = draw_sample(view, dataclasses.replace(options, some_parts_share=0.0), np.random.default_rng(seed))
        assert sample is not None and alone is not None
        mask, own = sample["observation", "part_mask"], alone["observation", "part_mask"]
        norm = sample["privileged", "flow"].norm(dim=-1)
        assert (norm[~mask] == 0).all() and (norm[mask] > 1e-6).float().mean() > 0.95
        assert not (own & ~mask).any(), "the part itself is always asked for"
        more = bool((mask & ~own).any())
        counts.append((int(alone["target"]) == -1, more))
        assert (int(sample["target"]) == -1) >= more
    assert not any(more for everything, more in counts if everything)
    assert 0.3 < np.mean([more for _, more in counts]) < 0.6 and len(tree) > 2


def test_padding_follows_the_points(views: list[Posed]) -> None:
    sample = draw_sample(views[0], dataclasses.replace(OPTIONS, points=2000), np.random.default_rng(0))
    assert sample is not None
    valid = sample["observation", "valid"]
    count = int(valid.sum())
    assert MIN_VISIBLE < count < 1024 and valid[:count].all()
    assert (sample["privileged", "flow"][~valid] == 0).all()
    assert (sample["observation", "points"][valid][:, 2] > -1e-4).all()  # on the ground or above


def test_a_sample_follows_from_its_generator_alone(views: list[Posed]) -> None:
    first, again = (draw_sample(views[0], OPTIONS, np.random.default_rng([7, 1, 3])) for _ in range(2))
    other = draw_sample(views[0], OPTIONS, np.random.default_rng([7, 1, 4]))
    assert first is not None and again is not None and other is not None
    assert (first == again).all()
    assert not torch.equal(first["observation", "points"], other["observation", "points"])


def test_direction_points_towards_opening(views: list[Posed]) -> None:
    for view in views:
        assert view.openable
        for link in view.openable:
            direction = view.direction(link)
            j = view.obj.movable.index(link)
            assert direction[j] == np.sign(view.opened[j] - view.closed[j])
            assert torch.count_nonzero(direction) == 1
        assert torch.count_nonzero(view.direction()) == len(view.obj.movable)


def test_flow_leads_from_closed_to_open(views: list[Posed]) -> None:
    for view in views:
        link = view.openable[0]
        j = view.obj.movable.index(link)
        qpos = view.closed.copy()
        qpos[j] += 0.3 * (view.opened[j] - view.closed[j])
        cloud = observe(view, view.poses(qpos), View(20.0, 35.0), 400, np.random.default_rng(0))
        points, links = cloud.points, cloud.links
        flow = cloud.with_truth(view.direction(link))["flow"].double()
        further = qpos.copy()
        further[j] += 1e-4 * (view.opened[j] - view.closed[j])
        here, there = (torch.from_numpy(view.poses(q)[links]) for q in (qpos, further))
        homogeneous = torch.cat([torch.as_tensor(points).double(), torch.ones(len(points), 1).double()], dim=-1)
        moved = (there @ torch.linalg.inv(here) @ homogeneous[..., None])[:, :3, 0] - homogeneous[:, :3]
        moved = torch.where(torch.as_tensor(links >= 0)[:, None], moved, 0.0)
        torch.testing.assert_close(flow, moved / moved.norm(dim=-1).max(), atol=2e-3, rtol=0)


def test_shares_are_kept(views: list[Posed]) -> None:
    view = next(v for v in views if v.obj.category == "StorageFurniture")
    always = dataclasses.replace(OPTIONS, closed_share=1.0, others_closed=1.0, all_parts_share=0.0, points=512)
    fixed = dataclasses.replace(always, views=ViewRange((0.0, 0.0), (30.0, 30.0)))
    closed = observe(view, view.poses(view.closed), View(0.0, 30.0), 1024, np.random.default_rng(0))
    everything = {tuple(point) for point in closed.points.tolist()}
    sample = draw_sample(view, fixed, np.random.default_rng(1))
    assert sample is not None
    seen = sample["observation", "points"][sample["observation", "valid"]]
    assert {tuple(point) for point in seen.tolist()} <= everything  # the picture of the closed object
    parts = [
        draw_sample(view, dataclasses.replace(OPTIONS, all_parts_share=0.5), np.random.default_rng(i))
        for i in range(60)
    ]
    share = np.mean([sample is not None and int(sample["target"]) == -1 for sample in parts])
    assert 0.3 < share < 0.7


def test_a_part_that_does_not_show_gives_no_sample(views: list[Posed]) -> None:
    view = next(v for v in views if v.obj.category == "Microwave")
    behind = dataclasses.replace(
        OPTIONS, views=ViewRange((180.0, 180.0), (0.0, 0.0)), closed_share=1.0, others_closed=1.0
    )
    assert draw_sample(view, behind, np.random.default_rng(0)) is None


def test_a_joint_written_the_other_way_round_gives_the_same_sample(views: list[Posed]) -> None:
    obj = next(v for v in views if v.obj.category == "StorageFurniture").obj
    links = []
    for link in obj.links:
        joint = link.joint
        if joint is not None and joint.movable:
            joint = dataclasses.replace(joint, axis=-joint.axis, limits=(-joint.limits[1], -joint.limits[0]))
        links.append(dataclasses.replace(link, joint=joint))
    plain, turned = Posed(obj, CAMERA), Posed(dataclasses.replace(obj, links=tuple(links)), CAMERA)
    np.testing.assert_array_equal(turned.opened, -plain.opened)
    for seed in range(4):
        first, second = (draw_sample(view, OPTIONS, np.random.default_rng(seed)) for view in (plain, turned))
        assert first is not None and second is not None
        assert torch.equal(first["observation", "part_mask"], second["observation", "part_mask"])
        for key in (("observation", "points"), ("privileged", "flow")):
            torch.testing.assert_close(first[key], second[key], atol=1e-5, rtol=0)
