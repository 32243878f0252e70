"""The contact-point heuristic (supplement, I.E)."""

from __future__ import annotations

import pytest
import torch

from fb3d_rl.assets.gripper import HAND_LENGTH
from fb3d_rl.policies.contact import CANDIDATES, Contact, ContactOptions, _motions, best_candidate, choose_contact

TOWARDS = torch.tensor([[-1.0, 0.0, 0.0]])
"""Axis of a hand that stands before the plate."""


def plate(n: int = 25) -> torch.Tensor:
    """A plate [1, n * n, 3] in the plane x = 0, 1 m wide."""
    y, z = torch.meshgrid(torch.linspace(-0.5, 0.5, n), torch.linspace(0.5, 1.5, n), indexing="ij")
    return torch.stack([torch.zeros_like(y), y, z], -1).reshape(1, -1, 3)


def choose(points: torch.Tensor, flow: torch.Tensor, avoid: torch.Tensor | None = None, **options: float):  # type: ignore[no-untyped-def]
    valid = torch.ones(points.shape[:2], dtype=torch.bool)
    nobody = torch.zeros_like(valid)
    camera = torch.tensor([[-3.0, 0.0, 1.0]])
    contact = choose_contact(
        points,
        valid,
        flow.norm(dim=-1) > 0,
        flow,
        camera,
        camera,
        TOWARDS,
        nobody if avoid is None else avoid,
        ContactOptions(**options),
    )[0]
    return contact.point, contact.flow, contact.standoff


def on(points: torch.Tensor, contact: torch.Tensor) -> bool:
    """Whether the contact is a point of the cloud; where none is chosen it is 0."""
    return bool((points[0] == contact[0]).all(-1).any())


def hinge_flow(points: torch.Tensor) -> torch.Tensor:
    """A plate hinged at y = 0.5 that opens towards -x: flow [1, N, 3] with largest norm 1."""
    return torch.stack([points[..., 1] - 0.5, torch.zeros_like(points[..., 1]), torch.zeros_like(points[..., 1])], -1)


def test_takes_a_large_flow_but_not_the_rim() -> None:
    points = plate()
    contact, direction, standoff = choose(points, hinge_flow(points))
    assert -0.5 < contact[0, 1] < -0.25, "far from the hinge, and not on the edge at -0.5"
    assert 0.5 < contact[0, 2] < 1.5
    assert torch.allclose(direction[0], torch.tensor([-1.0, 0.0, 0.0]), atol=1e-5)
    assert torch.equal(direction, standoff)


def test_a_rough_spot_is_left_for_a_flat_one_at_least_2_cm_away() -> None:
    points = plate()
    rough = points[..., 1] < -0.2
    bumps = torch.rand(points.shape[:2], generator=torch.Generator().manual_seed(0))
    points[..., 0] = torch.where(rough, -0.1 * bumps, points[..., 0])
    contact, _, _ = choose(points, hinge_flow(points), min_flow=0.3)
    assert on(points, contact) and contact[0, 1] >= -0.25


def test_does_not_choose_what_the_hand_cannot_reach() -> None:
    points = plate()
    shelf = points[points[..., 1] < 0.1].clone() - torch.tensor([0.2, 0.0, 0.0])  # a board in front of the outer part
    cloud = torch.cat([points, shelf[None]], dim=1)
    flow = torch.cat([hinge_flow(points), torch.zeros(1, len(shelf), 3)], dim=1)
    contact, _, _ = choose(cloud, flow, min_flow=0.1)
    assert on(points, contact) and contact[0, 1] > 0.1


def test_avoids_points_tried_before() -> None:
    points = plate()
    flow = hinge_flow(points)
    first, _, _ = choose(points, flow)
    avoid = (points - first[:, None]).norm(dim=-1) < 0.2
    second, _, _ = choose(points, flow, avoid)
    assert on(points, first) and on(points, second) and (first - second).norm() >= 0.2


def test_a_sash_that_slides_in_its_plane_is_touched_along_its_normal() -> None:
    points = plate()
    flow = torch.tensor([0.0, 1.0, 0.0]).expand_as(points).clone()
    _, direction, standoff = choose(points, flow)
    assert torch.allclose(direction[0], torch.tensor([0.0, 1.0, 0.0]), atol=1e-5)
    assert torch.allclose(standoff[0], torch.tensor([-1.0, 0.0, 0.0]), atol=1e-3), "towards the camera's side"


