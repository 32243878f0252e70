"""Which phase of the flow policy comes next: what is observed in each phase, and what it decides.

Every ``after_...`` function takes the environments that are in its phase: (state, observation, control) -> state. It
changes nothing in place and leaves ``state.tip``, which is still the tip of the last step. The phases are drawn in
:mod:`fb3d_rl.policies.flow_policy`.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from fb3d_rl.geometry.points import squared_distances
from fb3d_rl.geometry.transforms import alignment, dot, length, normalize
from fb3d_rl.policies.contact import choose_contact
from fb3d_rl.policies.flow_state import (
    APPROACH,
    PULL,
    RELEASE,
    RETREAT,
    SELECT,
    TRAVEL,
    TRIES,
    Control,
    FlowState,
    Observed,
    join,
    split_by_phase,
)

ALIGNED = 0.15
"""Angle (rad) between hand and standoff below which the approach may begin."""


def advance(state: FlowState, seen: Observed, control: Control) -> FlowState:
    """Move on to the phase that the observation calls for, and choose a contact point where that is SELECT."""
    parts = [(rows, AFTER[phase](mine, view, control)) for phase, rows, mine, view in split_by_phase(state, seen)]
    state = join(parts)
    state = state.updated(tip=seen.tip, came=torch.where(seen.phase == TRAVEL, state.came, 0.0))
    last = (state.phase == RETREAT) & ~may_choose(state, control)
    state = state.changed(last, phase=SELECT, standoff=seen.hand)  # and there it stays
    caught = seen.attached & (state.phase != PULL) & (state.phase != RELEASE)
    # Held by chance, from another side than chosen: the hand keeps its direction.
    state = state.changed(caught & (state.phase != APPROACH), standoff=seen.hand).changed(caught, phase=PULL)
    chooses = (state.phase == SELECT) & may_choose(state, control)
    if not bool(chooses.any()):
        return state
    rows = chooses.squeeze(-1)
    if bool(rows.all()):
        return select(state, seen, control)
    return join([(rows, select(state[rows], seen[rows], control)), (~rows, state[~rows])])


def after_select(state: FlowState, seen: Observed, control: Control) -> FlowState:
    """Nothing was chosen in the last step: try again."""
    return state.updated(idle=torch.zeros_like(state.idle))


def after_travel(state: FlowState, seen: Observed, control: Control) -> FlowState:
    """Near the approach line and aligned with it: APPROACH. Halted by something that the cloud lacks: RETREAT."""
    offset = seen.tip - state.contact_point
    height = dot(offset, state.standoff)
    state = _count(state, _halted(state, seen, control))
    state = state.updated(came=control.fade * state.came - (seen.tip - state.tip))
    blocked = state.idle > control.stuck
    arrived = (
        ~blocked
        & (length(alignment(seen.hand, state.standoff)) < ALIGNED)
        & (length(offset - height * state.standoff) < control.options.line)
        & (height > 0)
    )
    state = state.given_up(blocked, state.contact_point).changed(arrived, phase=APPROACH)
    back = normalize(state.came)
    return state.changed(blocked, phase=RETREAT, leave=back, contact_point=seen.tip, standoff=seen.hand)


def after_approach(state: FlowState, seen: Observed, control: Control) -> FlowState:
    """Pressed for too long without hold, or past the contact point: RETREAT. (Held: PULL, see :func:`advance`.)"""
    height = dot(seen.tip - state.contact_point, state.standoff)
    state = _count(state, _touches(seen, control))
    failed = ~seen.attached & ((state.idle > control.patience) | (height < -control.options.overshoot))
    state = state.given_up(failed, state.contact_point)
    return state.changed(failed, phase=RETREAT, leave=state.standoff)


def after_pull(state: FlowState, seen: Observed, control: Control) -> FlowState:
    """Hold is lost: RETREAT, from where the hand is. Stuck, or held where the flow is small: RELEASE, if another point
    may be chosen.
    """
    progress = seen.sense * dot(seen.tip - state.tip, state.pull)
    state = _count(state, seen.attached & (progress < control.still))
    lost = ~seen.attached
    stuck = seen.attached & ((state.idle > control.stuck) | _held_badly(seen, control)) & may_choose(state, control)
    state = state.changed(lost, phase=RETREAT, leave=state.standoff, contact_point=seen.tip, standoff=seen.hand)
    state = state.given_up(stuck, seen.tip)
    return state.changed(stuck, phase=RELEASE, leave=across_flow(seen.hand, state.pull), idle=0)


def after_retreat(state: FlowState, seen: Observed, control: Control) -> FlowState:
    """Far enough away, or halted: SELECT."""
    state = _count(state, _halted(state, seen, control))
    far = dot(seen.tip - state.contact_point, state.leave) > control.options.precontact
    return state.changed(far | (state.idle > control.stuck), phase=SELECT)


def after_release(state: FlowState, seen: Observed, control: Control) -> FlowState:
    """Torn off: RETREAT. Not torn off for too long: PULL again."""
    state = state.updated(idle=state.idle + 1)
    state = state.changed(~seen.attached, phase=RETREAT, contact_point=seen.tip, standoff=seen.hand)
    return state.changed(state.idle > control.release, phase=PULL, idle=0)


AFTER = {
    SELECT: after_select,
    TRAVEL: after_travel,
    APPROACH: after_approach,
    PULL: after_pull,
    RETREAT: after_retreat,
    RELEASE: after_release,
}
"""What is decided in each phase."""


def select(state: FlowState, seen: Observed, control: Control) -> FlowState:
    """Choose a contact point away from the failed ones and set out for it; without flow, keep waiting."""
    usable = seen.valid if seen.part is None else seen.part & seen.valid
    flow = torch.where(usable[..., None], seen.flow, 0.0)
    avoid = torch.zeros_like(seen.valid)
    for slot in range(min(int(state.tries.max()), TRIES)):
        failed = state.tried[:, slot, None].to(seen.points)
        near = (seen.points - failed).norm(dim=-1) < control.options.retry_distance
        avoid |= near & (slot < state.tries)
    tip, hand = seen.tip.to(seen.points), seen.hand.to(seen.points)
    contact, regrasp = control.options.contact, control.options.regrasp
    if regrasp is not None:  # else it would let go again
        contact = replace(contact, min_flow=max(contact.min_flow, 1.0 - regrasp))
    return state.set_out(
        *choose_contact(seen.points, seen.valid, seen.part, flow, seen.camera, tip, hand, avoid, contact)
    )


def may_choose(state: FlowState, control: Control) -> Tensor:
    """Whether another contact point may be chosen [E, 1] bool."""
    retries = control.options.retries
    return torch.ones_like(state.chosen, dtype=torch.bool) if retries is None else state.chosen <= retries


def across_flow(hand: Tensor, pull: Tensor) -> Tensor:
    """Unit directions [E, 3] across ``pull`` in which the hand backs off; level ones where it comes along ``pull``.

    Across the flow the part cannot follow, so that the suction breaks; along it the part would only be moved on.
    """
    away = hand - dot(hand, pull) * pull
    up = torch.tensor([0.0, 0.0, 1.0], dtype=pull.dtype, device=pull.device)
    return normalize(torch.where(length(away) > 0.3, away, torch.linalg.cross(pull, up.expand_as(pull))))


def _held_badly(seen: Observed, control: Control) -> Tensor:
    """Whether the flow is much larger elsewhere than where the hand holds [E, 1] bool."""
    if control.options.regrasp is None:
        return torch.zeros_like(seen.attached)
    usable = seen.valid if seen.part is None else seen.part & seen.valid
    size = seen.flow.norm(dim=-1).masked_fill(~usable, 0.0)
    squared = squared_distances(seen.points, seen.tip.to(seen.points)[:, None]).squeeze(-1)
    here = size.gather(1, squared.masked_fill(~usable, torch.inf).argmin(1, keepdim=True))
    largest = size.amax(1, keepdim=True)
    return largest - here > control.options.regrasp * largest


def _count(state: FlowState, idle: Tensor) -> FlowState:
    """Count the steps in a row without progress."""
    return state.updated(idle=torch.where(idle, state.idle + 1, 0))


def _touches(seen: Observed, control: Control) -> Tensor:
    return seen.force > control.options.force


def _halted(state: FlowState, seen: Observed, control: Control) -> Tensor:
    return _touches(seen, control) & (length(seen.tip - state.tip) < control.still)
