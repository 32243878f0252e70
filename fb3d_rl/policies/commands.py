"""What the flow policy commands in each phase: the velocity of the suction tip, and how the hand shall stand.

Every command takes the environments that are in its phase: (state, observation, control) -> (state, tip velocity
[E, 3] in m/s, float64, world). It changes nothing in place. The phases are drawn in
:mod:`fb3d_rl.policies.flow_policy`.
"""

from __future__ import annotations

import torch
from torch import Tensor

from fb3d_rl.assets.gripper import HAND_LENGTH
from fb3d_rl.geometry.points import squared_distances
from fb3d_rl.geometry.rigid_motion import local_weight, rigid_motion
from fb3d_rl.geometry.transforms import alignment, dot, length, normalize, rotate
from fb3d_rl.policies.flow_state import (
    APPROACH,
    PULL,
    RELEASE,
    RETREAT,
    SELECT,
    TRAVEL,
    Control,
    FlowState,
    Observed,
    join,
    split_by_phase,
)

Commanded = tuple[FlowState, Tensor]


def command(state: FlowState, seen: Observed, control: Control) -> Commanded:
    """The state and the tip velocities of all environments, each by its phase."""
    parts = [(rows, COMMANDS[phase](mine, view, control)) for phase, rows, mine, view in split_by_phase(state, seen)]
    return join([(rows, part[0]) for rows, part in parts]), join([(rows, part[1]) for rows, part in parts])


def wait(state: FlowState, seen: Observed, control: Control) -> Commanded:
    """SELECT without a contact point: stay."""
    return state, torch.zeros_like(seen.tip)


def travel(state: FlowState, seen: Observed, control: Control) -> Commanded:
    """To the approach line: straight into a funnel that narrows to the pre-contact point, if that way is free.

    Otherwise around the object's bounding sphere to where the approach line leaves it. A hand that comes from another
    side of the object first leaves the sphere along ``state.leave``, as it backed off before.
    """
    o, contact, standoff = control.options, state.contact_point, state.standoff
    # The goal on the approach line stays above the ground.
    sinks = standoff[:, 2:] < 0
    highest = ((contact[:, 2:] - o.clearance) / -standoff[:, 2:]).clamp_min(2 * o.precontact)
    highest = torch.where(sinks, highest, torch.inf)
    offset = seen.tip - contact
    sideways = length(offset - dot(offset, standoff) * standoff)
    funnel = contact + torch.minimum(o.precontact + o.funnel * sideways, highest) * standoff
    cloud = seen.points.double()
    leaves = (state.leave != 0).any(-1, keepdim=True)
    straight = ~leaves & ~in_the_way(cloud, seen.valid, seen.tip, funnel, o.free)
    velocity = straight_to(seen.tip, funnel, control)
    if bool(straight.all()):
        return state, velocity

    centre, radius = _bounding_sphere(cloud, seen.valid, o.margin)
    # |contact + t standoff - centre| = radius, the larger root
    from_centre = contact - centre
    b = dot(from_centre, standoff)
    root = (b * b - (dot(from_centre, from_centre) - radius**2)).clamp_min(0.0).sqrt()
    goal = contact + torch.minimum((root - b).clamp_min(2 * o.precontact), highest) * standoff

    distance = length(seen.tip - centre)
    outside = (distance > radius) | (dot(state.leave, standoff) >= 0.5)
    leave = torch.where(outside, 0.0, state.leave)
    detour = torch.where(
        (leave != 0).any(-1, keepdim=True),
        o.travel_speed * leave,
        _around(seen.tip, goal, centre, radius, control),
    )
    return state.updated(leave=leave), torch.where(straight, velocity, detour)


def approach(state: FlowState, seen: Observed, control: Control) -> Commanded:
    """Along the approach line, slower (guarded) from the pre-contact point on."""
    o = control.options
    offset = seen.tip - state.contact_point
    height = dot(offset, state.standoff)
    sideways = offset - height * state.standoff
    speed = (control.gain(10.0) * (height - o.precontact)).clamp_min(o.touch_speed).clamp_max(o.approach_speed)
    return state, -speed * state.standoff - control.gain(8.0) * sideways


def pull(state: FlowState, seen: Observed, control: Control) -> Commanded:
    """Along the flow at the tip. What turns the last flow into this one also turns the hand."""
    flow = flow_at_tip(state, seen, control)
    goes_on = seen.phase == PULL
    turns = torch.where(dot(state.pull, flow) < 0, -flow, flow)  # a flow that reverses does not turn the hand
    turned = rotate(state.standoff, alignment(state.pull, turns))
    state = state.changed(goes_on, standoff=turned).updated(pull=flow)
    return state, seen.sense * control.options.pull_speed * flow if seen.pull is None else seen.pull


