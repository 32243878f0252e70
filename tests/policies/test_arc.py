"""Arcs of FlowBot++ in the toy worlds: when the policy looks, and what it follows in between."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor

from fb3d_rl.policies.arc import FLOW, PROJECTION, TWIST, ArcFlow, expert_arc_policy, true_motions
from fb3d_rl.policies.flow_policy import FlowPolicy, expert_policy
from fb3d_rl.policies.flow_state import PULL, SELECT
from fb3d_rl.policies.options import ArcOptions, FlowPolicyOptions
from fb3d_rl.policies.policy import initial_state
from fb3d_rl.policies.touch import TouchPolicy
from tests.policies.test_flow_policy import LIMITS
from tests.policies.test_touch import SpringDoor

KEYS = [*(("observation", key) for key in ("points", "valid", "part_mask")), ("privileged", "flow")]
OPTIONS = FlowPolicyOptions()


class Looks:
    """The true flow and projection, and how often they were asked for."""

    def __init__(self) -> None:
        self.count = 0

    def __call__(self, points: Tensor, valid: Tensor, part_mask: Tensor, flow: Tensor) -> tuple[Tensor, Tensor]:
        self.count += len(points)
        return true_motions(points, valid, part_mask, flow)


class Guess(Looks):
    """A flow to all sides, which no joint has."""

    def __call__(self, points: Tensor, valid: Tensor, part_mask: Tensor, flow: Tensor) -> tuple[Tensor, Tensor]:
        _, projection = super().__call__(points, valid, part_mask, flow)
        return torch.randn(flow.shape, generator=torch.Generator().manual_seed(0)), projection


def arcs(look: Looks, options: ArcOptions, touch: bool = False) -> TensorDictModuleBase:
    flow = ArcFlow(TensorDictModule(look, in_keys=KEYS, out_keys=[FLOW, PROJECTION]), options)
    follows = TouchPolicy(LIMITS, OPTIONS, False) if touch else FlowPolicy(FLOW, LIMITS, OPTIONS, twist_key=TWIST)
    return TensorDictSequential(flow, follows)


def episode(
    door: SpringDoor, policy: TensorDictModuleBase, until: float = 1.3, blind: str = "", steps: int = 150
) -> list[TensorDict]:
    """The steps until the door is open; after the first one of the hold "wrong" makes all of what is seen of the door
    wrong, and "hidden" hides it.
    """
    state, done, held = initial_state(policy, torch.Size([1])), [], False
    while door.opened < until and len(done) < steps:
        td = door.observe(state)
        if blind == "hidden" and held:
            td["observation", "part_mask"] = torch.zeros_like(td["observation", "part_mask"])
        if blind == "wrong" and held:
            td["observation", "points"] = torch.rand(td["observation", "points"].shape)
            td["privileged", "flow"] = -td["privileged", "flow"]
        held = bool(td["observation", "attached"])
        policy(td)
        state = td["next"].select(*state.keys())
        done.append(td.clone())  # the door moves in place
        door.step(td["action"])
    return done


@pytest.mark.parametrize("sliding", [False, True])
def test_in_open_loop_an_arc_is_followed_to_the_end_without_another_look(sliding: bool) -> None:
    until = 0.6 if sliding else 1.3
    policy = expert_arc_policy(LIMITS, replace(OPTIONS, arc=ArcOptions(look_every=None)))
    seeing, blind = SpringDoor(sliding), SpringDoor(sliding)
    steps, again = episode(seeing, policy, until), episode(blind, policy, until, blind="wrong")
    assert seeing.opened >= until and seeing.lost == 0
    assert len(steps) == len(again)
    assert all(torch.equal(one["action"], other["action"]) for one, other in zip(steps, again, strict=True))
    expert = SpringDoor(sliding)
    assert len(episode(expert, expert_policy(LIMITS, OPTIONS), until)) == pytest.approx(len(steps), abs=2)


@pytest.mark.parametrize("every", [1, 3, 10, None])
def test_it_looks_to_choose_a_point_when_it_takes_hold_and_every_so_many_steps(every: int | None) -> None:
    look, door = Looks(), SpringDoor()
    steps = episode(door, arcs(look, ArcOptions(look_every=every)))
    held = [bool(td["observation", "attached"]) for td in steps]
    counts = [0, *(int(td["next", "arc", "looks"]) for td in steps)]
    looked = [after > before for before, after in zip(counts, counts[1:], strict=False)]
    start = held.index(True)
    assert door.opened >= 1.3 and door.lost == 0 and all(held[start:]) and len(held) - start > 12
    assert [k for k, here in enumerate(looked[:start]) if here] == [0], "to choose a contact point"
    due = [k for k in range(len(held) - start) if k == 0 or (every is not None and k % every == 0)]
    assert [k for k, here in enumerate(looked[start:]) if here] == due
    assert counts[-1] == look.count == 1 + len(due)


def test_while_the_part_is_hidden_the_arc_goes_on() -> None:
    look, door = Looks(), SpringDoor()
    episode(door, arcs(look, ArcOptions(look_every=1)), blind="hidden")
    assert door.opened >= 1.3 and door.lost == 0 and look.count == 2


def test_where_no_arc_explains_the_flow_it_is_followed_step_by_step() -> None:
    look = Guess()
    policy = arcs(look, ArcOptions(look_every=None))
    steps = episode(SpringDoor(), policy, steps=60)
    held = [td for td in steps if td["observation", "attached"]]
    assert len(held) > 3 and not any(td[TWIST].any() for td in steps)
    flows = FlowPolicy(FLOW, LIMITS, OPTIONS)
    for td in held:
        action = td["action"].clone()
        assert torch.equal(flows(td)["action"], action)
    assert look.count >= len(held)
    trusting = episode(SpringDoor(), arcs(Guess(), ArcOptions(look_every=None, residual=1.0)), steps=60)
    assert any(td[TWIST].any() for td in trusting)


def test_each_environment_looks_for_itself() -> None:
    look = Looks()
    policy = arcs(look, ArcOptions(look_every=10))
    door = SpringDoor()
    held = next(td for td in episode(door, policy) if td["observation", "attached"])
    later = door.observe(held["next"].select("policy", "arc"))  # pulls, and has an arc
    fresh = SpringDoor().observe(initial_state(policy, torch.Size([1])))
    assert int(later["policy", "phase"]) == PULL and int(fresh["policy", "phase"]) == SELECT
    before = look.count
    both = torch.cat([later, fresh])
    state = both["arc"].clone()
    policy(both)
    assert look.count == before + 1
    assert (both["arc"] == state).all(), "the state of the step is not written over"
    for row, alone in enumerate((later, fresh)):
        policy(alone)
        torch.testing.assert_close(both["action"][row], alone["action"][0])
        assert int(both["next", "arc", "looks"][row]) == int(alone["next", "arc", "looks"])
    assert not both[FLOW][0, 0].isnan().any() and both[TWIST][0].any() and not both[TWIST][1].any()


@pytest.mark.parametrize("every", [1, None])
def test_touch_corrects_the_flow_of_an_arc_that_begins_at_a_limit(every: int | None) -> None:
    class Backwards(Looks):
        def __call__(self, points: Tensor, valid: Tensor, part_mask: Tensor, flow: Tensor) -> tuple[Tensor, Tensor]:
            flow, projection = super().__call__(points, valid, part_mask, flow)
            return (-flow if bool(door.held is not None) else flow), projection

    door, look = SpringDoor(), Backwards()
    steps = episode(door, arcs(look, ArcOptions(look_every=every), touch=True))
    assert door.opened >= 1.3 and door.lost == 0
    assert look.count < 5 if every is None else look.count > len(steps) / 2
