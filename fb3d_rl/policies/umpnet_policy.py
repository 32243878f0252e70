"""UMPNet's policy (Xu, He and Song, RA-L 2022): where a part can be moved, then in which direction to pull."""

from __future__ import annotations

import math

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictSequential
from torch import Tensor, nn
from torch.nn import functional

from fb3d_rl.contract import GOAL_POINTS
from fb3d_rl.models.direction_net import SearchOptions, best_direction
from fb3d_rl.models.umpnet import Seen, UmpNet, score
from fb3d_rl.policies.direction_policy import pulled_point
from fb3d_rl.policies.flow_policy import FlowPolicy, FlowPolicyOptions
from fb3d_rl.policies.hand import VelocityLimits
from fb3d_rl.policies.policy import Policy

BANNED = 8
"""Pulls in vain that are remembered."""

CLOSE = math.cos(0.25)
"""Cosine of half the distance between 64 directions on a sphere, which UMPNet's search has: so far a pull in vain rules
out others.
"""


class UmpnetFlow(Policy):
    """UMPNet's answer, written as a flow: its size says where a part can be moved, its direction is that of the pull.

    With a goal image (protocol=umpnet) a pull is the one by which the arrow of time brings the part farthest towards
    it; without one, farthest away from what was seen first. Directions in which the last pulls moved nothing are left
    out until something moves; only UMPNet's world says so. A flow opens, and is turned over by who follows it where the
    part is to be closed (``goal_sense``); as the pull is the right one as it is, it is turned over here as well.

    Shapes: reads the observation's points [E, N, 3], valid, part_mask [E, N], tool_pose, attached and goal_sense, and,
    where they are there, the contract's group "umpnet"; writes ("prediction", "flow") [E, N, 3]. Its state, below
    "umpnet", is the cloud that it saw first, the last direction, and the banned ones.
    """

    def __init__(self, net: UmpNet, options: SearchOptions | None = None) -> None:
        super().__init__()
        self.net, self.options = net, options or SearchOptions()
        observed = ("points", "valid", "part_mask", "tool_pose", "attached", "goal_sense")
        state = self.initial_state(torch.Size([])).keys(include_nested=True, leaves_only=True)
        self.in_keys = [*(("observation", key) for key in observed), *state]
        self.out_keys = [("prediction", "flow"), *(("next", *key) for key in state)]

    def initial_state(self, batch: torch.Size) -> TensorDict:
        """See the base class."""
        state = {
            "started": torch.zeros(*batch, 1, dtype=torch.bool),
            "points": torch.zeros(*batch, GOAL_POINTS, 3),
            "valid": torch.zeros(*batch, GOAL_POINTS, dtype=torch.bool),
            "last": torch.zeros(*batch, 3),
            "banned": torch.zeros(*batch, BANNED, 3),
        }
        return TensorDict({"umpnet": TensorDict(state, batch_size=batch)}, batch_size=batch)

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the pull and the next state."""
        observed, state = tensordict["observation"], tensordict["umpnet"]
        points, valid = observed["points"], observed["valid"]
        first = {"points": _first(points), "valid": _first(valid[..., None])[..., 0]}
        first = {key: torch.where(_wide(state["started"], x), state[key], x) for key, x in first.items()}
        goal = tensordict.get("goal", None)
        other = first if goal is None else goal
        seen = self.net.see(
            torch.cat([points, other["points"]], 1),
            torch.cat([valid, other["valid"]], 1),
            torch.cat([torch.zeros_like(valid), other["valid"]], 1),
        )
        part = observed["part_mask"] & valid
        likely = seen.movable.sigmoid().masked_fill(~part, 0.0)
        held = observed["attached"].squeeze(-1)
        contact = pulled_point(likely, points, part, observed["tool_pose"], held)
        banned = _banned(state, tensordict.get(("pull", "moved"), None))
        way = best_pull(self.net, seen, contact, 1.0 if goal is None else -1.0, banned, self.options)
        size = torch.where(held[:, None], part.to(likely), likely)[..., None]
        tensordict["prediction", "flow"] = size * (observed["goal_sense"] * way)[:, None]
        after = {"started": torch.ones_like(state["started"]), **first, "banned": banned}
        after["last"] = way.masked_fill(~held[:, None], 0.0)  # before that nothing is pulled
        tensordict["next", "umpnet"] = TensorDict(after, batch_size=tensordict.batch_size)
        return tensordict


def _first(rows: Tensor) -> Tensor:
    """The first GOAL_POINTS of rows [E, N, D], which clouds have in random order; zeros where there are fewer."""
    rows = rows[:, :GOAL_POINTS]
    return functional.pad(rows, (0, 0, 0, GOAL_POINTS - rows.shape[1]))


def _wide(flags: Tensor, like: Tensor) -> Tensor:
    return flags.view(len(flags), *(1 for _ in like.shape[1:]))


def _banned(state: TensorDictBase, moved: Tensor | None) -> Tensor:
    """The directions [E, BANNED, 3] not to pull in, 0 where there are fewer."""
    if moved is None:
        return state["banned"]
    later = torch.cat([state["last"][:, None], state["banned"][:, :-1]], dim=1)
    return later.masked_fill(moved[..., None], 0.0)


def best_pull(net: UmpNet, seen: Seen, contact: Tensor, sign: float, banned: Tensor, options: SearchOptions) -> Tensor:
    """The direction [B, 3] of the largest ``sign`` * :func:`score` at point number contact [B] of each cloud.

    ``banned`` [B, M, 3] are directions near which there is none; those that are 0 ban nothing.
    """
    at = seen.at(contact)

    def scores(directions: Tensor) -> Tensor:
        directions = directions.expand(len(contact), -1, -1)
        found = sign * score(*net.judge(at, directions))
        ruled_out = (directions[:, :, None] * banned[:, None]).sum(-1) > CLOSE
        return found.masked_fill(ruled_out.any(-1), -torch.inf)

    return best_direction(scores, options, contact.device)


def umpnet_policy(
    net: nn.Module, limits: VelocityLimits, options: FlowPolicyOptions | None = None
) -> TensorDictSequential:
    """The flow policy fed with UMPNet's answer."""
    assert isinstance(net, UmpNet)
    if options is not None:
        options.require_mask("policy=umpnet")
    return TensorDictSequential(UmpnetFlow(net), FlowPolicy(("prediction", "flow"), limits, options))
