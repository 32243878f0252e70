"""The flow policy: approach a point against its flow, touch, hold, then pull along the current flow.

It does not know where its flow comes from. Fed the ground truth it is the expert; fed ArtFlowNet's prediction it is
FlowBot3D. Its state travels in the TensorDict under "policy". Each environment is steered by itself, in numbers of its
own; what looks at all points of a cloud is batched over the environments that need it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn

from fb3d_rl.assets.gripper import HAND_LENGTH
from fb3d_rl.geometry.points import squared_distances
from fb3d_rl.geometry.rigid_motion import local_weight, rigid_motion
from fb3d_rl.geometry.vectors import Vector, alignment, cross, length, normalize, rotate
from fb3d_rl.models.artflownet import artflownet_module, reads_mask
from fb3d_rl.policies.contact import CANDIDATE, CANDIDATES, LAYOUT, best_candidate, choose_contact
from fb3d_rl.policies.hand import VelocityLimits, hand_axis, joint_velocities
from fb3d_rl.policies.options import FlowPolicyOptions

SELECT, TRAVEL, APPROACH, PULL, RETREAT, RELEASE = range(6)
"""Phases. Grasp selection (supplement, I.F and I.G) is 0 to 2, 4 and 5, articulation execution (I.G) is 3."""

PHASES = ("select", "travel", "approach", "pull", "retreat", "release")
"""Their names."""

MASK = ("observation", "part_mask")
"""Where the mask of the part to open is read."""

TRIES = 6
"""Contact points that are remembered as tried in vain."""


@dataclass
class Memory:
    """What the policy remembers of one environment from step to step.

    Attributes:
        phase: one of the phases.
        contact_point: where to touch, m.
        standoff: unit direction in which the hand stands off the contact point.
        pull: unit flow there.
        idle: control steps in which nothing moved on.
        leave: unit direction in which the hand backs off, or leaves the object's bounding sphere.
        tip: the suction tip in the last step, m.
        came: where the tip came from, m, faded.
        tried: the last ``TRIES`` points that were tried in vain, m.
        tries: how many that were.
        chosen: how many contact points it has set out for.
        candidates: points that would have done as well as the chosen one when it was chosen
            (:func:`~fb3d_rl.policies.contact.choose_contact`).
    """

    phase: int
    contact_point: Vector
    standoff: Vector
    pull: Vector
    idle: int
    leave: Vector
    tip: Vector
    came: Vector
    tried: np.ndarray
    tries: int
    chosen: int
    candidates: np.ndarray

    def give_up(self, point: Vector) -> None:
        """Remember a point that was tried in vain."""
        self.tried[self.tries % TRIES] = point
        self.tries += 1


class FlowPolicy(TensorDictModuleBase):
    """Turns a flow into gripper velocities.

    Args:
        flow_key: where the flow is read: ``("privileged", "flow")`` makes the expert, ``("prediction", "flow")``
            FlowBot3D.
        limits: what an action means.
        options: speeds, gains, distances and times.

    Shapes: reads the contract's "observation" group and the flow [E, N, 3]; writes ``action`` [E, 8] and the next
    step's state under ``("next", "policy")``, whose layout :meth:`initial_state` gives.
    """

    STATE: dict[str, tuple[tuple[int, ...], torch.dtype]] = {
        "phase": ((1,), torch.int64),
        "contact_point": ((3,), torch.float32),
        "standoff": ((3,), torch.float32),
        "pull": ((3,), torch.float32),
        "idle": ((1,), torch.int64),
        "leave": ((3,), torch.float32),
        "tip": ((3,), torch.float32),
        "came": ((3,), torch.float32),
        "tried": ((TRIES, 3), torch.float32),
        "tries": ((1,), torch.int64),
        "chosen": ((1,), torch.int64),
        "candidates": ((CANDIDATES, CANDIDATE), torch.float32),
    }

    def __init__(
        self, flow_key: tuple[str, str], limits: VelocityLimits, options: FlowPolicyOptions | None = None
    ) -> None:
        super().__init__()
        self.flow_key = flow_key
        self.limits = limits
        self.options = options or FlowPolicyOptions()
        o, self._period = self.options, limits.period
        self._patience, self._stuck, self._release = (
            round(time / self._period) for time in (o.patience, o.stuck_time, o.release_time)
        )
        self._still = o.stuck_speed * self._period
        self._fade = o.fade ** (self._period / 0.05)
        observed = ("points", "valid", "qpos", "tool_pose", "attached", "contact_force", "camera_position")
        self.in_keys = [("observation", key) for key in (*observed, "goal_sense")] + [flow_key]
        self.in_keys += [MASK] if o.mask == "target" else []
        self.in_keys += [("policy", key) for key in self.STATE]
        self.out_keys = ["action"] + [("next", "policy", key) for key in self.STATE]

    @classmethod
    def initial_state(cls, batch: torch.Size | tuple[int, ...]) -> TensorDict:
        """The state at the start of an episode: all zeros, phase SELECT."""
        zeros = {key: torch.zeros(*batch, *shape, dtype=dtype) for key, (shape, dtype) in cls.STATE.items()}
        return TensorDict(zeros, batch_size=batch)

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action and the next policy state."""
        obs, flow = tensordict["observation"], tensordict[self.flow_key]
        tool_pose = obs["tool_pose"]
        axis = hand_axis(tool_pose)
        tips, hands = _numbers(tool_pose[:, :3]), _numbers(axis)
        attached, force = obs["attached"].flatten().tolist(), obs["contact_force"].flatten().tolist()
        senses = obs["goal_sense"].flatten().tolist()
        memories = _recall(tensordict["policy"])
        pulled = [memory.phase == PULL for memory in memories]

        for i, memory in enumerate(memories):
            self._advance(memory, tips[i], hands[i], attached[i], force[i] > self.options.force, senses[i])
        self._choose(memories, obs, axis, flow)
        pulls = self._flow_at(memories, obs, flow, senses)
        clouds = self._clouds(memories, obs)

        twists = np.empty((len(memories), 6))
        for i, (memory, tip, hand) in enumerate(zip(memories, tips, hands, strict=True)):
            if memory.phase == PULL:
                if pulled[i]:
                    # The hand keeps its angle to the flow: what turns the last flow into the flow now turns the hand.
                    memory.standoff = rotate(memory.standoff, alignment(memory.pull, pulls[i]))
                memory.pull = pulls[i]
                velocity = senses[i] * self.options.pull_speed * memory.pull
            elif memory.phase == TRAVEL:
                velocity = self._travel(memory, tip, clouds[i])
            else:
                velocity = self._path_velocity(memory, tip)
            wanted = self._above_ground(memory.standoff, tip)
            twists[i, :3], twists[i, 3:] = velocity, self._gain(self.options.angular_gain) * alignment(hand, wanted)
        twist = torch.from_numpy(twists).to(axis)
        tensordict["action"] = joint_velocities(obs, axis, twist[:, :3], twist[:, 3:], self.limits)
        tensordict["next", "policy"] = self._state(memories, tensordict.device)
        return tensordict

    def _advance(self, memory: Memory, tip: Vector, hand: Vector, attached: bool, touches: bool, sense: float) -> None:
        """Move on to the phase that the observation calls for."""
        o, m = self.options, memory
        moved, came = tip - m.tip, m.came
        m.tip, m.came = tip, np.zeros(3)
        offset = tip - m.contact_point
        height = float(offset @ m.standoff)
        halted = touches and length(moved) < self._still

        if m.phase == SELECT:
            m.idle = 0
        elif m.phase == TRAVEL:
            m.idle = m.idle + 1 if halted else 0
            m.came = self._fade * came - moved
            if m.idle > self._stuck:  # something stands in the way that the cloud does not show
                m.give_up(m.contact_point)
                m.leave = normalize(m.came)
                m.phase, m.contact_point, m.standoff = RETREAT, tip, hand
            elif (
                length(alignment(hand, m.standoff)) < 0.15
                and length(offset - height * m.standoff) < o.line
                and height > 0
            ):
                m.phase = APPROACH
        elif m.phase == APPROACH:
            m.idle = m.idle + 1 if touches else 0
            if not attached and (m.idle > self._patience or height < -o.overshoot):
                m.give_up(m.contact_point)
                m.phase, m.leave = RETREAT, m.standoff
        elif m.phase == PULL:
            m.idle = m.idle + 1 if attached and sense * (moved @ m.pull) < self._still else 0
            if not attached:
                # It backs off from where it is, not from a contact point that is far away.
                m.phase, m.leave, m.contact_point, m.standoff = RETREAT, m.standoff, tip, hand
            elif m.idle > self._stuck and self._tries_on(m):
                m.give_up(tip)
                m.phase, m.leave, m.idle = RELEASE, _across(hand, m.pull), 0
        elif m.phase == RETREAT:
            m.idle = m.idle + 1 if halted else 0
            if offset @ m.leave > o.precontact or m.idle > self._stuck:
                m.phase = SELECT
        elif m.phase == RELEASE:
            m.idle += 1
            if not attached:
                m.phase, m.contact_point, m.standoff = RETREAT, tip, hand
            if m.idle > self._release:  # it does not come off: pull on
                m.phase, m.idle = PULL, 0

        if m.phase == RETREAT and not self._tries_on(m):
            m.phase, m.standoff = SELECT, hand  # and there it stays
        if attached and m.phase not in (PULL, RELEASE):
            if m.phase != APPROACH:  # held by chance, from another side than chosen
                m.standoff = hand
            m.phase = PULL

    def _tries_on(self, memory: Memory) -> bool:
        """Whether it may choose a contact point (again)."""
        return self.options.retries is None or memory.chosen <= self.options.retries

    def choose_again(self, state: TensorDictBase, obs: TensorDictBase, where: Tensor) -> None:
        """Send the hand, on its way to a part that nothing has moved, to what is the best candidate from where it is.

        The candidates are those of the first look, when the hand hid none of them: which points are seen over its
        shoulder changes from step to step.

        Args:
            state: as of :meth:`initial_state`; written in place.
            obs: the contract's "observation" group.
            where: [E, 1] bool, the environments to do so in.
        """
        pose = obs["tool_pose"]
        best = best_candidate(state["candidates"], pose[..., :3], hand_axis(pose), self.options.contact)
        for key, value in zip(("contact_point", "pull", "standoff"), best.split(LAYOUT, dim=-1), strict=False):
            state[key] = torch.where(where, value, state[key])
        state["phase"] = torch.where(where, TRAVEL, state["phase"])
        state["leave"] = torch.where(where, 0.0, state["leave"])

    @staticmethod
    def send(state: TensorDictBase, obs: TensorDictBase, chosen: tuple[Tensor, Tensor, Tensor, Tensor]) -> None:
        """Send the hand, which holds nothing, to a contact point that somebody else has chosen.

        Args:
            state: as of :meth:`initial_state`; written in place.
            obs: the contract's "observation" group.
            chosen: as :func:`~fb3d_rl.policies.contact.choose_contact` returns it.
        """
        contact, pull, standoff, candidates = chosen
        state.update({"contact_point": contact, "pull": pull, "standoff": standoff, "candidates": candidates})
        state["phase"] = torch.full_like(state["phase"], TRAVEL)
        state["chosen"] = torch.ones_like(state["chosen"])
        state["idle"] = torch.zeros_like(state["idle"])
        state["leave"] = torch.zeros_like(state["leave"])
        state["tip"] = obs["tool_pose"][..., :3].clone()  # nothing was remembered of where it came from
        state["came"] = torch.zeros_like(state["came"])

    def _choose(self, memories: list[Memory], obs: TensorDictBase, axis: Tensor, flow: Tensor) -> None:
        """Choose a contact point in the environments that are about to, and send them there."""
        rows = [i for i in _in_phase(memories, SELECT) if self._tries_on(memories[i])]
        if not rows:
            return
        tip = obs["tool_pose"][..., :3]
        points, valid, camera, hand, axis, flow = (
            _rows(x, rows) for x in (obs["points"], obs["valid"], obs["camera_position"], tip, axis, flow)
        )
        part = self._part(obs, rows)
        flow = torch.where((valid if part is None else part & valid)[..., None], flow, 0.0)
        avoid = torch.zeros_like(valid)
        for k, i in enumerate(rows):
            for tried in torch.from_numpy(memories[i].tried[: memories[i].tries]).to(points):
                avoid[k] |= (points[k] - tried).norm(dim=-1) < self.options.retry_distance
        chosen = choose_contact(points, valid, part, flow, camera, hand, axis, avoid, self.options.contact)
        for i, *found in zip(rows, *map(_numbers, chosen), strict=True):
            memory = memories[i]
            memory.contact_point, memory.pull, memory.standoff, memory.candidates = found
            if memory.pull.any():
                memory.phase, memory.chosen = TRAVEL, memory.chosen + 1

    def _part(self, obs: TensorDictBase, rows: list[int]) -> Tensor | None:
        """The mask of the part to open [K, N], if the policy is shown it."""
        return None if self.options.mask == "none" else _rows(obs["part_mask"], rows)

    def _path_velocity(self, memory: Memory, tip: Vector) -> Vector:
        """Tip velocity (m/s) of the phases APPROACH, RETREAT and RELEASE; 0 while no contact point can be chosen."""
        o = self.options
        if memory.phase == APPROACH:
            offset = tip - memory.contact_point
            height = float(offset @ memory.standoff)
            sideways = offset - height * memory.standoff
            speed = min(max(self._gain(10.0) * (height - o.precontact), o.touch_speed), o.approach_speed)
            return -speed * memory.standoff - self._gain(8.0) * sideways
        if memory.phase == RETREAT:
            return o.approach_speed * memory.leave
        if memory.phase == RELEASE:
            return self.limits.linear * memory.leave
        return np.zeros(3)

    def _clouds(self, memories: list[Memory], obs: TensorDictBase) -> dict[int, np.ndarray]:
        """The visible points [M, 3] of each environment on its way, m."""
        rows = _in_phase(memories, TRAVEL)
        return {i: _numbers(obs["points"][i][obs["valid"][i]]) for i in rows}

    def _gain(self, wanted: float) -> float:
        """The gain (1/s) with which an offset is made up for: at most all of it in one control step."""
        return min(wanted, 1.0 / self._period)

    def _travel(self, memory: Memory, tip: Vector, cloud: np.ndarray) -> Vector:
        """Velocity to the approach line: straight into a funnel that narrows to the pre-contact point, if that is free.

        Otherwise around the object's bounding sphere to where the approach line leaves it. A hand that comes from
        another side of the object leaves the sphere first as it backed off before.
        """
        o, contact, standoff = self.options, memory.contact_point, memory.standoff
        highest = math.inf  # of a goal on the approach line that stays above the ground
        if standoff[2] < 0:
            highest = max((contact[2] - o.clearance) / -standoff[2], 2 * o.precontact)
        if not memory.leave.any():
            offset = tip - contact
            sideways = length(offset - (offset @ standoff) * standoff)
            goal = contact + min(o.precontact + o.funnel * sideways, highest) * standoff
            if not self._in_the_way(cloud, tip, goal):
                return self._straight(tip, goal)

        centre, radius = np.zeros(3), o.margin
        if len(cloud):
            centre = 0.5 * (cloud.min(0) + cloud.max(0))
            radius += float(np.linalg.norm(cloud - centre, axis=-1).max())
        # |contact + t standoff - centre| = radius, the larger root
        from_centre = contact - centre
        b = float(from_centre @ standoff)
        c = float(from_centre @ from_centre) - radius**2
        t = -b + math.sqrt(max(b * b - c, 0.0))
        goal = contact + min(max(t, 2 * o.precontact), highest) * standoff

        distance = length(tip - centre)
        if distance > radius or memory.leave @ standoff >= 0.5:
            memory.leave = np.zeros(3)
        if memory.leave.any():
            return o.travel_speed * memory.leave
        outward = normalize(tip - centre)
        turn = alignment(outward, goal - centre)
        if length(turn) > 0.35 and distance > 0.5 * radius:
            tangent = cross(normalize(turn), outward)
            around = tangent + min(max(radius - distance, -1.0), 1.0) * 4.0 * outward
            return o.travel_speed * normalize(around)
        return self._straight(tip, goal)

    def _straight(self, tip: Vector, goal: Vector) -> Vector:
        """Velocity to a goal, slower the last bit of the way."""
        way = goal - tip
        return min(self._gain(6.0) * length(way), self.options.travel_speed) * normalize(way)

    def _in_the_way(self, cloud: np.ndarray, tip: Vector, goal: Vector) -> bool:
        """Whether the straight way brings the tip near to points of the cloud that it is not as near to already."""
        way, offset = goal - tip, cloud - tip
        share = np.clip(offset @ way / max(float(way @ way), 1e-12), 0.0, 1.0)
        nearest = np.linalg.norm(offset - share[:, None] * way, axis=-1)
        near = (nearest < self.options.free) & (nearest < np.linalg.norm(offset, axis=-1) - 0.01)
        return int(near.sum()) > 1

    def _flow_at(
        self, memories: list[Memory], obs: TensorDictBase, flow: Tensor, senses: list[float]
    ) -> dict[int, Vector]:
        """Unit flow at the held point of each environment that pulls, ``lead`` ahead; the last one where none is seen.

        The flow of a rigid part is v + omega x r. Both are fitted to the visible points (weighted least squares), the
        near ones foremost: the hand often hides those around the held point. Without a mask what has a flow may belong
        to several parts, so that only what is near counts.
        """
        rows = _in_phase(memories, PULL)
        if not rows:
            return {}
        o = self.options
        points, valid, tool_pose, flow = (_rows(x, rows) for x in (obs["points"], obs["valid"], obs["tool_pose"], flow))
        part = self._part(obs, rows)
        tip = tool_pose[:, :3]
        squared = squared_distances(points, tip[:, None]).squeeze(-1)
        if part is None:
            weight = local_weight(flow, squared).masked_fill(~valid, 0.0)
        else:
            weight = (part & valid) / (1.0 + squared / o.nearby**2)
        motion = rigid_motion(points, flow, weight, tip, 1e-2 * o.nearby**2)
        found = {}
        for i, at_tip, omega in zip(rows, *map(_numbers, motion), strict=True):
            speed = length(at_tip)
            unit = normalize(at_tip)
            rate = senses[i] * o.lead * self._period * o.pull_speed / max(speed, 1e-6) * omega
            found[i] = normalize(unit + cross(rate, unit)) if speed > 1e-6 else memories[i].pull
        return found

    def _above_ground(self, axis: Vector, tip: Vector) -> Vector:
        """Lift a unit hand axis that would take the hand's far end below ``clearance``."""
        lowest = min(max((self.options.clearance - tip[2]) / HAND_LENGTH, -1.0), 0.9)
        if axis[2] >= lowest:
            return axis
        return np.append(normalize(axis[:2]) * math.sqrt(1.0 - lowest**2), lowest)

    def _state(self, memories: list[Memory], device: torch.device | None) -> TensorDict:
        """The TensorDict of :meth:`initial_state` that holds the memories."""
        batch = (len(memories),)
        state = {}
        for key, (shape, dtype) in self.STATE.items():
            values = np.array([getattr(memory, key) for memory in memories])
            state[key] = torch.from_numpy(values).to(device, dtype).view(*batch, *shape)
        # As in TorchRL's own libraries, without the checks of each entry at each step.
        return TensorDict._new_unsafe(source=state, batch_size=torch.Size(batch), device=device)


