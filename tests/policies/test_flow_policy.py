"""The flow policy in a toy world without physics: a hand that moves exactly as commanded and a door on a hinge."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from fb3d_rl.assets.gripper import HAND_LENGTH
from fb3d_rl.contract import ACTION_DIM
from fb3d_rl.geometry.transforms import euler_xyz_to_matrix, matrix_to_quaternion
from fb3d_rl.models.artflownet import ArtFlowNet
from fb3d_rl.policies.commands import above_ground
from fb3d_rl.policies.flow_policy import FlowPolicy, FlowPolicyOptions, artflownet_policy, expert_policy
from fb3d_rl.policies.flow_state import APPROACH, PULL, RELEASE, RETREAT, SELECT, TRAVEL, FlowState
from fb3d_rl.policies.hand import VelocityLimits, hand_axis, joint_velocities

LIMITS = VelocityLimits(linear=2.0, angular=3.0)
DT = 0.05
TOOL = torch.tensor([0.12, 0.0, 0.0])


class ToyDoor:
    """A door in the plane x = 0 that turns about the z axis through (0, 0.4) and opens towards -x; units m, rad."""

    def __init__(self, sliding: bool = False, period: float = DT) -> None:
        self.period = period
        y, z = torch.meshgrid(torch.linspace(-0.39, 0.39, 20), torch.linspace(0.3, 1.1, 20), indexing="ij")
        self.grid = torch.stack([torch.zeros_like(y), y, z], -1).reshape(-1, 3)
        self.sliding, self.opened = sliding, 0.0
        self.qpos = torch.tensor([[-1.2, 0.0, 0.7, 0, 0, 0, 0, 0]])
        self.held: Tensor | None = None

    def points(self) -> Tensor:
        if self.sliding:
            return self.grid - torch.tensor([self.opened, 0.0, 0.0])
        arm = self.grid[:, 1] - 0.4  # negative: the door's points lie at y < 0.4
        x, y = arm * math.sin(self.opened), 0.4 + arm * math.cos(self.opened)
        return torch.stack([x, y, self.grid[:, 2]], -1)

    def flow(self) -> Tensor:
        if self.sliding:
            return torch.tensor([-1.0, 0.0, 0.0]).expand(len(self.grid), 3)
        arm = self.grid[:, 1] - 0.4
        moved = torch.stack([arm * math.cos(self.opened), -arm * math.sin(self.opened), torch.zeros_like(arm)], -1)
        return moved / moved.norm(dim=-1).max()

    def tip(self) -> Tensor:
        return self.qpos[:, :3] + (euler_xyz_to_matrix(self.qpos[:, 3:6]) @ TOOL[:, None])[..., 0]

    def observe(self, state: TensorDict) -> TensorDict:
        n = len(self.grid)
        rotation = euler_xyz_to_matrix(self.qpos[:, 3:6])
        return TensorDict(
            {
                "observation": {
                    "points": self.points()[None],
                    "valid": torch.ones(1, n, dtype=torch.bool),
                    "part_mask": torch.ones(1, n, dtype=torch.bool),
                    "qpos": self.qpos,
                    "qvel": torch.zeros(1, 8),
                    "tool_pose": torch.cat([self.tip(), matrix_to_quaternion(rotation)], -1),
                    "attached": torch.tensor([[self.held is not None]]),
                    "contact_force": torch.zeros(1, 1),
                    "camera_position": torch.tensor([[-3.0, 0.0, 1.0]]),
                    "goal_sense": torch.ones(1, 1),
                },
                "privileged": {"flow": self.flow()[None]},
                "policy": state,
            },
            batch_size=[1],
        )

    def step(self, action: Tensor) -> None:
        scale = torch.tensor([LIMITS.linear] * 3 + [LIMITS.angular] * 3 + [0.0] * 2)
        self.qpos = self.qpos + self.period * action * scale
        tip = self.tip()[0]
        if self.held is None:
            distance = (self.points() - tip).norm(dim=-1)
            if distance.min() < 0.05 and tip[0] > self.points()[distance.argmin(), 0] - 0.01:
                self.held = distance.argmin()
        elif self.sliding:
            self.opened = max(0.0, -float(tip[0]))
        else:
            self.opened = math.atan2(-float(tip[0]), 0.4 - float(tip[1]))


def start() -> TensorDict:
    return FlowState.initial((1,)).packed()


def rollout(door: ToyDoor, policy: FlowPolicy, until: float, steps: int = 150) -> list[int]:
    state, phases = start(), []
    while door.opened < until and len(phases) < steps:
        td = policy(door.observe(state))
        state = td["next", "policy"]
        phases.append(int(state["phase"]))
        assert td["action"].shape == (1, ACTION_DIM)
        assert td["action"].abs().max() <= 1.0 + 1e-6
        assert torch.equal(td["action"][:, 6:], torch.zeros(1, 2)), "the fingers stay closed (supplement, II.C)"
        door.step(td["action"])
    return phases


def test_opens_a_hinged_door_and_turns_with_it() -> None:
    door = ToyDoor()
    phases = rollout(door, expert_policy(LIMITS), until=1.4)
    assert phases[-1] == PULL and APPROACH in phases
    assert door.opened >= 1.4 and len(phases) < 150
    away = -euler_xyz_to_matrix(door.qpos[:, 3:6])[0, :, 0]  # from the tip to the hand
    normal = torch.tensor([-math.cos(door.opened), math.sin(door.opened), 0.0])
    assert away @ normal > 0.95, "the hand keeps standing on the door as it did at contact"


def test_opens_a_drawer_straight() -> None:
    door = ToyDoor(sliding=True)
    rollout(door, expert_policy(LIMITS), until=0.5)
    assert door.opened >= 0.5
    assert abs(float(door.tip()[0, 1] - door.points()[door.held, 1])) < 0.06


def test_touches_where_the_lever_is_long() -> None:
    policy = expert_policy(LIMITS)
    td = policy(ToyDoor().observe(start()))
    contact = td["next", "policy", "contact_point"][0]
    assert contact[1] < 0.0, "the hinge is at y = 0.4"
    assert torch.allclose(td["next", "policy", "standoff"][0], torch.tensor([-1.0, 0.0, 0.0]), atol=1e-4)


def test_a_guarded_approach_that_does_not_hold_is_given_up_and_another_point_is_tried() -> None:
    options = FlowPolicyOptions(patience=0.05)
    policy, door = expert_policy(LIMITS, options), ToyDoor()
    state = start()
    points, phases = [], []
    for _ in range(120):
        td = door.observe(state)
        pressing = int(state["phase"]) == APPROACH and door.tip()[0, 0] > -0.02
        td["observation", "contact_force"] = torch.tensor([[100.0 if pressing else 0.0]])
        td = policy(td)
        state = td["next", "policy"]
        phases.append(int(state["phase"]))
        points.append(tuple(state["contact_point"][0].tolist()))
        door.qpos = door.qpos + DT * td["action"] * torch.tensor([2.0] * 3 + [3.0] * 3 + [0.0] * 2)
    assert RETREAT in phases and int(state["tries"]) >= 1
    first, second = list(dict.fromkeys(p for p in points if any(p)))[:2]
    assert math.dist(first, second) >= options.retry_distance


def test_without_flow_it_waits() -> None:
    policy = expert_policy(LIMITS)
    td = ToyDoor().observe(start())
    td["privileged", "flow"] = torch.zeros_like(td["privileged", "flow"])
    out = policy(td)
    assert int(out["next", "policy", "phase"]) == SELECT
    assert torch.allclose(out["action"], torch.zeros(1, 8), atol=1e-6)


def test_environments_of_a_batch_do_not_mix() -> None:
    policy = expert_policy(LIMITS)
    near, far = ToyDoor(), ToyDoor(sliding=True)
    far.qpos = far.qpos + torch.tensor([[-0.3, 0.2, 0.1, 0.2, -0.1, 0.3, 0, 0]])
    singles = [door.observe(start()) for door in (near, far)]
    both = policy(torch.cat([td.clone() for td in singles]))
    for i, td in enumerate(singles):
        assert torch.allclose(both["action"][i], policy(td)["action"][0], atol=1e-5)


@pytest.mark.parametrize("angles", [(0.0, 0.0, 0.0), (0.3, -0.4, 0.9), (-1.2, 0.7, 1.5)])
def test_joint_velocities_move_the_tip_as_asked(angles: tuple[float, float, float]) -> None:
    door = ToyDoor()
    door.qpos[:, 3:6] = torch.tensor(angles)
    td = door.observe(start())
    tip, hand = door.tip(), hand_axis(td["observation", "tool_pose"])
    velocity, angular = torch.tensor([[0.3, -0.2, 0.4]]), torch.tensor([[0.2, 0.3, -0.1]])
    action = joint_velocities(td["observation"], hand, velocity, angular, LIMITS)
    h = 1e-3
    scale = torch.tensor([LIMITS.linear] * 3 + [LIMITS.angular] * 3 + [0.0] * 2)
    door.qpos = door.qpos + h * action * scale
    assert torch.allclose((door.tip() - tip) / h, velocity, atol=2e-3)
    turned = -euler_xyz_to_matrix(door.qpos[:, 3:6])[..., 0]
    assert torch.allclose((turned - hand) / h, torch.linalg.cross(angular, hand), atol=2e-2)


def test_the_hand_is_kept_above_the_ground() -> None:
    down, tip = torch.tensor([[-0.1, 0.0, -0.995]]).double(), torch.tensor([[0.0, 0.0, 0.1]]).double()
    lifted = above_ground(down, tip, 0.08)
    assert float(lifted.norm()) == pytest.approx(1.0, abs=1e-3)
    assert float(tip[0, 2] + HAND_LENGTH * lifted[0, 2]) == pytest.approx(0.08), "the far end of the gripper's own hand"
    both = above_ground(torch.cat([down, -down]), tip.expand(2, 3), 0.08)
    assert torch.equal(both, torch.cat([lifted, -down])), "one that points up is left as it is"


def test_flowbot3d_sees_nothing_privileged_and_the_expert_differs_by_its_flow_alone() -> None:
    learned = artflownet_policy(ArtFlowNet(neighbors=8, generator=torch.Generator().manual_seed(0)), LIMITS)
    assert not [key for key in learned.in_keys if "privileged" in key]
    door = ToyDoor()
    td = door.observe(start())
    td["prediction", "flow"] = td["privileged", "flow"]
    same = FlowPolicy(("prediction", "flow"), LIMITS)(td.clone())["action"]
    assert torch.equal(same, expert_policy(LIMITS)(td)["action"])


def test_the_flow_at_the_held_point_is_read_from_the_part_s_motion_where_the_hand_hides_it() -> None:
    policy, door = expert_policy(LIMITS, FlowPolicyOptions(lead=0.0)), ToyDoor()
    door.opened = 0.7
    td = door.observe(start())
    points, flow = td["observation", "points"], td["privileged", "flow"]
    index = int(points[0, :, 1].argmin())
    seen = ((points - points[:, index : index + 1]).norm(dim=-1) > 0.25)[0]
    state = start()
    state["phase"], state["pull"] = torch.full((1, 1), PULL), torch.tensor([[0.0, 0.0, 1.0]])
    td["observation", "tool_pose"][:, :3], td["observation", "attached"] = points[:, index], torch.ones(1, 1).bool()
    td["observation", "valid"], td["policy"] = seen[None], state
    found = policy(td)["next", "policy", "pull"]
    assert torch.allclose(found, flow[:, index] / flow[:, index].norm(), atol=0.02)
    td["privileged", "flow"] = torch.zeros_like(flow)
    assert torch.equal(policy(td)["next", "policy", "pull"], state["pull"]), "where none is seen the last one counts"


def test_a_door_is_opened_by_half_a_turn_without_drifting_off_the_held_point() -> None:
    door = ToyDoor()
    rollout(door, expert_policy(LIMITS), until=3.0)
    assert door.opened >= 3.0
    away = -euler_xyz_to_matrix(door.qpos[:, 3:6])[0, :, 0]
    normal = torch.tensor([-math.cos(door.opened), math.sin(door.opened), 0.0])
    assert away @ normal > 0.9, "the hand turned with the door, and not back where the flow had turned by more than pi"
    assert float((door.tip() - door.points()[door.held]).norm()) < 0.03


def test_a_hand_that_lost_hold_backs_off_from_there() -> None:
    policy, door = expert_policy(LIMITS), ToyDoor()
    state, phases = start(), []
    for step in range(150):
        td = policy(door.observe(state))
        state = td["next", "policy"]
        phases.append(int(state["phase"]))
        door.step(td["action"])
        if door.opened > 1.0 and RETREAT not in phases:
            door.held, lost = None, step
        if phases[-1] == RETREAT:
            backing = step
    assert backing - lost < 8, "10 cm at 1 m/s, wherever the first contact was"
    assert PULL in phases[backing:]


def test_a_stuck_hand_tears_itself_off_across_the_flow_and_tries_elsewhere() -> None:
    options = FlowPolicyOptions()
    policy, door = expert_policy(LIMITS, options), ToyDoor(sliding=True)
    state, phases, touched = start(), [], []
    for _ in range(150):
        td = policy(door.observe(state))
        state = td["next", "policy"]
        phases.append(int(state["phase"]))
        first = len(touched) < 2
        if phases[-1] == RELEASE:
            velocity = policy_velocity(td["action"])
            assert abs(float(velocity[0])) < 0.1 and float(velocity.norm()) > 1.0, "the drawer can only move along x"
        blocked = door.opened > 0.2 and door.held is not None and first
        before = door.qpos.clone()
        door.step(td["action"])
        if phases[-1] not in (APPROACH, PULL):
            door.held = None
        if door.held is not None and (not touched or touched[-1] != int(door.held)):
            touched.append(int(door.held))
        if blocked:
            door.qpos = before
    assert RELEASE in phases
    assert phases.count(PULL) * DT > options.stuck_time
    assert len(touched) == 2 and (door.grid[touched[0]] - door.grid[touched[1]]).norm() > 0.5 * options.retry_distance
    assert door.opened > 0.5


def policy_velocity(action: Tensor) -> Tensor:
    """The commanded velocity [3] of the hand's origin, m/s."""
    return action[0, :3] * LIMITS.linear