def retreat(state: FlowState, seen: Observed, control: Control) -> Commanded:
    """Away from the contact point."""
    return state, control.options.approach_speed * state.leave


def release(state: FlowState, seen: Observed, control: Control) -> Commanded:
    """Away across the flow, as fast as the gripper can."""
    return state, control.limits.linear * state.leave


COMMANDS = {
    SELECT: wait,
    TRAVEL: travel,
    APPROACH: approach,
    PULL: pull,
    RETREAT: retreat,
    RELEASE: release,
}
"""What is commanded in each phase."""


def flow_at_tip(state: FlowState, seen: Observed, control: Control) -> Tensor:
    """Unit flow [E, 3] at the tip, ``lead`` ahead; the last one where none is seen.

    The flow of a rigid part is v + omega x r. Both are fitted to the visible points (weighted least squares), the near
    ones foremost: the hand often hides those around the held point. Without a mask what has a flow may belong to
    several parts, so that only what is near counts. Where the part's twist is known, nothing is fitted.
    """
    o, tip = control.options, seen.tip.to(seen.points)
    squared = squared_distances(seen.points, tip[:, None]).squeeze(-1)
    if seen.part is None:
        weight = local_weight(seen.flow, squared).masked_fill(~seen.valid, 0.0)
    else:
        weight = (seen.part & seen.valid) / (1.0 + squared / o.nearby**2)
    fitted = rigid_motion(seen.points, seen.flow, weight, tip, 1e-2 * o.nearby**2)
    velocity, omega = (x.double() for x in fitted)
    if seen.twist is not None:
        linear, turn = seen.twist.split(3, -1)
        known = seen.twist.any(-1, keepdim=True)
        velocity = torch.where(known, linear + torch.linalg.cross(turn, seen.tip), velocity)
        omega = torch.where(known, turn, omega)
    speed, unit = length(velocity), normalize(velocity)
    rate = seen.sense * o.lead * control.limits.period * o.pull_speed / speed.clamp_min(1e-6) * omega
    return torch.where(speed > 1e-6, normalize(unit + torch.linalg.cross(rate, unit)), state.pull)


def in_the_way(cloud: Tensor, valid: Tensor, tip: Tensor, goal: Tensor, free: float) -> Tensor:
    """Whether the straight way brings the tip nearer than ``free`` to points it is not as near to already, [E, 1]."""
    way, offset = goal - tip, cloud - tip[:, None]
    share = (offset @ way[..., None]) / dot(way, way).clamp_min(1e-12)[..., None]
    nearest = length(offset - share.clamp(0.0, 1.0) * way[:, None])
    near = (nearest < free) & (nearest < length(offset) - 0.01) & valid[..., None]
    return near.sum(1) > 1


def above_ground(axis: Tensor, tip: Tensor, clearance: float) -> Tensor:
    """Lift unit hand axes [E, 3] that would take the hand's far end below ``clearance`` (m)."""
    lowest = ((clearance - tip[:, 2:]) / HAND_LENGTH).clamp(-1.0, 0.9)
    lifted = torch.cat([normalize(axis[:, :2]) * (1.0 - lowest**2).sqrt(), lowest], dim=-1)
    return torch.where(axis[:, 2:] >= lowest, axis, lifted)


def straight_to(tip: Tensor, goal: Tensor, control: Control) -> Tensor:
    """Velocity [E, 3] (m/s) from the tip to a goal [E, 3] (m), slower the last bit of the way."""
    way = goal - tip
    return (control.gain(6.0) * length(way)).clamp_max(control.options.travel_speed) * normalize(way)


def _around(tip: Tensor, goal: Tensor, centre: Tensor, radius: Tensor, control: Control) -> Tensor:
    """Velocity along a sphere towards where the goal is; straight to a goal on the same side."""
    distance = length(tip - centre)
    outward = normalize(tip - centre)
    turn = alignment(outward, goal - centre)
    tangent = torch.linalg.cross(normalize(turn), outward)
    along = normalize(tangent + (radius - distance).clamp(-1.0, 1.0) * 4.0 * outward)
    other_side = (length(turn) > 0.35) & (distance > 0.5 * radius)
    return torch.where(other_side, control.options.travel_speed * along, straight_to(tip, goal, control))


def _bounding_sphere(cloud: Tensor, valid: Tensor, margin: float) -> tuple[Tensor, Tensor]:
    """Centre [E, 3] and radius [E, 1] around the visible points, ``margin`` (m) larger; at 0 if there are none."""
    seen = valid[..., None]
    low, high = cloud.masked_fill(~seen, torch.inf).amin(1), cloud.masked_fill(~seen, -torch.inf).amax(1)
    centre = torch.where(valid.any(-1, keepdim=True), 0.5 * (low + high), 0.0)
    return centre, margin + length(cloud - centre[:, None]).masked_fill(~seen, 0.0).amax(1)
