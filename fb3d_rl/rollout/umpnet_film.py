"""A film of an episode in UMPNet's world: the same episode again, with pictures between its pulls.

The hand has no shape there. It is drawn where the point is held, along the surface's normal, as UMPNet turns its cup.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fb3d_rl.assets.gripper import TIP, gripper_meshes
from fb3d_rl.camera.views import View
from fb3d_rl.env.umpnet.options import UmpnetOptions
from fb3d_rl.env.umpnet.scenes import Placed
from fb3d_rl.policies.pulling import FlowOf
from fb3d_rl.rollout.film import Film
from fb3d_rl.rollout.umpnet import Episode, Seen, chosen_point, look, run_episodes, seen_normal

PICTURES = 8
"""Pictures of each pull; the film shows a pull in a second."""

BEFORE = 0.3
"""How far (m) in front of the point the hand is drawn before it holds it."""

VIEW = View(0.0, 40.0)
"""About where UMPNet's camera is."""

Array = NDArray[np.float64]


def film_scene(
    name: str, placed: Placed, flow_of: FlowOf, options: UmpnetOptions, points: int, seed: int, expert: bool,
    learn: bool, near: float,
) -> Film:  # fmt: skip
    """Run a scene again and film it.

    Args:
        name: the policy's.
        placed: the scene.
        flow_of: as of :func:`~fb3d_rl.rollout.umpnet.run_episodes`, and so the next five.
        options: see there.
        points: see there.
        seed: see there.
        expert: see there.
        learn: see there.
        near: normalized distance below which the episode is a success.
    """
    episode = run_episodes([placed], flow_of, options, points, seed, expert, learn, keep=True)[0]
    posed, held_joint = placed.posed, episode.joint
    seen = _seen(episode, options, points, seed)
    start, flow = seen[0]
    chosen = chosen_point(start, flow)
    touched, link = start.points[chosen].astype(np.float64), int(start.links[chosen])
    tip = _hand(touched, -seen_normal(start, touched))
    # Before the touch, then the touch, then PICTURES of each pull.
    shares = np.linspace(0.0, 1.0, PICTURES + 1)[1:]
    values = [episode.values[0]] * PICTURES
    for last, value in zip(episode.values[:-1], episode.values[1:], strict=True):
        values += (last + shares * (value - last)).tolist()
    poses: list[Array] = []
    clouds: list[tuple[Array, NDArray[np.bool_], Array]] = []
    first = posed.poses(placed.start)
    for number, value in enumerate(values):
        now = _poses(placed, held_joint, value)
        decision = min(number // PICTURES, len(seen) - 1)
        begun = _poses(placed, held_joint, episode.values[max(decision - 1, 0)])
        carried = now[link] @ np.linalg.inv(begun[link]) if link >= 0 else np.eye(4)
        cloud, answer = seen[decision]
        part = cloud.frame["observation", "part_mask"].numpy()
        moved = np.where(part[:, None], _moved(carried, cloud.points), cloud.points)
        clouds.append((moved, part, answer @ carried[:3, :3].T))
        hand = now[link] @ np.linalg.inv(first[link]) @ tip if link >= 0 else tip
        if number < PICTURES or not episode.right:
            away = BEFORE * max(0.0, 1.0 - number / max(PICTURES - 1, 1))
            hand = hand @ _shift(-away)
        poses.append(np.concatenate([now, np.tile(hand, (3, 1, 1))]))
    attached = np.arange(len(values)) >= (PICTURES - 1 if episode.right else len(values))
    made, (shown, parts, flows) = np.stack(poses), map(np.stack, zip(*clouds, strict=True))
    return Film(
        policy=name, obj=posed.obj, link=max(episode.link if placed.joint < 0 else placed.link, 0), view=VIEW,
        gripper=gripper_meshes(), poses=made, tips=(made[:, -1] @ [TIP, 0, 0, 1])[:, :3].astype(np.float32),
        points=shown.astype(np.float32), part=parts, flow=flows.astype(np.float32), attached=attached,
        distance=_distances(episode, np.array(values)).astype(np.float32),
        success=episode.reached if placed.joint < 0 else episode.distance < near, rate=PICTURES, per_step=PICTURES,
        aim=("of its range", "end of the range") if placed.joint < 0 else ("of the way", "goal"),
    )  # fmt: skip


def _seen(episode: Episode, options: UmpnetOptions, points: int, seed: int) -> list[tuple[Seen, Array]]:
    """What is seen at the touch and before each pull, with the policy's flow there.

    The expert looks only once; where it pulls it has the true flow.
    """
    assert episode.seen is not None
    kept = list(episode.seen)
    spare = replace(episode, rng=np.random.default_rng(seed), seen=None)
    for value in episode.values[len(kept) - 1 : -1]:
        state = _state(episode.placed, episode.joint, value)
        one = look(spare, state, None, options, points, seed)
        kept.append((one, one.frame["privileged", "flow"].double().numpy()))
    return kept


def _state(placed: Placed, joint: int, value: float) -> Array:
    state = placed.start.copy()
    if joint >= 0:
        state[joint] = value
    return state


def _poses(placed: Placed, joint: int, value: float) -> Array:
    return placed.posed.poses(_state(placed, joint, value))


def _distances(episode: Episode, values: Array) -> Array:
    """Normalized distance at the positions [T]; in exploration 1 less the share of its range that it has moved."""
    placed, joint = episode.placed, episode.joint
    if not episode.right:
        return np.ones(len(values))
    if placed.joint < 0:
        low, high = placed.posed.obj.limits[joint]
        return np.asarray(1.0 - np.abs(values - values[0]) / (high - low))
    goal = placed.goal[joint]
    return np.asarray(np.abs(values - goal) / max(abs(values[0] - goal), 1e-9))


def _hand(point: Array, axis: Array) -> Array:
    """T_world_hand [4, 4] of a hand along a unit axis [3] whose tip is at a point [3]."""
    across = np.cross(np.eye(3)[np.abs(axis).argmin()], axis)
    across /= np.linalg.norm(across)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.stack([axis, across, np.cross(axis, across)], axis=1), point - TIP * axis
    return pose


def _shift(along: float) -> Array:
    made = np.eye(4)
    made[0, 3] = along
    return made


def _moved(pose: Array, points: NDArray[np.float32]) -> Array:
    return np.asarray(points @ pose[:3, :3].T + pose[:3, 3])