def test_a_hand_that_is_held_by_chance_keeps_its_direction() -> None:
    policy, door = expert_policy(LIMITS), ToyDoor()
    state = policy(door.observe(start()))["next", "policy"]
    assert int(state["phase"]) == TRAVEL
    door.qpos[:, 5] = 0.8  # turned about z on its way
    door.held = torch.tensor(0)
    state = policy(door.observe(state))["next", "policy"]
    hand = -euler_xyz_to_matrix(door.qpos[:, 3:6])[..., 0]
    assert int(state["phase"]) == PULL
    assert torch.allclose(state["standoff"], hand, atol=1e-5)


def test_a_hand_that_is_halted_on_its_way_goes_back_as_it_came_and_tries_elsewhere() -> None:
    policy, door = expert_policy(LIMITS), ToyDoor()
    state, phases, wall = start(), [], True
    first: Tensor | None = None
    for _ in range(150):
        td = door.observe(state)
        halted = wall and float(door.tip()[0, 0]) > -1.0  # something that the cloud does not show
        td["observation", "contact_force"] = torch.full((1, 1), 1000.0 * halted)
        td = policy(td)
        state = td["next", "policy"]
        phases.append(int(state["phase"]))
        if phases[-1] == TRAVEL and first is None:
            first = state["contact_point"].clone()
        if phases[-1] == RETREAT and wall:
            wall = False
            assert float(policy_velocity(td["action"])[0]) < -0.5, "it came along +x"
            torch.testing.assert_close(state["tried"][0, :1], first)
        if not (halted and phases[-1] == TRAVEL):
            door.step(td["action"])
        if door.opened > 0.5:
            break
    assert not wall and APPROACH not in phases[: phases.index(RETREAT)]
    assert PULL in phases and door.opened > 0.5
    second = phases.index(TRAVEL, phases.index(RETREAT))
    assert SELECT not in phases[second:], "it chose another point at once"


