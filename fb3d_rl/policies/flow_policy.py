"""The flow policy: approach a point against its flow, touch, hold, then pull along the current flow.

It does not know where its flow comes from. Fed the ground truth it is the expert; fed ArtFlowNet's prediction it is
FlowBot3D. It is batched over environments, and its state travels in the TensorDict under "policy".
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor

from fb3d_rl.flow.rigid_motion import rigid_motion
from fb3d_rl.geometry.transforms import (
    alignment,
    normalize,
    rotation_vector_to_matrix,
)
from fb3d_rl.models.artflownet import ArtFlowNet, artflownet_module
from fb3d_rl.perception.contact import ContactOptions, choose_contact
from fb3d_rl.policies.hand import VelocityLimits, hand_axis, joint_velocities

SELECT, TRAVEL, APPROACH, PULL, RETREAT, RELEASE = range(6)
"""Phases. Grasp selection (supplement, I.F and I.G) is 0 to 2, 4 and 5, articulation execution (I.G) is 3."""

TRIES = 6
"""Contact points that are remembered as tried in vain."""


@dataclass(frozen=True)
class FlowPolicyOptions:
    """Speeds, gains and distances of the flow policy.

    Attributes:
        travel_speed: of the tip around the object, m/s.
        approach_speed: of the tip on the way to the pre-contact point, m/s.
        touch_speed: of the tip from there on (guarded), m/s.
        pull_speed: factor that turns the normalised flow into a tip velocity (I.G), m/s.
        angular_gain: factor that turns the rotation q_diff into an angular velocity (I.G), 1/s.
        precontact: distance (m) of the pre-contact point in front of the contact point (I.G).
        overshoot: how far (m) the tip may pass the contact point before the approach has failed.
        force: contact force (N) that ends an approach which does not hold.
        patience: control steps for which that force is borne, since suction may still engage.
        stuck_progress: a pull is stuck if the tip moves less (m) along the flow in a control step ...
        stuck_steps: ... for more control steps than this: the hand tears itself off and tries elsewhere.
        retry_distance: points nearer (m) than this to a point tried in vain are not tried.
        nearby: distance (m) from the held point at which a point's flow counts half in the motion that is fitted there.
        lead: how far ahead (s) of the observation the flow is read along the part's motion: half a control step, so
            that the tip moves on the chord of its arc and does not drift outwards.
        hand_length: from the tip to the hand's far end, m.
        clearance: height (m) below which the hand's far end does not sink: a door that swings down would pin it
            between itself and the ground z = 0.
        margin: distance (m) that the tip keeps from the object's bounding sphere while it travels.
    """

    travel_speed: float = 1.8
    approach_speed: float = 1.6
    touch_speed: float = 0.3
    pull_speed: float = 0.8
    angular_gain: float = 8.0
    precontact: float = 0.1
    overshoot: float = 0.08
    force: float = 20.0
    patience: int = 4
    stuck_progress: float = 0.004
    stuck_steps: int = 6
    retry_distance: float = 0.08
    nearby: float = 0.1
    lead: float = 0.025
    hand_length: float = 0.2
    clearance: float = 0.08
    margin: float = 0.1
    contact: ContactOptions = field(default_factory=ContactOptions)


class FlowPolicy(TensorDictModuleBase):
    """Turns a flow into gripper velocities.

    Args:
        flow_key: where the flow is read: ``("privileged", "flow")`` makes the expert, ``("prediction", "flow")``
            FlowBot3D.
        limits: the gripper's velocity limits.
        options: speeds, gains and distances.

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
    }

    def __init__(
        self, flow_key: tuple[str, str], limits: VelocityLimits, options: FlowPolicyOptions | None = None
    ) -> None:
        super().__init__()
        self.flow_key = flow_key
        self.limits = limits
        self.options = options or FlowPolicyOptions()
        observed = ("points", "valid", "part_mask", "qpos", "tool_pose", "attached", "contact_force", "camera_position")
        self.in_keys = [("observation", key) for key in observed] + [flow_key]
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
        o, obs = self.options, tensordict["observation"]
        state = tensordict["policy"].clone()
        tip, hand = obs["tool_pose"][..., :3], hand_axis(obs["tool_pose"])
        flow = torch.where((obs["part_mask"] & obs["valid"])[..., None], tensordict[self.flow_key], 0.0)

        self._advance(state, obs, flow, tip, hand)
        phase = state["phase"]
        velocity = self._path_velocity(state, obs, tip)
        pulling = bool((phase == PULL).any())
        pull = self._flow_at(obs, flow, tip, state["pull"]) if pulling else state["pull"]
        # The hand keeps its angle to the flow: what turns the last flow into the flow now turns the hand.
        turned = rotation_vector_to_matrix(alignment(state["pull"], pull)) @ state["standoff"][..., None]
        goes_on = (phase == PULL) & (tensordict["policy", "phase"] == PULL)
        state["standoff"] = torch.where(goes_on, turned.squeeze(-1), state["standoff"])
        state["pull"] = torch.where(phase == PULL, pull, state["pull"])
        velocity = torch.where(phase == PULL, o.pull_speed * pull, velocity)
        wanted = self._above_ground(state["standoff"], tip)
        angular = o.angular_gain * alignment(hand, wanted)
        tensordict["action"] = joint_velocities(obs, hand, velocity, angular, self.limits)
        tensordict["next", "policy"] = state
        return tensordict

    def _advance(self, state: TensorDictBase, obs: TensorDictBase, flow: Tensor, tip: Tensor, hand: Tensor) -> None:
        """Move every environment to the phase that its observation calls for."""
        o = self.options
        phase = state["phase"].squeeze(-1)
        attached = obs["attached"].squeeze(-1)

        touches = obs["contact_force"].squeeze(-1) > o.force
        pressed = (phase == APPROACH) & touches
        moved = tip - state["tip"]
        halted = ((phase == TRAVEL) | (phase == RETREAT)) & touches & (moved.norm(dim=-1) < o.stuck_progress)
        state["came"] = torch.where((phase == TRAVEL)[:, None], 0.8 * state["came"] - moved, 0.0)
        progress = (moved * state["pull"]).sum(-1)
        state["tip"] = tip.clone()
        idle = (phase == PULL) & attached & (progress < o.stuck_progress)
        count = torch.where(pressed | halted | idle | (phase == RELEASE), state["idle"].squeeze(-1) + 1, 0)
        offset = tip - state["contact_point"]
        height = (offset * state["standoff"]).sum(-1)
        failed = (phase == APPROACH) & ((count > o.patience) | (height < -o.overshoot)) & ~attached
        blocked = (phase == TRAVEL) & (
            count > o.stuck_steps
        )  # something stands in the way that the cloud does not show
        stuck = (phase == PULL) & (count > o.stuck_steps)
        in_vain = failed | blocked | stuck
        slot = (state["tries"] % TRIES)[..., None].expand(-1, 1, 3)
        remembered = state["tried"].scatter(1, slot, torch.where(stuck[:, None], tip, state["contact_point"])[:, None])
        state["tried"] = torch.where(in_vain[:, None, None], remembered, state["tried"])
        state["tries"] = state["tries"] + in_vain[:, None].long()

        lost = ((phase == PULL) | (phase == RELEASE)) & ~attached
        given_up = failed | blocked | lost
        state["leave"] = torch.where((failed | (lost & (phase == PULL)))[:, None], state["standoff"], state["leave"])
        state["leave"] = torch.where(stuck[:, None], _across(hand, state["pull"]), state["leave"])
        state["leave"] = torch.where(blocked[:, None], normalize(state["came"]), state["leave"])
        # It backs off from where it is, not from a contact point that is far away.
        astray = (lost | blocked)[:, None]
        state["contact_point"] = torch.where(astray, tip, state["contact_point"])
        state["standoff"] = torch.where(astray, hand, state["standoff"])
        vain = (phase == RELEASE) & (count > 3 * o.stuck_steps)  # it does not come off: pull on

        far_off = (offset * state["leave"]).sum(-1) > o.precontact
        backed_off = (phase == RETREAT) & (far_off | (count > o.stuck_steps))
        aligned = alignment(hand, state["standoff"]).norm(dim=-1) < 0.15
        on_line = (offset - height[:, None] * state["standoff"]).norm(dim=-1) < 0.04
        ready = (phase == TRAVEL) & aligned & on_line & (height > 0)
        phase = torch.where(ready, APPROACH, phase)
        phase = torch.where(given_up, RETREAT, phase)
        phase = torch.where(backed_off, SELECT, phase)
        phase = torch.where(stuck, RELEASE, phase)
        caught = attached & (phase != PULL) & (phase != RELEASE)
        # Held by chance, from another side than chosen.
        state["standoff"] = torch.where((caught & (phase != APPROACH))[:, None], hand, state["standoff"])
        phase = torch.where(caught | vain, PULL, phase)
        state["idle"] = torch.where(stuck | vain, 0, count)[:, None]
        choosing = phase == SELECT
        if bool(choosing.any()):
            chosen = choose_contact(
                obs["points"],
                obs["valid"],
                obs["part_mask"],
                flow,
                obs["camera_position"],
                self._avoid(state, obs),
                o.contact,
            )
            for key, value in zip(("contact_point", "pull", "standoff"), chosen, strict=True):
                state[key] = torch.where(choosing[:, None], value, state[key])
            seen = chosen[1].norm(dim=-1) > 0
            phase = torch.where(choosing & seen, TRAVEL, phase)
        state["phase"] = phase[:, None]

    def _avoid(self, state: TensorDictBase, obs: TensorDictBase) -> Tensor:
        """Points [E, N] near contact points that were tried in vain."""
        distance = (obs["points"][:, :, None] - state["tried"][:, None]).norm(dim=-1)
        used = torch.arange(TRIES, device=distance.device) < state["tries"]
        return ((distance < self.options.retry_distance) & used[:, None]).any(-1)

    def _path_velocity(self, state: TensorDictBase, obs: TensorDictBase, tip: Tensor) -> Tensor:
        """Tip velocity [E, 3] (m/s) of the phases TRAVEL, APPROACH and RETREAT; 0 in the others."""
        o, phase = self.options, state["phase"]
        contact, standoff = state["contact_point"], state["standoff"]
        offset = tip - contact
        height = (offset * standoff).sum(-1, keepdim=True)
        sideways = offset - height * standoff

        slowing = (10.0 * (height - o.precontact)).clamp(max=o.approach_speed).clamp_min(o.touch_speed)
        approach_speed = torch.where(height > o.precontact, slowing, o.touch_speed)
        approach = -approach_speed * standoff - 8.0 * sideways
        retreat = o.approach_speed * state["leave"]
        travel = self._travel(state, obs, tip) if bool((phase == TRAVEL).any()) else torch.zeros_like(tip)
        velocity = torch.where(phase == TRAVEL, travel, torch.zeros_like(tip))
        velocity = torch.where(phase == APPROACH, approach, velocity)
        velocity = torch.where(phase == RETREAT, retreat, velocity)
        return torch.where(phase == RELEASE, self.limits.linear * state["leave"], velocity)

    def _travel(self, state: TensorDictBase, obs: TensorDictBase, tip: Tensor) -> Tensor:
        """Velocity [E, 3] around the object's bounding sphere to where the approach line leaves it.

        A hand that comes from another side of the object leaves the sphere first as it backed off before.
        """
        o, contact, standoff, leave = self.options, state["contact_point"], state["standoff"], state["leave"]
        valid = obs["valid"][..., None]
        low = torch.where(valid, obs["points"], torch.inf).amin(1)
        high = torch.where(valid, obs["points"], -torch.inf).amax(1)
        centre = torch.nan_to_num(0.5 * (low + high), posinf=0.0, neginf=0.0)
        radius = torch.where(valid, obs["points"] - centre[:, None], 0.0).norm(dim=-1).amax(-1, keepdim=True) + o.margin

        # |contact + t standoff - centre| = radius, the larger root
        from_centre = contact - centre
        b = (from_centre * standoff).sum(-1, keepdim=True)
        c = from_centre.square().sum(-1, keepdim=True) - radius.square()
        t = -b + (b * b - c).clamp_min(0).sqrt()
        descent = -standoff[..., 2:]
        above_ground = (contact[..., 2:] - o.clearance) / descent.clamp_min(1e-6)
        t = torch.where(descent > 0, torch.minimum(t, above_ground), t).clamp_min(2 * o.precontact)
        goal = contact + t * standoff

        outward, distance = normalize(tip - centre), (tip - centre).norm(dim=-1, keepdim=True)
        turn = alignment(outward, normalize(goal - centre))
        tangent = torch.linalg.cross(normalize(turn), outward)
        around = tangent + (radius - distance).clamp(-1, 1) * 4.0 * outward
        straight = goal - tip
        gap = straight.norm(dim=-1, keepdim=True)
        far = (turn.norm(dim=-1, keepdim=True) > 0.35) & (distance > 0.5 * radius)
        step = torch.where(far, normalize(around), normalize(straight))
        speed = torch.where(far, torch.full_like(gap, o.travel_speed), (6.0 * gap).clamp(max=o.travel_speed))
        other_side = (leave * standoff).sum(-1, keepdim=True) < 0.5
        state["leave"] = torch.where((state["phase"] == TRAVEL) & ((distance > radius) | ~other_side), 0.0, leave)
        return torch.where(state["leave"].any(-1, keepdim=True), o.travel_speed * leave, speed * step)

    def _flow_at(self, obs: TensorDictBase, flow: Tensor, tip: Tensor, last: Tensor) -> Tensor:
        """Unit flow [E, 3] at the held point, ``lead`` ahead; the last one where none is seen.

        The flow of a rigid part is v + omega x r. Both are fitted to the visible points (weighted least squares), the
        near ones foremost: the hand often hides those around the held point.
        """
        o = self.options
        squared = (obs["points"] - tip[:, None]).square().sum(-1)
        weight = (obs["part_mask"] & obs["valid"]) / (1.0 + squared / o.nearby**2)
        at_tip, omega = rigid_motion(obs["points"], flow, weight, tip, 1e-2 * o.nearby**2)
        speed = at_tip.norm(dim=-1, keepdim=True)
        rate = o.lead * o.pull_speed * omega / speed.clamp_min(1e-6)
        ahead = normalize(at_tip) + torch.linalg.cross(rate, normalize(at_tip))
        return torch.where(speed > 1e-6, normalize(ahead), last)

    def _above_ground(self, axis: Tensor, tip: Tensor) -> Tensor:
        """Lift unit hand axes [E, 3] that would take the hand's far end below ``clearance``."""
        lowest = ((self.options.clearance - tip[..., 2:]) / self.options.hand_length).clamp(-1.0, 0.9)
        height = torch.maximum(axis[..., 2:], lowest)
        flat = normalize(axis[..., :2])
        lifted = torch.cat([flat * (1 - height.square()).sqrt(), height], dim=-1)
        return torch.where(height > axis[..., 2:], lifted, axis)


def _across(hand: Tensor, pull: Tensor) -> Tensor:
    """Unit directions [E, 3] across ``pull`` in which the hand backs off; level ones where it comes along ``pull``.

    Across the flow the part cannot follow, so that the suction breaks; along it the part would only be moved on.
    """
    up = torch.zeros_like(pull)
    up[..., 2] = 1.0
    level = torch.linalg.cross(pull, up)
    away = hand - (hand * pull).sum(-1, keepdim=True) * pull
    return normalize(torch.where(away.norm(dim=-1, keepdim=True) > 0.3, away, level))


def expert_policy(limits: VelocityLimits, options: FlowPolicyOptions | None = None) -> FlowPolicy:
    """The flow policy fed with the ground-truth flow: the upper bound, and the oracle of DAgger."""
    return FlowPolicy(("privileged", "flow"), limits, options)


def artflownet_policy(
    net: ArtFlowNet, limits: VelocityLimits, options: FlowPolicyOptions | None = None
) -> TensorDictModule:
    """FlowBot3D: ArtFlowNet's prediction from the cloud, then the flow policy."""
    return TensorDictSequential(artflownet_module(net), FlowPolicy(("prediction", "flow"), limits, options))
