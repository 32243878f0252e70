"""What the hand learns from its pulls, in a toy world with a spring: a door whose part stops at its limits."""

from __future__ import annotations

import math

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
    """

    def __init__(self, sliding: bool = False, limit: float = 1.6, opened: float = 0.0) -> None:
        super().__init__(sliding)
        self.limit, self.opened, self.lost, self.farthest = limit, opened, 0, 0.0
        self.qvel = torch.zeros(1, 8)

    def observe(self, state: TensorDict) -> TensorDict:
        td = super().observe(state["policy"])
        td.update(state.exclude("policy"))
        td["observation", "qvel"] = self.qvel
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
            lag = constants.stiffness * stretch + constants.damping * (stretch - before) / self.period
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


def opens(
    door: SpringDoor, policy: FlowPolicy | TouchPolicy, *flows: Tensor | float, until: float, steps: int = 150
) -> int:
    """Control steps until the door is open; a flow that is a number is so many times the true one."""
    state = policy.initial_state(torch.Size([1]))
    for step in range(steps):
        td = policy(predicted(door, state, flows))
        state = td["next"].select(*state.keys())
        door.step(td["action"])
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


@pytest.mark.parametrize("sliding", [True, False])
def test_a_wrong_sense_is_found_out_within_one_hold(sliding: bool) -> None:
    door = SpringDoor(sliding, limit=0.6 if sliding else 1.6)
    steps = opens(door, TouchPolicy(LIMITS, OPTIONS, False), -1.0, until=0.5)
    assert steps < 100 and door.lost == 0, "it turned round at the limit without tearing off"


@pytest.mark.parametrize("sliding", [True, False])
def test_a_true_flow_opens_as_it_does_without_touch(sliding: bool) -> None:
    door = SpringDoor(sliding, limit=0.6 if sliding else 1.6)
    assert opens(door, TouchPolicy(LIMITS, OPTIONS, False), 1.0, until=0.5) < 80 and door.lost == 0


def test_at_a_limit_the_spring_does_not_tear_even_from_full_speed() -> None:
    door = SpringDoor(sliding=True, limit=0.1)
    opens(door, TouchPolicy(LIMITS, OPTIONS, False), 1.0, until=9.0, steps=45)
    assert door.lost == 0 and 0.02 < door.farthest < TEARS


def turned(degrees: float) -> Tensor:
    angle = math.radians(degrees)
    c, s = math.cos(angle), math.sin(angle)
    return torch.tensor([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def test_the_screw_is_measured_where_the_network_errs() -> None:
    """The flow is 35 degrees off; what was felt corrects it to a few, and the pull holds."""
    door, policy = SpringDoor(sliding=True, limit=0.6), TouchPolicy(LIMITS, OPTIONS, False)
    assert opens(door, policy, turned(35.0), until=0.5) < 100
    assert door.lost == 0
    state = policy.initial_state(torch.Size([1]))
    door = SpringDoor(sliding=True, limit=0.6)
    while door.opened < 0.3:
        td = policy(predicted(door, state, (turned(35.0),)))
        state = td["next"].select("policy", "touch")
        door.step(td["action"])
    way = normalize(td["prediction", "flow"][0].mean(0))
    assert float(way @ torch.tensor([-1.0, 0.0, 0.0])) > math.cos(math.radians(8.0))


def test_a_direction_in_which_neither_sense_moves_is_left() -> None:
    """The flow is across the drawer's rail but for a little: both senses are tried, then the rest of it."""
    door = SpringDoor(sliding=True, limit=0.6)
    assert opens(door, TouchPolicy(LIMITS, OPTIONS, False), turned(88.0), until=0.5) < 150
    door = SpringDoor(sliding=True, limit=0.6)
    assert opens(door, FlowPolicy(FLOW, LIMITS, OPTIONS), turned(88.0), until=0.5) == 150, "without touch it fails"


def test_the_next_hypothesis_is_tried_where_the_first_meets_a_limit() -> None:
    across = turned(90.0)
    door = SpringDoor(sliding=True, limit=0.6)
    assert opens(door, TouchPolicy(LIMITS, OPTIONS, True), across, 1.0, until=0.5) < 120


def test_nothing_is_changed_before_something_was_felt() -> None:
    door, policy = SpringDoor(), TouchPolicy(LIMITS, OPTIONS, False)
    td = policy(predicted(door, policy.initial_state(torch.Size([1])), (1.0,)))
    assert torch.equal(td["prediction", "flow"], td["privileged", "flow"])


def test_what_one_environment_feels_does_not_reach_another() -> None:
    policy = TouchPolicy(LIMITS, OPTIONS, False)
    doors, states, alone = [SpringDoor(True, 0.6), SpringDoor(False)], [], []
    for door, flow in zip(doors, (-1.0, 1.0), strict=True):
        state = policy.initial_state(torch.Size([1]))
        for _ in range(35):
            td = policy(predicted(door, state, (flow,)))
            state = td["next"].select("policy", "touch")
            door.step(td["action"])
        states.append(predicted(door, state, (flow,)))
        alone.append(policy(states[-1].clone()))
    together = policy(torch.cat(states))
    assert int(together["policy", "phase"][0]) == PULL
    torch.testing.assert_close(together["action"], torch.cat([td["action"] for td in alone]), rtol=0, atol=1e-5)


def test_the_state_starts_without_knowledge_and_survives_a_batch() -> None:
    state = TouchState.initial((3,))
    assert state.batch_size == torch.Size([3]) and not any(bool(value.any()) for value in state.values())
