"""What the pull teaches: the joint's screw and the sense that opens, fused with what the network sees.

A part that a joint holds moves by one screw, a twist (v, omega) that stays the same in the world while it opens. The
network's flow is a guess of it; the way of the tip while it pulls measures it. Both are Gaussians over the six numbers
of the twist, so that the estimate and its uncertainty follow from a sum of information matrices (a linear
least-squares problem), as in the equilibrium-point control of Jain and Kemp (2009, 2010), who fit a circle to the tip.

Which sense opens can rarely be measured at once; evidence is gathered for each direction: a pull that moved the part
speaks for its direction, one that met a limit against it. The candidates are the network's flows in either sense. The
best has the largest sum of three log-probabilities: the network's, how well it fits the measured screw, the evidence.

A new pull is slow, so that the spring of the suction cannot tear at a limit, until the part has moved a few
centimetres. Where the tip falls behind its command the pull is slow again; where it stands still, that is a limit, and
the pull goes on in the best sense that is left, without letting go.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import fields

import torch
from tensordict import TensorClass, TensorDict, TensorDictBase
from torch import Tensor

from fb3d_rl.geometry.points import squared_distances
from fb3d_rl.geometry.rigid_motion import local_weight, rigid_motion
from fb3d_rl.geometry.transforms import dot, length, normalize, skew
from fb3d_rl.models.artflownet import Hypotheses
from fb3d_rl.policies.flow_policy import FlowPolicy
from fb3d_rl.policies.flow_state import PULL
from fb3d_rl.policies.hand import VelocityLimits, hand_axis
from fb3d_rl.policies.options import FlowPolicyOptions
from fb3d_rl.policies.policy import Policy

FLOW, PROPOSALS, VELOCITY = ("prediction", "flow"), ("prediction", "flows"), ("prediction", "pull_velocity")
LOG_PROBABILITIES = ("prediction", "log_probabilities")

TURNED = 0.5
"""Cosine of the angle to the last pull below which a pull is another one."""

FOLLOWS = 0.5
"""A part has not followed that has moved by less than this share of the spring's stretch."""

MOVES = 0.05
"""Without a mask, size of the predicted flow above which a point moves."""

TEARS_EARLY = 0.1
"""A hold that is lost within this way of the tip (m) did not move the part."""

MOST_GAINED = 4.0
"""Log-odds for a direction that one pull gains at most."""

NEAR = 0.3
"""Without a mask of the part, points (m) that count as the held part's; beyond, another part was held before."""


class TouchState(TensorClass):
    """What the pulls of an episode have taught, in E environments.

    Twists are (v, omega): v [m/m] of the body's point at ``origin`` and omega [rad/m], per metre of the way of that
    point.

    Attributes:
        origin: [E, 3] where the first pull began, m.
        information: [E, 6, 6] precision of the measured twist; 0 before the first measurement.
        moment: [E, 6] precision times the measured twist, whose sense is that of the first pull.
        evidence: [E, 6] what the pulls say of a direction: the log-odds of a twist is the product with it.
        asked: [E, 3] velocity of the tip that the pull of the last step asked for, m/s; 0 if there was none.
        commanded: [E, 3] velocity of the hand's slides that the last action commanded, m/s.
        tip: [E, 3] the suction tip in the last step, m.
        stretch: [E, 3] how far the tip is ahead of the held point, m.
        measured: [E, 3] where the held point was when the way was measured last, m.
        moved: [E, 1] how far the held point has moved since the hold or the last change of sense, m.
        limits: [E, 1] 1 after a limit that did not turn the pull, until the part follows again, else 0.
        tested: [E, 1] how far it has moved since the hold, or the last limit or resistance, m.
    """

    origin: Tensor
    information: Tensor
    moment: Tensor
    evidence: Tensor
    asked: Tensor
    commanded: Tensor
    tip: Tensor
    stretch: Tensor
    measured: Tensor
    moved: Tensor
    limits: Tensor
    tested: Tensor

    @classmethod
    def initial(cls, batch: Sequence[int]) -> TouchState:
        """Nothing is known: all zeros."""
        sizes = {"information": (6, 6), "moment": (6,), "evidence": (6,), "moved": (1,), "limits": (1,), "tested": (1,)}
        names = [field.name for field in fields(cls)]
        state = {name: torch.zeros(*batch, *sizes.get(name, (3,))) for name in names}
        return cls(**state, batch_size=torch.Size(batch))


