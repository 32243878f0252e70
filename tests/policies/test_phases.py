"""The flow policy's phases one by one: what each decides and commands."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from fb3d_rl.policies.commands import approach, command, in_the_way, pull, release, retreat, travel, wait
from fb3d_rl.policies.flow_policy import FlowPolicyOptions
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
from fb3d_rl.policies.hand import VelocityLimits
from fb3d_rl.policies.transitions import (
    across_flow,
    advance,
    after_approach,
    after_pull,
    after_release,
    after_retreat,
    after_travel,
    select,
)

OPTIONS = FlowPolicyOptions()
CONTROL = Control(OPTIONS, VelocityLimits(2.0, 3.0, 0.05))
OUT = (-1.0, 0.0, 0.0)
"""Where the hand stands off a door in the plane x = 0."""
CONTACT = (0.0, 0.2, 0.5)


def vector(*values: float) -> Tensor:
    return torch.tensor([values], dtype=torch.float64)


def at(phase: int, **values: Any) -> FlowState:
    """One environment in a phase, with the contact point CONTACT, that was where ``tip`` says."""
    given = {"contact_point": CONTACT, "standoff": OUT, "pull": OUT} | values
    state = FlowState.read(FlowState.initial((1,)).packed())
    made = {
        key: vector(*value) if isinstance(value, tuple) else torch.tensor([[value]]) for key, value in given.items()
    }
    return state.updated(phase=torch.tensor([[phase]]), **made)


def see(
    tip: tuple[float, ...] = (-0.3, 0.2, 0.5),
    hand: tuple[float, ...] = OUT,
    attached: bool = False,
    force: float = 0.0,
    phase: int = SELECT,
) -> Observed:
    """What is seen of a square door in the plane x = 0 that slides towards -x."""
    y, z = torch.meshgrid(torch.linspace(-0.4, 0.4, 15), torch.linspace(0.1, 0.9, 15), indexing="ij")
    points = torch.stack([torch.zeros_like(y), y, z], -1).reshape(1, -1, 3)
    everywhere = torch.ones(points.shape[:2], dtype=torch.bool)
    return Observed(
        phase=torch.tensor([[phase]]),
        tip=vector(*tip),
        hand=vector(*hand),
        attached=torch.tensor([[attached]]),
        force=vector(force),
        sense=vector(1.0),
        points=points,
        valid=everywhere,
        part=everywhere,
        flow=torch.tensor(OUT).expand_as(points),
        camera=torch.tensor([[-3.0, 0.0, 1.0]]),
    )


def test_select_chooses_a_point_of_the_part_and_none_near_a_failed_one() -> None:
    first = select(at(SELECT), see(), CONTROL)
    assert int(first.phase) == TRAVEL and int(first.chosen) == 1
    failed = at(SELECT).given_up(torch.tensor([[True]]), first.contact_point)
    second = select(failed, see(), CONTROL)
    assert float((second.contact_point - first.contact_point).norm()) >= OPTIONS.retry_distance
    assert float(second.contact_point[0, 0]) == 0.0


def test_of_failed_points_the_last_ones_are_remembered() -> None:
    state = at(SELECT)
    for k in range(TRIES + 1):
        state = state.given_up(torch.tensor([[True]]), vector(float(k), 0.0, 0.0))
    assert int(state.tries) == TRIES + 1
    assert sorted(state.tried[0, :, 0].tolist()) == [float(k) for k in range(1, TRIES + 1)]
    same = state.given_up(torch.tensor([[False]]), vector(9.0, 0.0, 0.0))
    assert torch.equal(same.tried, state.tried) and torch.equal(same.tries, state.tries)


@pytest.mark.parametrize(
    ("tip", "hand", "after"),
    [
        ((-0.2, 0.2, 0.5), OUT, APPROACH),
        ((-0.2, 0.2 + 0.9 * OPTIONS.line, 0.5), OUT, APPROACH),
        ((-0.2, 0.2 + 1.1 * OPTIONS.line, 0.5), OUT, TRAVEL),
        ((0.2, 0.2, 0.5), OUT, TRAVEL),
        ((-0.2, 0.2, 0.5), (-math.cos(0.2), math.sin(0.2), 0.0), TRAVEL),
    ],
    ids=["on the line", "near the line", "off the line", "behind the door", "turned away"],
)
def test_the_approach_begins_on_its_line(tip: tuple[float, ...], hand: tuple[float, ...], after: int) -> None:
    assert int(after_travel(at(TRAVEL), see(tip, hand), CONTROL).phase) == after


def test_a_hand_halted_on_its_way_goes_back_and_the_point_has_failed() -> None:
    tip = (-0.5, 0.9, 0.5)
    state = at(TRAVEL, tip=tip, idle=CONTROL.stuck, came=(0.0, 0.3, 0.0))
    after = after_travel(state, see(tip, force=100.0), CONTROL)
    assert int(after.phase) == RETREAT and int(after.tries) == 1
    assert torch.equal(after.tried[0, 0], torch.tensor(CONTACT)) and torch.equal(after.contact_point, vector(*tip))
    assert torch.allclose(after.leave, vector(0.0, 1.0, 0.0)), "as it came"
    free = after_travel(state, see(tip), CONTROL)
    assert int(free.phase) == TRAVEL and int(free.idle) == 0


@pytest.mark.parametrize(
    ("tip", "idle", "force", "attached", "after"),
    [
        ((-0.05, 0.2, 0.5), 0, 0.0, False, APPROACH),
        ((-0.05, 0.2, 0.5), CONTROL.patience, 100.0, False, RETREAT),
        ((-0.05, 0.2, 0.5), CONTROL.patience, 100.0, True, APPROACH),
        ((0.9 * OPTIONS.overshoot, 0.2, 0.5), 0, 0.0, False, APPROACH),
        ((1.1 * OPTIONS.overshoot, 0.2, 0.5), 0, 0.0, False, RETREAT),
    ],
    ids=["on its way", "pressed too long", "held", "not yet missed", "missed"],
)
def test_an_approach_fails(tip: tuple[float, ...], idle: int, force: float, attached: bool, after: int) -> None:
    state = after_approach(at(APPROACH, idle=idle), see(tip, attached=attached, force=force), CONTROL)
    assert int(state.phase) == after and int(state.tries) == (after == RETREAT)
    assert torch.equal(state.leave, vector(*OUT) if after == RETREAT else vector(0.0, 0.0, 0.0))


def test_a_pull_that_makes_no_progress_is_given_up_for_a_release() -> None:
    state = at(PULL, tip=(-0.1, 0.2, 0.5), idle=CONTROL.stuck)
    slow, fast = (see((-0.1 - share * CONTROL.still, 0.2, 0.5), attached=True) for share in (0.9, 1.1))
    after = after_pull(state, slow, CONTROL)
    assert int(after.phase) == RELEASE and int(after.idle) == 0 and int(after.tries) == 1
    assert abs(float(after.leave[0, 0])) < 1e-12, "across the flow"
    assert int(after_pull(state, fast, CONTROL).phase) == PULL
    once = Control(FlowPolicyOptions(retries=0), CONTROL.limits)
    assert int(after_pull(state.updated(chosen=torch.tensor([[1]])), slow, once).phase) == PULL, "no more retries"


def test_a_hand_that_holds_where_the_flow_is_small_lets_go_if_it_is_to_regrasp() -> None:
    seen = see((-0.12, 0.3, 0.5), attached=True)
    hinged = (0.4 - seen.points[..., 1:2]) / 0.8 * seen.flow  # 1 at the far edge, 0.125 where it holds
    seen, state = replace(seen, flow=hinged), at(PULL, tip=(-0.1, 0.3, 0.5))
    regrasps = Control(FlowPolicyOptions(regrasp=0.2), CONTROL.limits)
    after = after_pull(state, seen, regrasps)
    assert int(after.phase) == RELEASE and torch.equal(after.tried[:, 0], seen.tip.float())
    chosen = select(after, replace(seen, attached=torch.tensor([[False]])), regrasps)
    assert float(chosen.contact_point[0, 1]) < -0.2, "it tries where the lever is long"
    assert int(after_pull(state, seen, CONTROL).phase) == PULL, "not unless asked to"
    near = replace(seen, tip=vector(-0.12, -0.3, 0.5))
    assert int(after_pull(state.updated(tip=vector(-0.1, -0.3, 0.5)), near, regrasps).phase) == PULL, "it holds well"


def test_a_lost_hand_backs_off_from_where_it_is() -> None:
    seen = see((-0.4, 0.2, 0.5), (0.0, -1.0, 0.0))
    after = after_pull(at(PULL), seen, CONTROL)
    assert int(after.phase) == RETREAT
    assert torch.equal(after.contact_point, seen.tip) and torch.equal(after.standoff, seen.hand)
    assert torch.equal(after.leave, vector(*OUT)), "as it stood"


def test_a_retreat_ends_where_it_is_far_enough_or_halted() -> None:
    state = at(RETREAT, leave=OUT, tip=(-0.05, 0.2, 0.5), idle=CONTROL.stuck)
    for x, force, after in ((-0.09, 0.0, RETREAT), (-0.11, 0.0, SELECT), (-0.05, 100.0, SELECT)):
        assert int(after_retreat(state, see((x, 0.2, 0.5), force=force), CONTROL).phase) == after


def test_a_release_ends_once_the_hand_is_off_or_it_takes_too_long() -> None:
    for attached, idle, after in ((True, 0, RELEASE), (False, 0, RETREAT), (True, CONTROL.release, PULL)):
        assert int(after_release(at(RELEASE, idle=idle), see(attached=attached), CONTROL).phase) == after


def test_what_suction_holds_is_pulled_from_the_side_where_the_hand_is() -> None:
    sideways = (0.0, -1.0, 0.0)
    for phase, standoff in ((TRAVEL, sideways), (APPROACH, OUT), (RETREAT, sideways), (SELECT, sideways)):
        after = advance(at(phase), see(hand=sideways, attached=True, phase=phase), CONTROL)
        assert int(after.phase) == PULL and torch.equal(after.standoff, vector(*standoff))


def test_no_step_changes_the_state_that_it_is_given() -> None:
    for phase in range(6):
        state = at(phase, leave=OUT, idle=20)
        before = state.clone()
        for seen in (see(phase=phase), see(attached=True, force=100.0, phase=phase)):
            command(advance(state, seen, CONTROL), seen, CONTROL)
        assert (state == before).all()


def test_what_each_phase_commands() -> None:
    near, far = see((-0.05, 0.2, 0.5)), see((-0.8, 0.2, 0.5))
    assert torch.equal(wait(at(SELECT), near, CONTROL)[1], torch.zeros(1, 3))
    assert torch.allclose(approach(at(APPROACH), near, CONTROL)[1], -OPTIONS.touch_speed * vector(*OUT)), "guarded"
    assert torch.allclose(approach(at(APPROACH), far, CONTROL)[1], -OPTIONS.approach_speed * vector(*OUT))
    assert torch.equal(retreat(at(RETREAT, leave=OUT), near, CONTROL)[1], OPTIONS.approach_speed * vector(*OUT))
    assert torch.equal(release(at(RELEASE, leave=OUT), near, CONTROL)[1], 2.0 * vector(*OUT)), "as fast as it can"
    assert torch.allclose(pull(at(PULL), near, CONTROL)[1], OPTIONS.pull_speed * vector(*OUT), atol=1e-6)


def test_the_hand_turns_with_the_flow_once_it_pulls() -> None:
    seen, other = see((0.0, 0.2, 0.5)), (0.0, -1.0, 0.0)
    first, _ = pull(at(PULL, pull=other), seen, CONTROL)
    assert torch.equal(first.standoff, vector(*OUT)), "not in its first step"
    later, _ = pull(at(PULL, pull=other), see((0.0, 0.2, 0.5), phase=PULL), CONTROL)
    assert torch.allclose(later.standoff, vector(0.0, 1.0, 0.0), atol=1e-6), "a quarter turn, as from the flow before"
    assert torch.allclose(later.pull, vector(*OUT), atol=1e-6)


def test_the_hand_travels_straight_if_the_way_is_free_and_around_the_object_if_not() -> None:
    free = see((-0.8, 0.0, 0.5))
    _, velocity = travel(at(TRAVEL), free, CONTROL)
    goal = vector(*CONTACT) + vector(*OUT) * (OPTIONS.precontact + OPTIONS.funnel * 0.2)
    way = goal - free.tip
    assert torch.allclose(velocity / velocity.norm(), way / way.norm())
    behind = see((0.8, 0.0, 0.5))
    _, velocity = travel(at(TRAVEL), behind, CONTROL)
    across = torch.linalg.cross(behind.tip - vector(0.0, 0.0, 0.5), velocity)
    assert float(velocity.norm()) == pytest.approx(OPTIONS.travel_speed) and float(across.norm()) > 0.1
    assert bool(in_the_way(behind.points.double(), behind.valid, behind.tip, goal, OPTIONS.free))
    assert not bool(in_the_way(free.points.double(), free.valid, free.tip, goal, OPTIONS.free))
    hidden = torch.zeros_like(behind.valid)
    assert not bool(in_the_way(behind.points.double(), hidden, behind.tip, goal, OPTIONS.free)), (
        "padding is no obstacle"
    )


def test_across_the_flow_is_no_motion_along_it() -> None:
    flow = vector(*OUT).expand(2, 3)
    away = across_flow(torch.cat([vector(*OUT), vector(-0.6, 0.8, 0.0)]), flow)
    assert torch.allclose(away[:, 0], torch.zeros(2).double()) and torch.allclose(
        away.norm(dim=-1), torch.ones(2).double()
    )
    assert torch.allclose(away[1], vector(0.0, 1.0, 0.0)[0])


def test_environments_in_all_phases_at_once_are_those_one_by_one() -> None:
    states = [at(phase, leave=OUT, idle=k, tip=(-0.3, 0.1 * k, 0.5)) for k, phase in enumerate((3, 0, 5, 1, 4, 2, 3))]
    views = [see((-0.3, 0.1 * k, 0.5), attached=k == 0, phase=int(state.phase)) for k, state in enumerate(states)]
    names = [name for name in Observed.__dataclass_fields__ if name not in ("pull", "twist")]
    whole = {name: torch.cat([getattr(view, name) for view in views]) for name in names}
    state, seen = torch.cat(states), Observed(**whole)
    assert len(split_by_phase(state, seen)) == 6
    back = join([(rows, part) for _, rows, part, _ in split_by_phase(state, seen)])
    assert (back == state).all()
    after, velocity = command(advance(state, seen, CONTROL), seen, CONTROL)
    for k, (mine, view) in enumerate(zip(states, views, strict=True)):
        alone, speed = command(advance(mine, view, CONTROL), view, CONTROL)
        torch.testing.assert_close(velocity[k], speed[0], atol=1e-6, rtol=0)
        for key in ("phase", "idle", "tries", "chosen"):
            assert int(getattr(after, key)[k]) == int(getattr(alone, key)), key
        for key in ("contact_point", "standoff", "leave", "tip"):
            torch.testing.assert_close(getattr(after, key)[k], getattr(alone, key)[0], atol=1e-6, rtol=0)