@pytest.mark.parametrize("frequency", [10, 20, 40])
def test_the_policy_s_times_are_seconds_however_often_it_acts(frequency: int) -> None:
    """A hand that presses without being held, that is held and stuck, and that does not come off."""
    period, options = 1 / frequency, FlowPolicyOptions()
    policy, door = expert_policy(VelocityLimits(2.0, 3.0, period), options), ToyDoor()

    def seconds_until_it_leaves(phase: int, attached: bool, force: float) -> float:
        state = start()
        tip = door.tip()
        state["phase"], state["contact_point"], state["tip"] = torch.full((1, 1), phase), tip, tip
        state["standoff"] = state["pull"] = torch.tensor([[-1.0, 0.0, 0.0]])
        for step in range(1, 200):
            td = door.observe(state)
            td["observation", "attached"] = torch.tensor([[attached]])
            td["observation", "contact_force"] = torch.tensor([[force]])
            state = policy(td)["next", "policy"]
            if int(state["phase"]) != phase:
                return step * period
        raise AssertionError("it never left")

    for phase, attached, force, wanted in (
        (APPROACH, False, 100.0, options.patience),
        (TRAVEL, False, 100.0, options.stuck_time),
        (PULL, True, 0.0, options.stuck_time),
        (RELEASE, True, 0.0, options.release_time),
    ):
        assert seconds_until_it_leaves(phase, attached, force) == pytest.approx(wanted + period)


