"""What the hand learns from its pulls, in a toy world with a spring: a door whose part stops at its limits."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from fb3d_rl.geometry.transforms import normalize
from fb3d_rl.policies.flow_policy import FlowPolicy
from fb3d_rl.policies.flow_state import PULL
from fb3d_rl.policies.options import FlowPolicyOptions, TouchOptions
from fb3d_rl.policies.touch import FLOW, TouchPolicy, TouchState
from tests.policies.test_flow_policy import LIMITS, ToyDoor

OPTIONS = FlowPolicyOptions()
TEARS = 0.06


class SpringDoor(ToyDoor):
    """A door that a spring holds: the part follows freely between its limits, at which the spring stretches.

    Units m, rad. The hand's slides lag behind their command in proportion to the spring's force.

    Args:
        sliding: whether it slides, instead of turning.
        limit: how far it opens.
        spring: strength of the spring, in units of what the policy takes it for.
    """

    def __init__(self, sliding: bool = False, limit: float = 1.6, spring: float = 1.0) -> None:
        super().__init__(sliding)
        self.limit, self.spring, self.sense, self.lost, self.farthest = limit, spring, 1.0, 0, 0.0
        self.qvel = torch.zeros(1, 8)

    def observe(self, state: TensorDict) -> TensorDict:
        td = super().observe(state["policy"])
        td.update(state.exclude("policy"))
        td["observation", "qvel"] = self.qvel
        td["observation", "goal_sense"] = torch.full((1, 1), self.sense)
        return td

    def step(self, action: Tensor) -> None:
        if self.held is None:
            super().step(action)
            self.opened = min(max(self.opened, 0.0), self.limit)
            self.qvel = torch.zeros(1, 8)
            self.qvel[:, :3] = LIMITS.linear * action[:, :3]
            return
        constants, command = TouchOptions(), LIMITS.linear * action[0, :3]
        before, start = self._stretch(), self.qpos[0, :3].clone()
        self.qpos[:, 3:6] += self.period * LIMITS.angular * action[:, 3:6]
        velocity = command
        for _ in range(50):  # the lag depends on the stretch that it leads to
            self.qpos[0, :3] = start + self.period * velocity
            self.opened = self._nearest(self.tip()[0])
            stretch = self._stretch()
            lag = self.spring * (constants.stiffness * stretch + constants.damping * (stretch - before) / self.period)
            velocity = 0.5 * velocity + 0.5 * (command - lag)
        self.qvel[0, :3] = velocity
        self.farthest = max(self.farthest, float(self._stretch().norm()))
        if self._stretch().norm() > TEARS:
            self.held, self.lost = None, self.lost + 1

    def _stretch(self) -> Tensor:
        return self.tip()[0] - self.points()[self.held]

    def _nearest(self, tip: Tensor) -> float:
        """How far the door is open when its held point is nearest to the tip."""
        if self.sliding:
            free = -float(tip[0])
        else:
            free = math.atan2(-float(tip[0]), 0.4 - float(tip[1]))
        return min(max(free, 0.0), self.limit)


def pulls(
    door: SpringDoor, policy: FlowPolicy | TouchPolicy, *flows: Tensor | float, steps: int = 150
) -> Iterator[TensorDict]:
    """The TensorDict of each control step, after the door has moved; its "next" is the state of the following one.

    A flow that is a number is so many times the true one.
    """
    state = policy.initial_state(torch.Size([1]))
    for _ in range(steps):
        td = policy(predicted(door, state, flows))
        state = td["next"].select(*state.keys())
        door.step(td["action"])
        yield td


def opens(
    door: SpringDoor, policy: FlowPolicy | TouchPolicy, *flows: Tensor | float, until: float, steps: int = 150
) -> int:
    """Control steps until the door is open."""
    for step, _ in enumerate(pulls(door, policy, *flows, steps=steps)):
        if door.opened >= until:
            return step
    return steps


def predicted(door: SpringDoor, state: TensorDict, flows: tuple[Tensor | float, ...]) -> TensorDict:
    td = door.observe(state)
    true = td["privileged", "flow"]
    each = [true * flow if isinstance(flow, float) else true @ flow for flow in flows]
    td["prediction", "flow"] = each[0]
    if len(each) > 1:
        td["prediction", "flows"] = torch.stack(each, 1)
        td["prediction", "log_probabilities"] = torch.linspace(0.0, -1.0, len(each))[None, :, None].expand(
            1, -1, true.shape[1]
        )
    return td


def touch(**options: Any) -> TouchPolicy:
    return TouchPolicy(LIMITS, replace(OPTIONS, **options), proposals=False)


@pytest.mark.parametrize("spring", [0.75, 1.0, 2.0])
@pytest.mark.parametrize("sliding", [True, False])
def test_a_wrong_sense_is_found_out_within_one_hold(sliding: bool, spring: float) -> None:
    """Also where the spring is weaker or stronger than it is taken for, as it is by direction."""
    door = SpringDoor(sliding, 0.6 if sliding else 1.6, spring)
    steps = opens(door, touch(), -1.0, until=0.5)
    assert steps < 100 and door.lost == 0, "it turned round at the limit without tearing off"


@pytest.mark.parametrize("sliding", [True, False])
def test_a_true_flow_opens_nearly_as_fast_as_without_touch(sliding: bool) -> None:
    doors = [SpringDoor(sliding, limit=0.6 if sliding else 1.6) for _ in range(2)]
    plain = opens(doors[0], FlowPolicy(FLOW, LIMITS, OPTIONS), 1.0, until=0.5)
    assert opens(doors[1], touch(), 1.0, until=0.5) <= plain + 6 < 80 and doors[1].lost == 0


def test_at_a_limit_the_spring_does_not_tear_even_from_full_speed() -> None:
    door = SpringDoor(sliding=True, limit=0.1)
    opens(door, touch(), 1.0, until=9.0, steps=45)
    assert door.lost == 0 and 0.02 < door.farthest < TEARS


def turned(degrees: float) -> Tensor:
    angle = math.radians(degrees)
    c, s = math.cos(angle), math.sin(angle)
    return torch.tensor([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def test_the_screw_is_measured_where_the_network_errs() -> None:
    """The flow is 35 degrees off; what the pull measures corrects it to a few, and the pull holds."""
    door, policy = SpringDoor(sliding=True, limit=0.6), touch()
    assert opens(door, policy, turned(35.0), until=0.5) < 100
    assert door.lost == 0
    door = SpringDoor(sliding=True, limit=0.6)
    td = next(td for td in pulls(door, policy, turned(35.0), steps=60) if door.opened > 0.3)
    way = normalize(td["prediction", "flow"][0].mean(0))
    assert float(way @ torch.tensor([-1.0, 0.0, 0.0])) > math.cos(math.radians(8.0))


def test_a_direction_in_which_neither_sense_moves_is_left() -> None:
    """The flow is across the drawer's rail but for a little: both senses are tried, then the rest of it."""
    door = SpringDoor(sliding=True, limit=0.6)
    assert opens(door, touch(), turned(88.0), until=0.5) < 150
    door = SpringDoor(sliding=True, limit=0.6)
    assert opens(door, FlowPolicy(FLOW, LIMITS, OPTIONS), turned(88.0), until=0.5) == 150, "without touch it fails"