def test_no_flow_no_contact_and_padding_is_never_chosen() -> None:
    points = plate()
    for value in choose(points, torch.zeros_like(points)):
        assert torch.equal(value, torch.zeros_like(value))
    valid = torch.ones(points.shape[:2], dtype=torch.bool)
    valid[:, :300] = False
    flow = hinge_flow(points)
    flow[:, :300] *= 100.0
    chosen, _ = choose_contact(
        points,
        valid,
        valid,
        flow,
        torch.tensor([[-3.0, 0.0, 1.0]]),
        torch.tensor([[-3.0, 0.0, 1.0]]),
        TOWARDS,
        torch.zeros_like(valid),
        ContactOptions(min_flow=0.0),
    )
    contact = chosen.point
    assert on(points[:, 300:], contact) and not on(points[:, :300], contact)


def test_where_something_stands_before_the_whole_part_the_hand_comes_along_the_line_of_sight() -> None:
    points = plate()
    board = points - torch.tensor([0.3, 0.0, 0.0])  # before the whole plate; the camera looks over it
    cloud = torch.cat([points, board], dim=1)
    flow = torch.cat([hinge_flow(points), torch.zeros(1, cloud.shape[1] - points.shape[1], 3)], dim=1)
    camera = torch.tensor([[-3.0, 0.0, 4.0]])
    valid = torch.ones(cloud.shape[:2], dtype=torch.bool)
    chosen, _ = choose_contact(
        cloud, valid, flow.norm(dim=-1) > 0, flow, camera, camera, TOWARDS, torch.zeros_like(valid), ContactOptions()
    )
    assert torch.allclose(chosen.flow[0], torch.tensor([-1.0, 0.0, 0.0]), atol=1e-5)
    assert torch.allclose(chosen.standoff, torch.nn.functional.normalize(camera - chosen.point), atol=1e-4)


@pytest.mark.parametrize("height", [0.1, 0.2])
def test_the_hand_does_not_come_from_below_the_ground(height: float) -> None:
    points = plate()[..., [1, 2, 0]] + torch.tensor([0.0, 0.0, height])  # a lying plate that moves down
    flow = torch.tensor([0.0, 0.0, -1.0]).expand_as(points).clone()
    camera = torch.tensor([[-3.0, 0.0, 0.05]])  # seen from below
    valid = torch.ones(points.shape[:2], dtype=torch.bool)
    chosen, _ = choose_contact(
        points, valid, valid, flow, camera, camera, TOWARDS, torch.zeros_like(valid), ContactOptions()
    )
    standoff = chosen.standoff
    assert standoff[0, 2] > -0.1 and standoff.norm() == pytest.approx(1.0, abs=1e-4)


def test_leaves_a_point_whose_way_is_blocked_for_one_that_can_be_moved() -> None:
    points = plate()
    post = torch.zeros(1, 40, 3)  # where the outer edge of the plate comes along after a turn of about 0.9 rad
    post[..., 0], post[..., 1], post[..., 2] = -0.75, -0.1, torch.linspace(0.4, 1.6, 40)
    cloud = torch.cat([points, post], dim=1)
    flow = torch.cat([hinge_flow(points), torch.zeros(1, 40, 3)], dim=1)
    free, _, _ = choose(points, hinge_flow(points), near=0.0)
    contact, _, _ = choose(cloud, flow, near=0.0)
    assert on(points, free) and on(points, contact) and contact[0, 1] > free[0, 1] + 0.1, (
        "nearer to the hinge than without the post"
    )


def test_of_points_that_move_alike_the_one_near_the_hand_is_chosen_but_no_near_one_that_moves_less() -> None:
    points = plate()
    valid, camera = torch.ones(points.shape[:2], dtype=torch.bool), torch.tensor([[-3.0, 0.0, 1.0]])
    nobody = torch.zeros_like(valid)
    drawer = TOWARDS.expand_as(points)
    for side in (-1.0, 1.0):
        hand = torch.tensor([[-0.5, side, 0.5]])
        drawn, _ = choose_contact(points, valid, valid, drawer, camera, hand, TOWARDS, nobody, ContactOptions())
        assert side * drawn.point[0, 1] > 0
        flow = hinge_flow(points)
        # With the default the way counts for more, down to the least flow that does.
        for near, least in ((1.0, 0.8), (ContactOptions.near, ContactOptions.min_flow)):
            options = ContactOptions(near=near)
            door, _ = choose_contact(points, valid, valid, flow, camera, hand, TOWARDS, nobody, options)
            assert flow[(points == door.point[:, None]).all(-1)].norm() >= least * flow.norm(dim=-1).amax()


