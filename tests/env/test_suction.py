"""Suction holds what the fingers touch, only movable parts, and can be lost and found again."""

from __future__ import annotations

import math

import pytest
import torch

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.env.options import EnvOptions, SuctionOptions
from fb3d_rl.env.task import OpenArticulatedEnv

from .conftest import POINTS, links_called, place_before, start, step_until, velocity


@pytest.mark.parametrize("category", ["StorageFurniture", "Table"])
def test_a_held_drawer_is_pulled_open(
    env: OpenArticulatedEnv, objects: dict[str, ArticulatedObject], category: str
) -> None:
    drawer = links_called(objects[category], "drawer")[0]
    place_before(env, drawer, start(env, objects[category], drawer))
    held, _ = step_until(env, velocity(x=0.3), lambda: env.stages[0].suction.attached)
    assert held
    opened, (obs, reward, terminated, truncated, info) = step_until(
        env, velocity(x=-0.4), lambda: bool(env.evaluate()["success"])
    )
    assert opened and bool(terminated) and not bool(truncated)
    assert bool(info["contact"]) and bool(obs["observation"]["attached"])
    assert float(info["normalized_distance"]) < env.options.success
    assert float(reward) > 1 - env.options.success


def test_pulling_without_touch_moves_nothing(env: OpenArticulatedEnv, objects: dict[str, ArticulatedObject]) -> None:
    drawer = links_called(objects["Table"], "drawer")[0]
    place_before(env, drawer, start(env, objects["Table"], drawer))
    for _ in range(20):
        *_, info = env.step(velocity(x=-0.4))
    assert float(info["normalized_distance"]) == pytest.approx(1.0, abs=1e-5)
    assert not bool(info["contact"])


def test_engaging_does_not_throw_the_hand(env: OpenArticulatedEnv, objects: dict[str, ArticulatedObject]) -> None:
    drawer = links_called(objects["Table"], "drawer")[0]
    place_before(env, drawer, start(env, objects["Table"], drawer))
    held, _ = step_until(env, velocity(x=0.2), lambda: env.stages[0].suction.attached)
    assert held and env.stages[0].suction.stretch < 0.01
    before = env.agent.tool_pose()
    for _ in range(5):
        obs, *_ = env.step(velocity())
    assert float((obs["observation"]["tool_pose"] - before)[:, :3].norm()) < 0.01
    assert float(obs["observation"]["qvel"].norm()) < 0.01


@pytest.mark.parametrize("hold", ["target", "any"])
def test_other_movable_parts_are_held_only_if_asked(objects: dict[str, ArticulatedObject], hold: str) -> None:
    obj = objects["Table"]
    target, other = links_called(obj, "drawer")[:2]
    env = OpenArticulatedEnv([obj], EnvOptions(points=POINTS, suction=SuctionOptions(hold=hold)))
    place_before(env, other, start(env, obj, target))
    held, (*_, info) = step_until(env, velocity(x=0.3), lambda: env.stages[0].suction.attached, limit=20)
    assert held == (hold == "any")
    assert not bool(info["contact"]), "another part is not the one to open"


def test_another_part_that_was_held_and_opened_is_told_from_the_target(objects: dict[str, ArticulatedObject]) -> None:
    obj = objects["Table"]
    target, other = links_called(obj, "drawer")[:2]
    env = OpenArticulatedEnv([obj], EnvOptions(points=POINTS, suction=SuctionOptions(hold="any")))
    place_before(env, other, start(env, obj, target))
    step_until(env, velocity(x=0.3), lambda: env.stages[0].suction.attached, limit=20)
    assert not bool(env.evaluate()["held_opened"]), "it is not open yet"
    opened, (*_, terminated, _, info) = step_until(
        env, velocity(x=-0.4), lambda: bool(env.evaluate()["held_opened"]), limit=60
    )
    assert opened and not bool(terminated) and not bool(info["success"]) and not bool(info["contact"])
    assert float(info["normalized_distance"]) == pytest.approx(1.0, abs=1e-3)
    state = env.get_state()
    env.stages[0].suction.release()
    assert bool(env.step(velocity())[-1]["held_opened"]), "it was held before"
    start(env, obj, target)
    assert not bool(env.evaluate()["held_opened"]), "another episode"
    env.set_state(state)
    assert bool(env.evaluate()["held_opened"]), "a restored state knows what was held"


def test_the_target_s_opening_is_that_of_what_is_held_even_by_a_part_on_it(
    env: OpenArticulatedEnv, objects: dict[str, ArticulatedObject]
) -> None:
    drawer = links_called(objects["Table"], "drawer")[0]
    place_before(env, drawer, start(env, objects["Table"], drawer))
    step_until(env, velocity(x=0.3), lambda: env.stages[0].suction.attached)
    opened, (*_, info) = step_until(env, velocity(x=-0.4), lambda: bool(env.evaluate()["success"]))
    assert opened and bool(info["held_opened"])