def test_the_next_hypothesis_is_tried_where_the_first_meets_a_limit() -> None:
    across = turned(90.0)
    door = SpringDoor(sliding=True, limit=0.6)
    assert opens(door, TouchPolicy(LIMITS, OPTIONS, True), across, 1.0, until=0.5) < 120


def test_nothing_is_changed_before_something_is_known_even_beside_a_door_that_is_held() -> None:
    """Without a mask the prediction takes each point's flow from another proposal, which a correction would not."""
    policy = TouchPolicy(LIMITS, replace(OPTIONS, mask="none"), proposals=True)
    flows, held = (1.0, -1.0), SpringDoor()
    state = next(td["next"] for td in pulls(held, policy, *flows) if held.held is not None)
    fresh = predicted(SpringDoor(), policy.initial_state(torch.Size([1])), flows)
    fresh["prediction", "flow"] = torch.where(torch.arange(400)[None, :, None] % 2 == 0, 1.0, -1.0) * fresh[FLOW]
    both = policy(torch.cat([predicted(held, state, flows), fresh.clone()]))
    assert torch.equal(both[FLOW][1], fresh[FLOW][0])


def test_a_pull_goes_on_where_the_hand_hides_the_part() -> None:
    class Hidden(SpringDoor):
        def observe(self, state: TensorDict) -> TensorDict:
            td = super().observe(state)
            td["observation", "part_mask"] &= self.held is None
            return td

    assert opens(Hidden(sliding=True, limit=0.6), touch(), 1.0, until=0.5) < 80