def test_the_best_candidate_is_good_has_its_flow_and_is_near_to_where_the_hand_is_by_now() -> None:
    points = plate()[:, torch.randperm(625, generator=torch.Generator().manual_seed(0))]
    valid, camera = torch.ones(points.shape[:2], dtype=torch.bool), torch.tensor([[-3.0, 0.0, 1.0]])
    flow = hinge_flow(points)
    _, candidates = choose_contact(
        points, valid, valid, flow, camera, camera, TOWARDS, torch.zeros_like(valid), ContactOptions()
    )
    share = candidates.share[0, :, 0]
    assert len(share) == CANDIDATES and ((share >= 0.5) | (share == 0)).all() and (share > 0).sum() > 20
    for height in (0.6, 1.0, 1.4):
        hand = torch.tensor([[-0.1, -0.3, height]])
        best = best_candidate(candidates, hand, TOWARDS, ContactOptions())
        assert (best.point - hand).norm() < 0.25
        here = (points == best.point[:, None]).all(-1)
        torch.testing.assert_close(best.share, flow[here].norm(dim=-1, keepdim=True) / flow.norm(dim=-1).amax())
        assert torch.allclose(best.flow, TOWARDS, atol=1e-5) and torch.allclose(best.standoff, TOWARDS, atol=1e-3)


def test_the_hand_turns_no_further_than_it_has_to() -> None:
    candidates = Contact.none((1,))
    candidates.flow[0, :2] = candidates.standoff[0, 0] = TOWARDS
    candidates.standoff[0, 1] = torch.tensor([0.0, 1.0, 0.0])  # as near, but to be touched from the side
    candidates.share[0, :2] = 1.0
    candidates.point[0, 0, 0] = 0.02
    best = best_candidate(candidates, torch.tensor([[-0.3, 0.0, 0.0]]), TOWARDS, ContactOptions())
    assert (best == candidates.at(torch.tensor([0]))).all(), "the farther one, and none of the empty rows"


def test_a_hand_that_would_come_from_below_the_ground_takes_another_way() -> None:
    """The gripper's own hand, and the run-up that it needs, have to fit between the ground and the point."""
    points = plate()
    points[..., 2] -= 0.5
    flow = torch.tensor([-0.6, 0.0, -0.8]).expand_as(points).clone()  # the hand would come from below
    lowest = 0.8 * (ContactOptions().run_up + HAND_LENGTH)
    for height, fits in ((lowest - 0.01, False), (lowest + 0.01, True)):
        lift = torch.tensor([0.0, 0.0, height])
        _, direction, standoff = choose(points * torch.tensor([1.0, 1.0, 0.0]) + lift, flow)
        assert torch.allclose(direction, standoff, atol=1e-5) == fits


def doors() -> tuple[torch.Tensor, torch.Tensor]:
    """Two plates side by side [1, N, 3] with flows away from each other's hinges, the right one's a little larger."""
    left = plate()
    right = left + torch.tensor([0.0, 1.2, 0.0])
    outward = torch.zeros_like(right)
    outward[..., 0] = -(right[..., 1] - 0.7) * 1.1
    return torch.cat([left, right], 1), torch.cat([hinge_flow(left), outward], 1)


def test_without_a_mask_each_point_moves_with_what_is_around_it() -> None:
    points, flow = doors()
    contact = points[:, [5 * 25 + 12, 625 + 15 * 25 + 12]]
    true = flow[:, [5 * 25 + 12, 625 + 15 * 25 + 12]]
    centre, velocity, omega = _motions(points, None, flow, contact)
    assert torch.equal(centre, contact)
    torch.testing.assert_close(velocity, true, atol=0.03, rtol=0)
    assert omega[0, 0, 2] < -0.5 and omega[0, 1, 2] > 0.5, "one turns clockwise, the other one counter-clockwise"
    together = _motions(points, flow.norm(dim=-1) > 0, flow, contact)
    assert together[0].shape == (1, 1, 3)


def test_without_a_mask_what_moves_is_chosen_and_what_does_not_is_in_the_way() -> None:
    points = plate()
    shelf = points[points[..., 1] < 0.1].clone() - torch.tensor([0.2, 0.0, 0.0])  # a board in front of the outer part
    cloud = torch.cat([points, shelf[None]], dim=1)
    flow = torch.cat([hinge_flow(points), torch.full((1, len(shelf), 3), 1e-3)], dim=1)
    valid = torch.ones(cloud.shape[:2], dtype=torch.bool)
    camera = torch.tensor([[-3.0, 0.0, 1.0]])
    chosen, _ = choose_contact(cloud, valid, None, flow, camera, camera, TOWARDS, ~valid, ContactOptions(min_flow=0.1))
    assert chosen.point[0, 1] > 0.1 and chosen.point[0, 0] == 0.0