def _numbers(values: Tensor) -> np.ndarray:
    """A tensor as a float64 array of its own."""
    return values.cpu().numpy().astype(np.float64)


def _rows(values: Tensor, rows: list[int]) -> Tensor:
    """Those rows [K, ...] of [E, ...]."""
    return values if len(rows) == len(values) else values[rows]


def _recall(state: TensorDictBase) -> list[Memory]:
    """The memories [E] that a state holds."""
    columns = {
        key: state[key].flatten().tolist() if shape == (1,) else _numbers(state[key])
        for key, (shape, _) in FlowPolicy.STATE.items()
    }
    return [Memory(**dict(zip(columns, row, strict=True))) for row in zip(*columns.values(), strict=True)]


def _in_phase(memories: list[Memory], phase: int) -> list[int]:
    """Which environments are in ``phase``."""
    return [i for i, memory in enumerate(memories) if memory.phase == phase]


def _across(hand: Vector, pull: Vector) -> Vector:
    """Unit direction across ``pull`` in which the hand backs off; a level one where it comes along ``pull``.

    Across the flow the part cannot follow, so that the suction breaks; along it the part would only be moved on.
    """
    away = hand - (hand @ pull) * pull
    return normalize(away if length(away) > 0.3 else cross(pull, np.array([0.0, 0.0, 1.0])))


def expert_policy(limits: VelocityLimits, options: FlowPolicyOptions | None = None) -> FlowPolicy:
    """The flow policy fed with the ground-truth flow: the upper bound, and the oracle of DAgger."""
    return FlowPolicy(("privileged", "flow"), limits, options)


def artflownet_policy(
    net: nn.Module, limits: VelocityLimits, options: FlowPolicyOptions | None = None
) -> TensorDictModule:
    """FlowBot3D: ArtFlowNet's prediction from the cloud, then the flow policy; so with any network of the same form.

    Raises:
        UserError: the network reads the mask that the options keep from the policy.
    """
    if options is not None and reads_mask(net):
        options.require_mask("a network that was trained with the mask")
    return TensorDictSequential(artflownet_module(net), FlowPolicy(("prediction", "flow"), limits, options))