def test_the_static_body_is_never_held(objects: dict[str, ArticulatedObject]) -> None:
    obj = objects["StorageFurniture"]
    env = OpenArticulatedEnv([obj], EnvOptions(points=POINTS, suction=SuctionOptions(hold="any")))
    obs = start(env, obj, links_called(obj, "drawer")[0])
    cloud, link = obs["observation"]["points"][0], obs["privileged"]["link"][0]
    static = torch.tensor([i for i in range(len(obj.links)) if not env.stages[0].tree.descendants[:, i].any()])
    # From above onto the highest point of the body, the hand turned so that the tool points down.
    body = cloud[torch.isin(link, static)]
    top = body[body[:, 2].argmax()]
    env.agent.robot.set_qpos(torch.tensor([[*top[:2], top[2] + 0.22, 0.0, math.pi / 2, 0.0, 0.0, 0.0]]))
    touched, (obs, *_, info) = step_until(
        env, velocity(z=-0.2), lambda: float(env.get_obs()["observation"]["contact_force"]) > 50.0, limit=30
    )
    assert touched
    for _ in range(5):
        obs, *_, info = env.step(velocity(z=-0.05))
    assert not bool(obs["observation"]["attached"]) and not bool(info["contact"])


def test_suction_breaks_and_is_found_again(objects: dict[str, ArticulatedObject]) -> None:
    obj = objects["Table"]
    drawer = links_called(obj, "drawer")[0]
    env = OpenArticulatedEnv([obj], EnvOptions(points=POINTS, suction=SuctionOptions(breaking_force=40.0)))
    place_before(env, drawer, start(env, obj, drawer))
    held, _ = step_until(env, velocity(x=0.1), lambda: env.stages[0].suction.attached)
    assert held
    lost, (*_, info) = step_until(env, velocity(x=-0.8), lambda: not env.stages[0].suction.attached, limit=20)
    assert lost and bool(info["contact"])
    for _ in range(10):
        env.step(velocity(x=-0.2))
    assert not env.stages[0].suction.attached
    found, _ = step_until(env, velocity(x=0.1), lambda: env.stages[0].suction.attached)
    assert found


def test_contact_stays_on_while_a_part_is_held(env: OpenArticulatedEnv, objects: dict[str, ArticulatedObject]) -> None:
    """The physics engine ignores contact between two bodies that a spring joins: no finger may be one of them."""
    obj = objects["StorageFurniture"]  # starts closed: the drawer cannot give way
    drawer = links_called(obj, "drawer")[0]
    place_before(env, drawer, start(env, obj, drawer))
    held, _ = step_until(env, velocity(x=0.2), lambda: env.stages[0].suction.attached)
    assert held
    before = env.agent.tool_pose()
    for _ in range(10):
        obs, *_ = env.step(velocity(x=0.1))
    assert float(obs["observation"]["contact_force"]) > 100.0
    assert float((obs["observation"]["tool_pose"] - before)[0, 0]) < 0.03


def test_impulses_tell_touch_and_force_like_points(
    env: OpenArticulatedEnv, objects: dict[str, ArticulatedObject]
) -> None:
    """CUDA has no contact points; on the CPU both readers can look at the same physics step."""
    obj = objects["Table"]
    drawer = links_called(obj, "drawer")[0]
    place_before(env, drawer, start(env, obj, drawer))
    stage, reader = env.stages[0], env.contact_impulses()
    seen = []

    def both() -> None:
        by_points, (by_impulses,) = stage.suction.contacts(), reader.read()
        torch.testing.assert_close(by_impulses.impulse, by_points.impulse, atol=1e-6, rtol=1e-5)
        if by_impulses.touches:
            seen.append(set(by_impulses.touches))
            assert seen[-1] <= set(by_points.touches)
            (tip,) = by_impulses.touches[min(seen[-1])]
            assert min(abs(tip - point).max() for point in by_points.touches[min(seen[-1])]) < 0.03
        stage.suction.update(by_impulses)

    env._after_simulation_step = both  # type: ignore[method-assign]
    try:
        held, _ = step_until(env, velocity(x=0.2), lambda: stage.suction.attached)
    finally:
        del env._after_simulation_step
    assert held and seen and stage.suction.held in seen[0]


def test_the_hand_can_tear_itself_off_across_the_way_of_the_part(
    env: OpenArticulatedEnv, objects: dict[str, ArticulatedObject]
) -> None:
    drawer = links_called(objects["Table"], "drawer")[0]
    place_before(env, drawer, start(env, objects["Table"], drawer))
    step_until(env, velocity(x=0.2), lambda: env.stages[0].suction.attached)
    for _ in range(3):
        env.step(velocity(x=-0.8))
    assert env.stages[0].suction.attached, "the drawer comes along"
    torn, _ = step_until(env, velocity(y=2.0), lambda: not env.stages[0].suction.attached, limit=10)
    assert torn