@pytest.mark.parametrize("frequency", [10, 20, 40])
def test_what_counts_as_stuck_is_a_speed(frequency: int) -> None:
    period = 1 / frequency
    policy = expert_policy(VelocityLimits(2.0, 3.0, period))
    for speed, stuck in ((0.07, True), (0.09, False)):
        door, phases = ToyDoor(sliding=True), []
        state = start()
        state["phase"], state["tip"] = torch.full((1, 1), PULL), door.tip()
        state["standoff"] = state["pull"] = torch.tensor([[-1.0, 0.0, 0.0]])
        for _ in range(frequency):
            door.qpos[0, 0] -= speed * period
            td = door.observe(state)
            td["observation", "attached"] = torch.ones(1, 1, dtype=torch.bool)
            state = policy(td)["next", "policy"]
            phases.append(int(state["phase"]))
        assert (RELEASE in phases) == stuck


@pytest.mark.parametrize("frequency", [5, 10, 40])
def test_a_door_is_opened_at_any_frequency(frequency: int) -> None:
    period = 1 / frequency
    door = ToyDoor(period=period)
    rollout(door, expert_policy(VelocityLimits(2.0, 3.0, period)), until=1.4, steps=round(7.5 / period))
    assert door.opened >= 1.4
    assert float((door.tip() - door.points()[door.held]).norm()) < 0.03, "no drift off the held point"


