"""The supplement's own choice of a contact point (I.E, I.F), as experiment=supplement sets it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from fb3d_rl.algos import setup
from fb3d_rl.geometry.points import knn, pca_curvature
from fb3d_rl.policies.contact import ContactOptions, choose_contact
from fb3d_rl.policies.flow_policy import FlowPolicyOptions

CAMERA = torch.tensor([[-3.0, 0.0, 1.0]])


@pytest.fixture
def options(config: Callable[[str, list[str]], Any]) -> FlowPolicyOptions:
    paper = setup.flow_policy_options(config("train", ["experiment=supplement", "algo=artflownet_paper"]))
    assert paper == setup.flow_policy_options(config("evaluate", ["experiment=supplement"]))
    return paper


def by_the_book(points: Tensor, flow: Tensor, options: ContactOptions) -> int:
    """Row of the point that the supplement's sentence names, point by point."""
    everything = torch.ones(points.shape[:2], dtype=torch.bool)
    curvature = pca_curvature(points, knn(points, points, options.neighbors, everything), everything, CAMERA)[0][0]
    largest = int(flow[0].norm(dim=-1).argmax())
    if curvature[largest] <= options.curvature:
        return largest
    distance = (points[0] - points[0, largest]).norm(dim=-1)
    flat = [i for i in range(len(distance)) if curvature[i] <= options.curvature and distance[i] >= 0.02]
    return min(flat, key=lambda i: float(distance[i]))


@pytest.mark.parametrize("rough", [0.0, 0.05])
def test_it_is_the_largest_flow_or_the_nearest_flat_point_2_cm_away(rough: float, options: FlowPolicyOptions) -> None:
    generator = torch.Generator().manual_seed(0)
    y, z = torch.rand(2, 600, generator=generator)
    x = torch.where(y < 0.15, rough * torch.rand(600, generator=generator), torch.zeros(600))
    points = torch.stack([x, y, z + 0.2], -1)[None]
    flow = torch.stack([y - 1.0, 0.3 * (y - 1.0), torch.zeros(600)], -1)[None]  # not along the normal
    valid = torch.ones(1, 600, dtype=torch.bool)
    wanted = by_the_book(points, flow, options.contact)
    assert (wanted == int(flow[0].norm(dim=-1).argmax())) == (rough == 0.0)
    for hand in (CAMERA, torch.tensor([[-1.0, 2.0, 0.5]])):  # wherever the hand is
        contact, _ = choose_contact(
            points, valid, valid, flow, CAMERA, hand, torch.tensor([[-1.0, 0.0, 0.0]]), ~valid, options.contact
        )
        assert torch.equal(contact.point[0], points[0, wanted])
        assert torch.equal(contact.standoff, contact.flow), "the hand comes against the flow (I.F)"
        torch.testing.assert_close(contact.flow[0], flow[0, wanted] / flow[0, wanted].norm())


def test_it_tries_once(options: FlowPolicyOptions) -> None:
    assert options.retries == 0 and FlowPolicyOptions().retries is None