class TouchPolicy(Policy):
    """A flow policy whose flow is corrected by what its pulls have taught.

    Shapes: reads what :class:`~fb3d_rl.policies.flow_policy.FlowPolicy` reads, the slides' velocities ("observation",
    "qvel") and, if the network proposes K flows, ("prediction", "flows") [E, K, N, 3] and ("prediction",
    "log_probabilities") [E, K, N]. Overwrites ("prediction", "flow") where pulls have taught something; writes what the
    flow policy writes, the tip's velocity in a pull ("prediction", "pull_velocity") [E, 3] (m/s), and the next step's
    :class:`TouchState` under ("next", "touch").

    Args:
        limits: what an action means.
        options: speeds and thresholds.
        proposals: whether the network proposes several flows.
    """

    def __init__(self, limits: VelocityLimits, options: FlowPolicyOptions, proposals: bool) -> None:
        super().__init__()
        self.limits, self.options, self.proposals = limits, options, proposals
        self.flow_policy = FlowPolicy(FLOW, limits, options, VELOCITY)
        state = [("touch", field.name) for field in fields(TouchState)]
        self.in_keys = [key for key in self.flow_policy.in_keys if key != VELOCITY] + [("observation", "qvel"), *state]
        self.in_keys += [PROPOSALS, LOG_PROBABILITIES] if proposals else []
        self.out_keys = [FLOW, VELOCITY, *self.flow_policy.out_keys, *(("next", *key) for key in state)]

    def initial_state(self, batch: torch.Size) -> TensorDict:
        """The flow policy's state and {"touch": ...}: nothing is known."""
        touch = TensorDict({"touch": TouchState.initial(batch).to_tensordict()}, batch_size=batch)
        return self.flow_policy.initial_state(batch).update(touch)

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the corrected flow, the action and the next state."""
        obs, state = tensordict["observation"], TouchState.from_tensordict(tensordict["touch"])
        state = state.apply(lambda x: x.double())
        assert isinstance(state, TouchState)
        held = obs["attached"]
        pulled = (tensordict["policy", "phase"] == PULL) & (state.asked != 0).any(-1, keepdim=True)
        state, blocked, halted = self._update(state, obs, held, pulled)
        asked = velocity = torch.zeros_like(state.tip)
        known = held | state.information.flatten(1).any(1, keepdim=True) | state.evidence.any(-1, keepdim=True)
        if bool(known.any()):
            flow, twist, direction = self._believe(tensordict, state, held, pulled, blocked)
            tensordict[FLOW] = torch.where(known[..., None], flow, tensordict[FLOW])
            turns = pulled & held & (dot(direction, normalize(state.asked)) < TURNED)
            self._conclude(state, turns)
            state.moved, state.limits = (torch.where(turns, 0.0, x) for x in (state.moved, state.limits))
            asked, velocity = self._pull(obs, state, held, halted, twist, direction)
        tensordict[VELOCITY] = velocity.float()
        tensordict = self.flow_policy(tensordict)
        state.asked, state.commanded = asked, self.limits.linear * tensordict["action"][:, :3].double()
        tensordict["next", "touch"] = state.apply(lambda x: x.float()).to_tensordict()
        return tensordict

    def _pull(
        self,
        obs: TensorDictBase,
        state: TouchState,
        held: Tensor,
        halted: Tensor,
        twist: Tensor,
        direction: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """The velocity of the part that is asked for and that of the tip which is to bring it about, [E, 3] m/s."""
        o, options = self.options.touch, self.options
        speed = torch.where(state.tested > o.free_after, options.pull_speed, o.speed)
        # At a limit the hand waits until it counts as stuck and the flow policy lets go, or the part follows.
        speed = torch.where(state.limits > 0, speed.clamp_max(0.5 * options.stuck_speed), speed)
        ahead = torch.linalg.cross(options.lead * self.limits.period * speed * twist[:, 3:], direction)
        asked = torch.where(held, speed * direction, 0.0)
        across = state.stretch - dot(state.stretch, direction) * direction
        all_of_it = 1.0 / self.limits.period  # in one step
        yields = torch.where(
            halted, min(o.yield_gain, all_of_it) * state.stretch, min(o.slack_gain, all_of_it) * across
        )
        presses = (obs["contact_force"] > options.force) & (speed < options.pull_speed)
        backs_off = torch.where(presses, o.ease_speed, 0.0) * hand_axis(obs["tool_pose"]).double()
        return asked, speed * normalize(direction + ahead) - yields + backs_off

    def _update(
        self, state: TouchState, obs: TensorDictBase, held: Tensor, pulled: Tensor
    ) -> tuple[TouchState, Tensor, Tensor]:
        """The state after the last step; where the pull met a limit, and where it met that or resistance [E, 1]."""
        o, period = self.options.touch, self.limits.period
        state = state.clone(recurse=False)
        tip, slides = obs["tool_pose"][:, :3].double(), obs["qvel"][:, :3].double()
        goes_on, begins, lost = pulled & held, held & ~pulled, pulled & ~held
        pressed = obs["contact_force"] > self.options.force  # then the drives yield to more than the spring
        direction, wanted = normalize(state.asked), length(state.asked)
        before, strained, way = state.tip - state.stretch, dot(state.stretch, direction), length(tip - state.tip)
        slow = state.tested <= o.free_after
        # The spring's force is stiffness * stretch + damping * its rate; the drives' is in proportion to the lag.
        lag = state.commanded - slides
        decay = math.exp(-period * o.stiffness / o.damping)
        stretch = torch.where(pressed, state.stretch, decay * state.stretch + (1 - decay) / o.stiffness * lag)
        state.tip, state.stretch = tip, torch.where(goes_on, stretch, 0.0)
        point = tip - state.stretch
        moved = torch.where(goes_on, dot(point - before, direction), 0.0)
        state.moved, state.tested = state.moved + moved, state.tested + moved
        self._begin(state, begins)
        self._measure(state, point, direction, goes_on)

        ahead = dot(state.stretch, direction)
        state.limits = torch.where(state.tested > o.free_after, 0.0, state.limits)
        stops = (ahead > o.limit_stretch) & (state.tested < FOLLOWS * ahead)
        stops |= pressed & (way < o.still * wanted * period) & (state.tested < o.at_once)
        blocked = goes_on & slow & stops & (state.limits == 0)
        resisted = goes_on & ~slow & ~pressed & (dot(lag, direction) > o.resistance * wanted)
        # A spring that tears so soon was stretched by nearly all of the tip's way: the part did not follow.
        early = lost & (state.moved + strained < TEARS_EARLY)
        state.moved = torch.where(early, 0.0, state.moved)
        torn = lost & (state.limits == 0) & (early | (strained > 0.5 * o.limit_stretch))
        along = _along(state)
        known = (along * state.evidence).sum(-1, keepdim=True)
        # Where the part has moved this way before, the limit is one at the end of a way.
        at_once = (state.moved < o.at_once) & (known <= 0)
        against = torch.where(at_once, o.against_at_once, o.against)
        # Neither sense moves a part that never moved: it cannot move along this direction, as if that were measured.
        neither = blocked & (state.moved < o.at_once) & (known > o.against) & ~state.moment.any(-1, keepdim=True)
        against = torch.where(neither, o.against_at_once, against)
        stiff = torch.where(neither, o.at_once / o.noise, 0.0)[..., None]
        state.information = state.information + stiff * along[..., None] * along[:, None]
        state.evidence = state.evidence - torch.where(blocked | torn, against, 0.0) * along
        self._conclude(state, ~goes_on)
        state.measured = torch.where(blocked, point, state.measured)
        state.limits = torch.where(goes_on, state.limits + blocked, 0.0)
        state.moved = torch.where(goes_on, state.moved, 0.0)
        state.tested = torch.where(blocked | lost | begins | resisted, 0.0, state.tested)
        return state, blocked, blocked | resisted

    def _begin(self, state: TouchState, begins: Tensor) -> None:
        """Begin a pull where the part was just held [E, 1]. Without a mask a part far from the last one is another."""
        first = begins & ~state.origin.any(-1, keepdim=True)
        if self.options.mask == "none":
            other = begins & ~first & (length(state.tip - state.origin) > NEAR)
            state.information = torch.where(other[..., None], 0.0, state.information)
            state.moment, state.evidence = (torch.where(other, 0.0, x) for x in (state.moment, state.evidence))
            first = first | other
        state.origin = torch.where(first, state.tip, state.origin)
        state.measured = torch.where(begins, state.tip, state.measured)

    def _measure(self, state: TouchState, point: Tensor, direction: Tensor, goes_on: Tensor) -> None:
        """Measure the way of the held ``point`` [E, 3], if it has gone far enough for that."""
        o, step = self.options.touch, point - state.measured
        far = length(step) > length(state.stretch).clamp_min(o.spacing)
        measures = goes_on & far & (dot(step, direction) > 0.3 * length(step))
        rows = _velocity_at(point - 0.5 * step - state.origin)  # [E, 3, 6]
        weight = torch.where(measures, length(step) / o.noise, 0.0)[..., None]
        # A twist is of unit speed at the origin, and so of the speed here that follows from what was measured.
        ridge = torch.eye(6, dtype=step.dtype, device=step.device)
        mean = torch.linalg.solve(state.information + ridge, state.moment[..., None])
        speed = length((rows @ mean).squeeze(-1)).clamp(0.2, 5.0)
        speed = torch.where(state.moment.any(-1, keepdim=True), speed, 1.0)
        seen = (rows.mT @ (speed * normalize(step))[..., None]).squeeze(-1)
        seen = torch.where((seen * state.moment).sum(-1, keepdim=True) < 0, -seen, seen)
        state.information = state.information + weight * (rows.mT @ rows)
        state.moment = state.moment + weight.squeeze(-1) * seen
        state.measured = torch.where(measures, point, state.measured)

    def _conclude(self, state: TouchState, where: Tensor) -> None:
        """Count the way that the part has gone for its direction, where the pull in it has ended [E, 1]."""
        gained = torch.where(where, self._gained(state), 0.0)
        state.evidence = state.evidence + gained * _along(state)

    def _gained(self, state: TouchState) -> Tensor:
        return (state.moved / self.options.touch.convincing).clamp(0.0, MOST_GAINED)

    def _believe(
        self, tensordict: TensorDictBase, state: TouchState, held: Tensor, pulled: Tensor, blocked: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The flow [E, N, 3] by all that is known, its twist [E, 6] and the direction of the pull [E, 3]."""
        o, obs, tip = self.options.touch, tensordict["observation"], state.tip
        valid, sense = obs["valid"], obs["goal_sense"].double()
        part = obs["part_mask"] & valid if self.options.mask == "target" else None
        flows = tensordict[PROPOSALS] if self.proposals else tensordict[FLOW][:, None]  # [E, K, N, 3]
        count = flows.shape[1]
        place = torch.where(held, tip, state.origin)
        if part is None:
            squared = squared_distances(obs["points"], place.to(obs["points"])[:, None]).squeeze(-1)
            body = (squared < NEAR**2) & valid
            weights = [local_weight(flow, squared).masked_fill(~valid, 0.0) for flow in flows.unbind(1)]
        else:
            body, weights = part, [part.to(flows)] * count
        each = zip(flows.unbind(1), weights, strict=True)
        twists = torch.stack([_twist(obs["points"], flow, weight, state.origin) for flow, weight in each], 1)
        prior = tip.new_zeros(len(tip), count)
        if self.proposals:
            prior = Hypotheses(flows, tensordict[LOG_PROBABILITIES]).of_clouds(body).double().log()
        prior = torch.cat([prior + math.log(o.certainty), prior + math.log1p(-o.certainty)], 1)
        candidates = torch.cat([twists, -twists], 1) * sense[..., None]  # of the way that is pulled

        rows = _velocity_at(place - state.origin)
        trust = rows.mT @ rows / o.deviation**2  # [E, 6, 6] of the network
        trust[:, 3:, 3:] += torch.eye(3, dtype=trust.dtype, device=trust.device) / o.turn_deviation**2
        guess = candidates @ trust
        aligned = torch.where((candidates * state.moment[:, None]).sum(-1, keepdim=True) < 0, -1.0, 1.0)
        right = aligned * state.moment[:, None] + guess
        total = state.information + trust
        fused = torch.linalg.solve(total[:, None], right[..., None]).squeeze(-1)  # [E, 2K, 6]
        fits = 0.5 * ((right * fused).sum(-1) - (candidates * guess).sum(-1))
        ways = fused @ rows.mT  # [E, 2K, 3]
        fused = fused / length(ways).clamp_min(1e-3)
        ways = normalize(ways)
        goes_on = self._gained(state) + torch.where(blocked, 0.0, o.keeps)
        keeps = torch.where(pulled & held, goes_on * (ways @ normalize(state.asked)[..., None]).squeeze(-1), 0.0)
        best = (prior + fits + (fused * state.evidence[:, None]).sum(-1) + keeps).argmax(1)
        row = torch.arange(len(tip))
        twist, direction = fused[row, best], ways[row, best]

        unseen = (direction == 0).all(-1, keepdim=True)  # the hand may hide a small part: pull on as before
        direction = torch.where(unseen, normalize(sense * tensordict["policy", "pull"].double()), direction)
        twist = torch.where(unseen, torch.cat([direction, torch.zeros_like(direction)], -1), twist)

        flipped = torch.where(best < count, 1.0, -1.0).to(flows)
        flow = flipped[:, None, None] * flows[row, best % count]
        field = twist[:, None, :3] + torch.linalg.cross(
            twist[:, None, 3:].expand(-1, valid.shape[1], -1), obs["points"].double() - state.origin[:, None]
        )
        moving = body & (flow.norm(dim=-1) > MOVES) if part is None else body
        field = (sense[..., None] * field).masked_fill(~moving[..., None], 0.0)
        field = field / field.norm(dim=-1).amax(1)[:, None, None].clamp_min(1e-9)
        measured = state.information.flatten(1).any(1)[:, None, None]
        flow = torch.where(measured, field.to(flow), flow)
        if part is None:  # other parts keep their flow
            flow = torch.where(body[..., None], flow, tensordict[FLOW])
        return flow, twist, direction


def _twist(points: Tensor, flow: Tensor, weight: Tensor, origin: Tensor) -> Tensor:
    """The twist [E, 6] at ``origin`` [E, 3] that fits a flow best, of unit speed there unless that is near its axis."""
    velocity, omega = (x.double() for x in rigid_motion(points, flow, weight, origin.to(points), 1e-4))
    largest = flow.norm(dim=-1).amax(1, keepdim=True).double()
    # Near the axis the scale would be arbitrary.
    speed = torch.maximum(length(velocity), 0.2 * largest).clamp_min(1e-9)
    return torch.cat([velocity, omega], -1) / speed


def _along(state: TouchState) -> Tensor:
    """The row [E, 6] that takes a twist to the held point's speed in the direction of the last pull."""
    point = state.tip - state.stretch
    return (_velocity_at(point - state.origin).mT @ normalize(state.asked)[..., None]).squeeze(-1)


def _velocity_at(arm: Tensor) -> Tensor:
    """The matrix [E, 3, 6] that takes a twist to the velocity of the body's point ``arm`` [E, 3] (m) off the origin."""
    eye = torch.eye(3, dtype=arm.dtype, device=arm.device).expand(len(arm), 3, 3)
    return torch.cat([eye, -skew(arm)], -1)