def test_what_a_pull_has_moved_counts_after_it_was_let_go() -> None:
    """Stuck far from where it began, the hand lets go and pulls the same way again instead of closing the drawer."""
    door = SpringDoor(sliding=True, limit=0.45)
    opens(door, touch(), 1.0, until=9.0, steps=110)
    assert door.opened > 0.35


def test_a_part_that_gives_way_after_all_is_pulled_on_without_retries() -> None:
    door = SpringDoor(sliding=True, limit=0.3)
    for td in pulls(door, touch(retries=0), 1.0):
        if bool(td["next", "touch", "limits"].any()):
            door.limit = 0.9  # what was in the way is gone
    assert door.opened > 0.6


def test_a_limit_is_found_where_all_pulls_are_slow() -> None:
    door = SpringDoor(sliding=True, limit=0.6)
    assert opens(door, touch(pull_speed=0.2), -1.0, until=0.3) < 120


def test_closing_follows_the_flow_backwards() -> None:
    door = SpringDoor(sliding=True, limit=0.6)
    door.opened, door.sense = 0.4, -1.0
    assert any(door.opened < 0.05 for _ in pulls(door, touch(), 1.0, steps=120)), f"it is still {door.opened} m open"


def test_a_second_hold_at_another_radius_agrees_with_the_first() -> None:
    """The screw of a door, measured along two arcs whose speeds differ."""
    policy = touch()
    state = TouchState.initial((1,)).apply(lambda x: x.double())
    hinge, turns = torch.tensor([0.0, 0.4, 0.5]).double(), torch.linspace(0.0, 0.8, 30).double()
    for radius in (0.8, 0.3, 0.8):
        arc = hinge + torch.stack([-turns.sin(), -turns.cos(), 0 * turns], 1) * radius
        for before, after in itertools.pairwise(arc):
            if not bool(state.origin.any()):
                state.origin = before[None]
            state.measured = before[None]
            policy._measure(state, after[None], normalize(after - before)[None], torch.ones(1, 1, dtype=torch.bool))
    twist = torch.linalg.solve(state.information[0] + 1e-3 * torch.eye(6).double(), state.moment[0])
    for angle in (0.2, 0.6):
        arm = hinge + 0.8 * torch.tensor([-math.sin(angle), -math.cos(angle), 0.0]).double() - state.origin[0]
        way = normalize(twist[:3] + torch.linalg.cross(twist[3:], arm))
        true = torch.tensor([-math.cos(angle), math.sin(angle), 0.0]).double()
        assert float(way @ true) > math.cos(math.radians(3.0))


def test_what_one_environment_knows_does_not_reach_another() -> None:
    policy = touch()
    doors, states, alone = [SpringDoor(True, 0.6), SpringDoor(False)], [], []
    for door, flow in zip(doors, (-1.0, 1.0), strict=True):
        *_, last = pulls(door, policy, flow, steps=35)
        states.append(predicted(door, last["next"], (flow,)))
        alone.append(policy(states[-1].clone()))
    together = policy(torch.cat(states))
    assert int(together["policy", "phase"][0]) == PULL
    torch.testing.assert_close(together["action"], torch.cat([td["action"] for td in alone]), rtol=0, atol=1e-5)
