"""policy=umpnet: what it compares with, what it remembers, and whom it goes towards."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from fb3d_rl.contract import GOAL_POINTS
from fb3d_rl.models.umpnet import AWAY, TOWARDS, Seen, UmpNet
from fb3d_rl.policies.flow_policy import FlowPolicyOptions
from fb3d_rl.policies.hand import VelocityLimits
from fb3d_rl.policies.policy import initial_state
from fb3d_rl.policies.umpnet_policy import BANNED, CLOSE, UmpnetFlow, umpnet_policy

POINTS = 64


class ToX(UmpNet):
    """Knows that a pull along +x brings the part towards the other image's state and one along -x away from it, the
    farther the straighter, and that the points beyond the plane x = 0 can be moved; keeps what it was given.
    """

    def see(self, points: Tensor, valid: Tensor, other: Tensor) -> Seen:
        self.given = points, valid, other
        now = points[:, :-GOAL_POINTS]
        return Seen(now[..., 0], now, now)

    def judge(self, at: tuple[Tensor, Tensor], directions: Tensor) -> tuple[Tensor, Tensor]:
        along = directions[..., 0]
        arrow = torch.zeros(*along.shape, 3)
        arrow[..., TOWARDS], arrow[..., AWAY] = along, -along
        return along.abs(), arrow


@pytest.fixture
def policy() -> UmpnetFlow:
    return UmpnetFlow(ToX(True, 8, "delayed", torch.Generator().manual_seed(0)))


def frame(policy: UmpnetFlow, held: bool = False, sense: float = 1.0, seed: int = 0) -> TensorDictBase:
    points = torch.randn(2, POINTS, 3, generator=torch.Generator().manual_seed(seed))
    made = TensorDict(
        {
            "observation": {
                "points": points, "valid": torch.ones(2, POINTS, dtype=torch.bool),
                "part_mask": points[..., 1] > 0, "tool_pose": torch.tensor([0.0, 1, 0, 1, 0, 0, 0]).expand(2, 7),
                "attached": torch.full((2, 1), held), "goal_sense": torch.full((2, 1), sense),
            }
        },
        batch_size=[2],
    )  # fmt: skip
    return made.update(policy.initial_state(torch.Size([2])))


def goal() -> dict[str, Tensor]:
    return {"points": torch.full((2, GOAL_POINTS, 3), 7.0), "valid": torch.ones(2, GOAL_POINTS, dtype=torch.bool)}


def given(policy: UmpnetFlow) -> Tensor:
    """The other cloud [2, GOAL_POINTS, 3] that the network was last given."""
    assert isinstance(policy.net, ToX)
    points, _, other = policy.net.given
    assert not other[:, :-GOAL_POINTS].any()
    return points[:, -GOAL_POINTS:]


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_it_goes_towards_a_goal_and_away_from_the_start(policy: UmpnetFlow, sense: float) -> None:
    """A flow is turned over by who follows it where the part is to be closed: the pull stays what it is."""
    without = policy(frame(policy, sense=sense))["prediction", "flow"]
    with_goal = policy(frame(policy, sense=sense).update({"goal": goal()}))["prediction", "flow"]
    for flow, way in ((without, -1.0), (with_goal, 1.0)):
        size, part = flow.norm(dim=-1), frame(policy)["observation", "part_mask"]
        assert not size[~part].any() and (size[part] > 0).all()
        assert (sense * way * flow[part][:, 0] / size[part] > 0.98).all()
        points = frame(policy)["observation", "points"]
        assert (points[torch.arange(2), size.argmax(1), 0] == points[..., 0].masked_fill(~part, -9).amax(1)).all()
    assert (given(policy) == 7.0).all()


def test_it_remembers_what_it_saw_first(policy: UmpnetFlow) -> None:
    first = frame(policy)
    after = policy(first)["next", "umpnet"]
    second = frame(policy, seed=1)
    second["umpnet"] = after
    policy(second)
    expected = torch.zeros(2, GOAL_POINTS, 3)
    expected[:, :POINTS] = first["observation", "points"]
    assert torch.equal(given(policy), expected)
    assert set(initial_state(policy, torch.Size([2])).keys(True, True)) == {("umpnet", key) for key in after.keys()}


def test_pulls_in_vain_are_not_repeated_until_something_moves(policy: UmpnetFlow) -> None:
    state, ways = policy.initial_state(torch.Size([2]))["umpnet"], []
    for number, moved in enumerate([True, False, False, True]):
        now = frame(policy, held=True).update({"goal": goal(), "pull": {"moved": torch.full((2, 1), moved)}})
        now["umpnet"] = state
        flow = policy(now)["prediction", "flow"]
        state = now["next", "umpnet"]
        ways.append(flow[0][now["observation", "part_mask"][0]][0])
        assert int(state["banned"].any(-1).sum(-1)[0]) == (number if not moved else 0)
    assert state["banned"].shape == (2, BANNED, 3)
    assert float(ways[0] @ ways[1]) < CLOSE and float(ways[2] @ ways[0]) < CLOSE and float(ways[2] @ ways[1]) < CLOSE
    assert torch.equal(ways[3], ways[0])


def test_the_policy_acts_in_the_simulated_task_as_well(policy: UmpnetFlow) -> None:
    """Nothing says there what pulls have moved, and nothing is banned."""
    whole = umpnet_policy(policy.net, VelocityLimits(1.0, 1.0), FlowPolicyOptions())
    assert {"umpnet", "policy"} == set(initial_state(whole, torch.Size([2])).keys())
    state = policy(frame(policy, held=True))["next", "umpnet"]
    assert state["last"].any() and not state["banned"].any()
