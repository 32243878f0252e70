"""UMP-DI: what it reads of the true flow, and where it takes the direction from."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from fb3d_rl.models.direction_net import DirectionNet, SearchOptions, directions_at
from fb3d_rl.policies.direction_policy import DirectionFlow


@pytest.fixture
def module() -> DirectionFlow:
    return DirectionFlow(DirectionNet(neighbors=16, generator=torch.Generator().manual_seed(0)).eval())


def scene(held: bool) -> TensorDict:
    random = torch.Generator().manual_seed(1)
    points = torch.rand(2, 90, 3, generator=random)
    valid = torch.arange(90).expand(2, -1) < 80
    part = points[..., 0] > 0.4
    flow = (torch.rand(2, 90, 3, generator=random) - 0.5).masked_fill(~(part & valid)[..., None], 0.0)
    pose = torch.cat([points[:, 5] + 0.01, torch.tensor([[1.0, 0, 0, 0]]).expand(2, 4)], dim=-1)
    observation = {"points": points, "valid": valid, "part_mask": part, "tool_pose": pose,
                   "attached": torch.tensor([[held], [held]])}  # fmt: skip
    return TensorDict({"observation": observation, "privileged": {"flow": flow}}, batch_size=[2])


def test_until_it_is_held_the_true_flow_gives_the_contact_but_not_the_direction(module: DirectionFlow) -> None:
    td = module(scene(held=False))
    flow, true = td["prediction", "flow"], td["privileged", "flow"]
    torch.testing.assert_close(flow.norm(dim=-1), true.norm(dim=-1))
    observed = [td["observation", key] for key in ("points", "valid", "part_mask")]
    direction = directions_at(module.net, *observed, true.norm(dim=-1).argmax(-1), SearchOptions())
    torch.testing.assert_close(flow, direction[:, None] * true.norm(dim=-1, keepdim=True))
    turned = scene(held=False)
    turned["privileged", "flow"] = -true.roll(1, -1)
    torch.testing.assert_close(module(turned)["prediction", "flow"], flow)


def test_while_it_is_held_nothing_true_is_read_and_the_point_at_the_tip_counts(module: DirectionFlow) -> None:
    td = module(scene(held=True))
    flow, part = td["prediction", "flow"], td["observation", "part_mask"] & td["observation", "valid"]
    torch.testing.assert_close(flow.norm(dim=-1), part.float())
    other = scene(held=True)
    other["privileged", "flow"] = torch.full_like(other["privileged", "flow"], torch.nan)
    assert torch.equal(module(other)["prediction", "flow"], flow)
    observed = [td["observation", key] for key in ("points", "valid", "part_mask")]
    away = (observed[0] - td["observation", "tool_pose"][:, None, :3]).norm(dim=-1).masked_fill(~part, torch.inf)
    direction = directions_at(module.net, *observed, away.argmin(-1), SearchOptions())
    torch.testing.assert_close(flow, direction[:, None] * part[..., None])