@pytest.mark.parametrize("retries", [None, 0, 1])
def test_after_its_last_retry_the_hand_stays_where_it_lost_hold(retries: int | None) -> None:
    policy, door = expert_policy(LIMITS, FlowPolicyOptions(retries=retries)), ToyDoor()
    state, held, losses = start(), False, 0
    for _ in range(200):
        td = policy(door.observe(state))
        state = td["next", "policy"]
        door.step(td["action"])
        losses += held and door.held is None
        if door.held is not None and int(state["phase"]) == PULL and door.opened > 0.1:
            door.held = None  # it never holds for long
            losses += 1
            door.opened = 0.05
    if retries is None:
        assert losses > 2
        return
    assert losses == retries + 1
    assert int(state["phase"]) == SELECT and torch.allclose(td["action"], torch.zeros(1, 8), atol=1e-6)


def test_without_retries_a_stuck_hand_pulls_on_and_a_failed_touch_is_the_last() -> None:
    policy, door = expert_policy(LIMITS, FlowPolicyOptions(retries=0)), ToyDoor(sliding=True)
    state = policy(door.observe(start()))["next", "policy"]
    state["phase"], state["pull"] = torch.full((1, 1), PULL), torch.tensor([[-1.0, 0.0, 0.0]])
    held = door.observe(state)
    held["observation", "attached"] = torch.ones(1, 1, dtype=torch.bool)
    for _ in range(20):
        held["policy"] = policy(held)["next", "policy"]
    assert int(held["policy", "phase"]) == PULL
    pressing = door.observe(state.clone())
    pressing["policy", "phase"] = torch.full((1, 1), APPROACH)
    pressing["policy", "contact_point"] = door.tip()
    pressing["observation", "contact_force"] = torch.full((1, 1), 100.0)
    for _ in range(10):
        pressing["policy"] = policy(pressing)["next", "policy"]
    assert int(pressing["policy", "phase"]) == SELECT


def test_without_a_mask_a_neighbour_s_flow_does_not_turn_the_pull() -> None:
    """Two drawers' flows at once: one goes out, the other one, half a metre away, to the side."""
    door = ToyDoor(sliding=True)
    td = door.observe(start())
    points, flow = td["observation", "points"], td["privileged", "flow"].clone()
    flow[points[..., 1] > 0.2] = torch.tensor([0.0, 0.0, 1.0])
    td["privileged", "flow"] = flow
    td["policy", "phase"] = torch.full((1, 1), PULL)
    td["observation", "tool_pose"][:, :3], td["observation", "attached"] = (
        torch.tensor([0.0, -0.3, 0.7]),
        torch.ones(1, 1).bool(),
    )
    del td["observation", "part_mask"]
    policy = expert_policy(LIMITS, FlowPolicyOptions(lead=0.0, mask="none"))
    pull = policy(td)["next", "policy", "pull"][0]
    assert float(pull @ torch.tensor([-1.0, 0.0, 0.0])) > 0.99


def test_without_a_mask_the_largest_flow_of_the_whole_cloud_counts() -> None:
    policy = expert_policy(LIMITS, FlowPolicyOptions(mask="none"))
    td = ToyDoor().observe(start())
    with_mask = expert_policy(LIMITS)(td.clone())["next", "policy", "contact_point"]
    td["observation", "part_mask"] = torch.zeros_like(td["observation", "part_mask"])
    assert torch.equal(policy(td.clone())["next", "policy", "contact_point"], with_mask)
    assert int(expert_policy(LIMITS)(td)["next", "policy", "phase"]) == SELECT, "the mask hides all of it"
