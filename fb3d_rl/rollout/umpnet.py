"""Episodes in UMPNet's world: one point is chosen, held for good, and pulled again and again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase

from fb3d_rl.camera.umpnet import camera_pose
from fb3d_rl.camera.views import View, pixel_points, pixel_rays
from fb3d_rl.contract import GOAL_POINTS
from fb3d_rl.env.umpnet.options import UmpnetOptions
from fb3d_rl.env.umpnet.scenes import CAMERA, Placed
from fb3d_rl.env.umpnet.world import World, make_world
from fb3d_rl.flow.articulation_flow import articulation_flow
from fb3d_rl.perception.cloud import sample_cloud
from fb3d_rl.policies.pulling import FlowOf
from fb3d_rl.scene.observer import MIN_VISIBLE, Cloud

BUDGETS = {
    "Refrigerator": 12, "FoldingChair": 8, "Laptop": 12, "Stapler": 15, "TrashCan": 9, "Microwave": 8, "Toilet": 7,
    "Window": 6, "StorageFurniture": 9, "Switch": 7, "Kettle": 3, "Box": 10, "Phone": 12, "Dishwasher": 10, "Safe": 10,
    "Oven": 9, "WashingMachine": 9, "Table": 7, "KitchenPot": 3, "Bucket": 13, "Door": 10,
}  # fmt: skip
"""Pulls of an episode by category."""

VIEW = View(0.0, 0.0)
"""The camera stands still."""

GROUND = 0.005
"""Points below this height (m, UMPNet's world) are not seen: they are in the ground."""

DIFFERS = 1e-5
"""A pixel whose point differs from that of the goal image by more (m^2, UMPNet's world) belongs to what is to move."""

SUCCESS = 0.1
"""Normalized distance below which an episode is a success."""

MOVED = 0.01
"""A held point that a pull has moved by less (m of the object) has not been moved."""

ACROSS = 0.5
"""Cosine between a prediction and the last motion below which the prediction is not followed."""

NEIGHBORS = 16
"""Points around a held one that tell the surface's normal."""

STEPS_AWAY = 0.15
"""In exploration a state is novel if it is farther than this (rad, or m of the object) from the novel one before it."""

_Image = tuple[NDArray[np.float32], NDArray[np.int64]]


@cache
def _rays() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """T_world_camera [4, 4] and the rays [3, n * n] of UMPNet's camera; in each scene the same."""
    return camera_pose(), pixel_rays(camera_pose(), CAMERA.ticks)


@dataclass
class Episode:
    """One scene as it goes on.

    Attributes:
        placed: the scene.
        rng: draws the clouds; the same in each scene, as UMPNet seeds before each of them.
        goal: the goal image, None where there is none.
        goal_cloud: a cloud of it: points [GOAL_POINTS, 3] and their links, -1 on padding.
        memory: what the policy remembers.
        values: positions (rad or m of the object) of the held or selected joint: at the start and after each pull.
        right: the first point was on a part that may be moved; the selected one where there is a goal.
        link: the held link, -1 before there is one.
        reached: the goal was reached by UMPNet's rule, or in exploration the end of the range.
        sense: 1 to follow the flow, which opens, -1 to go against it.
        before: the point [3] that was held before the last pull, None before the first one.
        motion: unit direction [3] in which a pull last moved the held point, None if none has.
        stuck: how many pulls in succession have not moved it.
        went: UMPNet calls the joint moved by the last pull, or there was none yet.
        seen: what was seen at each decision and the policy's flow [N, 3] there, for films; None to keep none.
    """

    placed: Placed
    rng: np.random.Generator
    goal: _Image | None = None
    goal_cloud: tuple[NDArray[np.float32], NDArray[np.int64]] | None = None
    memory: TensorDict = field(default_factory=lambda: TensorDict({}, batch_size=[]))
    values: list[float] = field(default_factory=list)
    right: bool = False
    link: int = -1
    reached: bool = False
    sense: float = 1.0
    before: NDArray[np.float64] | None = None
    motion: NDArray[np.float64] | None = None
    stuck: int = 0
    went: bool = True
    seen: list[tuple[Seen, NDArray[np.float64]]] | None = None

    @property
    def joint(self) -> int:
        """Index in a joint state of the joint whose positions count."""
        placed = self.placed
        return placed.joint if self.link < 0 else placed.posed.obj.movable.index(self.link)

    @property
    def left(self) -> bool:
        """Whether another pull is to come."""
        budget = BUDGETS.get(self.placed.scene.category, 10)
        return self.right and not self.reached and len(self.values) <= budget

    def moved(self, position: float) -> None:
        """Take note of where a pull has brought the joint, by UMPNet's rules of what is moved and reached."""
        placed, joint = self.placed, self.joint
        obj, last = placed.posed.obj, self.values[-1]
        low, high = obj.limits[joint]
        prismatic = obj.joint_of(obj.movable[joint]).type == "prismatic"
        least = 0.05 / placed.scene.scale if prismatic else 0.1
        near, goal = min(least, (high - low) / 3.5), placed.goal[joint]
        self.values.append(position)
        self.went = abs(position - last) > least or abs(position - last) * 3.5 > high - low
        if placed.joint >= 0:
            crossed = (last > goal and position < goal + near) or (last < goal and position > goal - near)
            self.reached = bool(crossed or abs(position - goal) < near)
            return
        away = abs(position - goal) > near
        self.reached = bool(away and (position < low + near or position > high - near))
        if not self.went:
            self.sense = -self.sense  # it did not move that way

    @property
    def distance(self) -> float:
        """UMPNet's normalized distance: 0 once the goal was reached, 1 where the first point was wrong."""
        return 0.0 if self.reached else self.own_distance

    @property
    def own_distance(self) -> float:
        """Distance from the goal at the end over that at the start, without the rule that what is near is there."""
        if not self.right:
            return 1.0
        goal = self.placed.goal[self.joint]
        return float(abs(self.values[-1] - goal) / max(abs(self.values[0] - goal), 1e-9))

    @property
    def novelty(self) -> float:
        """Share of novel states among those after the pulls; 0 where the first point was wrong."""
        if len(self.values) < 2:
            return 0.0
        last, count = -np.inf, 0
        away = np.sort(np.abs(np.array(self.values[1:]) - self.values[0]))
        for value in away:
            if value - last > STEPS_AWAY:
                last, count = value, count + 1
        return count / len(away)


@dataclass(frozen=True)
class Seen:
    """What is seen of a scene: the policy's observation, and what it is in the scene.

    Attributes:
        frame: the contract's "observation" and "privileged" groups, the trial's "seed" and "elapsed_steps", [].
        points: [N, 3] the cloud in the scene's world, m.
        links: [N] the link of each point, -1 on padding.
    """

    frame: TensorDict
    points: NDArray[np.float32]
    links: NDArray[np.int64]


def look(episode: Episode, state: NDArray[np.float64], held: NDArray[np.float64] | None, options: UmpnetOptions,
         count: int, seed: int) -> Seen:  # fmt: skip
    """Take a picture of a scene in a joint state [J], and make a cloud of ``count`` points of it.

    The cloud stands on the ground for the policy: where UMPNet lets an object float or sink, it is moved up or down.
    """
    placed, (pose, rays) = episode.placed, _rays()
    posed, scale = placed.posed, placed.scene.scale
    poses = posed.poses(state)
    depth, bodies = image = posed.camera.depth_image(poses, VIEW)
    pixels, points = _seen_points(image, scale)
    told = np.zeros(len(pixels), dtype=bool)
    if episode.goal is not None and options.mask == "goal":
        told = _told(episode.goal, depth, pixels, rays, scale)
    marks = 2 * bodies.ravel()[pixels] + told
    cloud, marks = sample_cloud(points, marks, count, episode.rng)
    links = marks >> 1  # -1 on padding
    direction = posed.direction(placed.link) if placed.joint >= 0 else posed.direction(*placed.movable)
    truth = Cloud(posed, poses, cloud, links).with_truth(direction)
    mask = truth["part_mask"]
    if placed.joint >= 0 and options.mask == "goal":
        mask = torch.from_numpy((marks & 1).astype(bool)) & truth["valid"]
        mask = mask if mask.any() else truth["valid"]
    floor = np.array([0.0, 0.0, points[:, 2].min() if len(points) else 0.0])
    truth["points"] = torch.from_numpy((cloud - floor).astype(np.float32)) * truth["valid"][:, None]
    tip = np.zeros(3) if held is None else held - floor
    if episode.goal_cloud is not None:
        there, known = torch.from_numpy(episode.goal_cloud[0]), torch.from_numpy(episode.goal_cloud[1] >= 0)
        shown = {"points": (there - torch.from_numpy(floor).float()) * known[:, None], "valid": known}
    else:
        shown = {}
    frame = TensorDict(
        {
            "observation": {
                "points": truth["points"], "valid": truth["valid"], "part_mask": mask,
                "tool_pose": torch.tensor([*tip, 1.0, 0.0, 0.0, 0.0], dtype=torch.float32),
                "attached": torch.tensor([held is not None]), "goal_sense": torch.tensor([episode.sense]).float(),
                "camera_position": torch.from_numpy(pose[:3, 3] - floor).float(),
                "qpos": torch.zeros(8), "qvel": torch.zeros(8), "contact_force": torch.zeros(1),
            },
            "privileged": {"flow": truth["flow"], "link": truth["link"]},
            "seed": torch.tensor([seed]), "elapsed_steps": torch.tensor([len(episode.values)]),
            "pull": {"moved": torch.tensor([episode.went])}, **({"goal": shown} if shown else {}),
        },
        batch_size=[],
    )  # fmt: skip
    frame.update(episode.memory)
    return Seen(frame, cloud, links)


def _seen_points(image: _Image, scale: float) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The pixels [P] in which an image shows the object above the ground, and their world points [P, 3]."""
    pixels = np.flatnonzero(image[1] >= 0)
    points = pixel_points(*_rays(), pixels, image[0].ravel()[pixels])
    above = points[:, 2] > GROUND / scale
    return pixels[above], points[above]


def _told(
    goal: _Image, depth: NDArray[np.float32], pixels: NDArray[np.int64], rays: NDArray[np.float64], scale: float
) -> NDArray[np.bool_]:
    """Whether pixels [P] differ from the goal image: what has gone from them there, unless that is too little.

    Where something farther away is seen in the goal image, what is here now has to move. Where something nearer is,
    it may only be hidden there; such pixels count where there are too few others.
    """
    now, then = depth.ravel()[pixels].astype(np.float64), goal[0].ravel()[pixels].astype(np.float64)
    then[goal[1].ravel()[pixels] < 0] = np.inf
    differs = ((then - now) * np.linalg.norm(rays[:, pixels], axis=0) * scale) ** 2 > DIFFERS
    gone = differs & (then > now)
    return gone if gone.sum() >= 4 * MIN_VISIBLE else differs


def _true_way(episode: Episode, state: NDArray[np.float64], held: NDArray[np.float64]) -> NDArray[np.float64]:
    """The direction [3] in which the held point opens, for a policy that follows the true flow."""
    posed = episode.placed.posed
    point, link = torch.from_numpy(held)[None], torch.tensor([episode.link])
    poses = torch.from_numpy(posed.poses(state))
    return np.asarray(articulation_flow(posed.tree, point, link, poses, posed.direction(episode.link))[0].numpy())


@torch.no_grad()
def run_episodes(
    placed: Sequence[Placed], flow_of: FlowOf, options: UmpnetOptions, points: int, seed: int, expert: bool = False,
    learn: bool = False, keep: bool = False,
) -> list[Episode]:  # fmt: skip
    """Run scenes side by side with one policy.

    Args:
        placed: the scenes.
        flow_of: what gives the flow that the policy follows.
        options: the world's options.
        points: N of a cloud.
        seed: of each scene.
        expert: the flow is the truth, also at a held point that is hidden.
        learn: whether what pulls do corrects the flow (:func:`_learned`).
        keep: whether episodes keep what is seen.

    Raises:
        UserError: the world cannot be made, or the policy follows no flow.
    """
    episodes = [Episode(one, np.random.default_rng(seed), memory=flow_of.state.clone()) for one in placed]
    for episode in episodes:
        episode.seen = [] if keep else None
    world = make_world(options.backend, placed)
    try:
        for episode in episodes:
            posed = episode.placed.posed
            if episode.placed.joint >= 0:
                episode.goal = posed.camera.depth_image(posed.poses(episode.placed.goal), VIEW)
                episode.sense = 1.0 if episode.placed.towards_open else -1.0
                episode.goal_cloud = _goal_cloud(episode.goal, episode.placed.scene.scale, seed)
        _take_hold(world, episodes, flow_of, options, points, seed)
        while any(episode.left for episode in episodes):
            _pull(world, episodes, flow_of, options, points, seed, expert, learn)
    finally:
        world.close()
    return episodes


def _goal_cloud(goal: _Image, scale: float, seed: int) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Drawn by a generator of its own, so that the other clouds of a scene are the same for all policies."""
    pixels, points = _seen_points(goal, scale)
    return sample_cloud(points, goal[1].ravel()[pixels], GOAL_POINTS, np.random.default_rng([seed, 1]))


def _decide(episodes: Sequence[Episode], seen: Sequence[Seen], flow_of: FlowOf) -> NDArray[np.float64]:
    """Flows [B, N, 3] of a policy for what is seen of B scenes, which keep what it remembers."""
    frames: TensorDictBase = torch.stack([one.frame for one in seen])
    flow = flow_of(frames).double()
    for group in flow_of.state.keys():
        for episode, after in zip(episodes, frames["next", group].unbind(0), strict=True):
            episode.memory[group] = after.clone()
    flows: NDArray[np.float64] = flow.masked_fill(~frames["observation", "valid"][..., None], 0.0).numpy()
    for episode, one, answer in zip(episodes, seen, flows, strict=True):
        if episode.seen is not None:
            episode.seen.append((one, answer))
    return flows


def chosen_point(seen: Seen, flow: NDArray[np.float64]) -> int:
    """Number of the point that is held: that of the largest flow of those that the policy is told are the part's."""
    mask = seen.frame["observation", "part_mask"].numpy()
    return int((np.linalg.norm(flow, axis=1) * mask).argmax())


def _take_hold(
    world: World, episodes: Sequence[Episode], flow_of: FlowOf, options: UmpnetOptions, points: int, seed: int
) -> None:
    """Hold each part where its flow is largest; a point elsewhere ends the episode."""
    states = world.states
    seen = [look(episode, states[k], None, options, points, seed) for k, episode in enumerate(episodes)]
    for k, (episode, one, flow) in enumerate(zip(episodes, seen, _decide(episodes, seen, flow_of), strict=True)):
        chosen = chosen_point(one, flow)
        link = int(one.links[chosen])
        wanted = (episode.placed.link,) if episode.placed.joint >= 0 else episode.placed.movable
        episode.right = link in wanted
        if episode.right:
            episode.link = link
            world.touch(k, link, one.points[chosen].astype(np.float64))
        episode.values.append(float(states[k][episode.joint]) if episode.joint >= 0 else 0.0)


def _pull(
    world: World, episodes: Sequence[Episode], flow_of: FlowOf, options: UmpnetOptions, points: int, seed: int,
    expert: bool, learn: bool,
) -> None:  # fmt: skip
    """One pull of each scene that goes on, along the flow at the held point or against it."""
    states, directions = world.states, np.zeros((len(episodes), 3))
    going = [k for k, episode in enumerate(episodes) if episode.left]
    held = {k: world.held(k) for k in going}
    if expert:
        ways = [episodes[k].sense * _true_way(episodes[k], states[k], held[k]) for k in going]
    else:
        seen = [look(episodes[k], states[k], held[k], options, points, seed) for k in going]
        flows = _decide([episodes[k] for k in going], seen, flow_of)
        ways = [_at_held(one, flow, held[k]) for k, one, flow in zip(going, seen, flows, strict=True)]
        ways = [episodes[k].sense * way for k, way in zip(going, ways, strict=True)]
        if learn:
            ways = [_learned(episodes[k], held[k], way, one) for k, way, one in zip(going, ways, seen, strict=True)]
    for k, way in zip(going, ways, strict=True):
        directions[k] = way / max(float(np.linalg.norm(way)), 1e-9)
    world.pull(directions)
    for k, state in enumerate(world.states):
        if k in held:
            episodes[k].moved(float(state[episodes[k].joint]))


def _learned(episode: Episode, held: NDArray[np.float64], way: NDArray[np.float64], seen: Seen) -> NDArray[np.float64]:
    """The direction [3] to pull in by a predicted ``way`` [3] and by what the pulls so far have done.

    A part that moves goes on as it did: the prediction is turned over where it says the opposite, and left where it is
    across. One that has stopped is pulled as it moved, then back. One that has never moved is tried along the surface's
    normal, against the prediction, and across both.
    """
    if episode.before is not None:
        moved = held - episode.before
        still = float(np.linalg.norm(moved)) < MOVED
        episode.stuck = episode.stuck + 1 if still else 0
        episode.motion = episode.motion if still else moved / np.linalg.norm(moved)
    episode.before, motion = held, episode.motion
    way = way / max(float(np.linalg.norm(way)), 1e-9)
    if motion is None:
        normal = seen_normal(seen, held)
        across = np.cross(way, normal)
        tries = (way, episode.sense * normal, -way, across, -across)
        return tries[episode.stuck % len(tries)]
    onward = float(way @ motion)
    along = motion if abs(onward) < ACROSS else way * np.sign(onward)
    return (along, motion, -motion)[episode.stuck % 3]


def seen_normal(seen: Seen, held: NDArray[np.float64]) -> NDArray[np.float64]:
    """The unit normal [3] of the seen surface around a point, towards the camera."""
    points = seen.points[seen.links >= 0].astype(np.float64)
    near = points[np.linalg.norm(points - held, axis=1).argsort()[:NEIGHBORS]]
    normal = np.linalg.svd(near - near.mean(0))[2][-1]
    return np.asarray(normal * np.sign((_rays()[0][:3, 3] - held) @ normal))


def _at_held(seen: Seen, flow: NDArray[np.float64], held: NDArray[np.float64]) -> NDArray[np.float64]:
    """The flow at the point of the cloud nearest to the held one, of those that the policy is told are the part's."""
    mask = seen.frame["observation", "part_mask"].numpy() & (np.linalg.norm(flow, axis=1) > 0)
    if not mask.any():
        return np.zeros(3)
    away = np.linalg.norm(seen.points - held, axis=1)
    return np.asarray(flow[np.where(mask, away, np.inf).argmin()])
