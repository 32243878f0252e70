"""Two clouds of an object from one view, between which one part has moved: what UMPNet's networks learn from."""

from __future__ import annotations

import numpy as np
import torch
from tensordict import TensorDict

from fb3d_rl.contract import GOAL_POINTS
from fb3d_rl.data.options import SampleOptions
from fb3d_rl.data.samples import SampleKind, blank_sample, flow_sample, turned
from fb3d_rl.scene.observer import TRIES, Cloud, observe
from fb3d_rl.scene.posed import Posed

UNMOVED = 0.2
"""Share of pairs whose part is in the same state in both: so it is at the start of an exploration."""


def draw_pair(posed: Posed, options: SampleOptions, rng: np.random.Generator) -> TensorDict | None:
    """Draw a pair of clouds of an object; None if no openable part is visible in :data:`TRIES` views.

    Returns:
        A sample whose points are the present cloud's, ``options.points``, and then those of the other image,
        GOAL_POINTS, which its "part_mask" marks. The flow is that of the target part in the present. Below "privileged"
        there are also "movable" [N], the present points of parts that can be opened, and "travel" [3], how far (rad or
        m) the part would have to open to be closed (at most 0), fully open (at least 0), and as in the other image.
    """
    movable, closed, opened = posed.obj.movable, posed.closed, posed.opened
    for _ in range(TRIES):
        link = int(rng.choice(posed.openable))
        joint, count = movable.index(link), len(closed)
        shares = np.where(rng.random(count) < options.others_closed, 0.0, rng.random(count))
        now = 0.0 if rng.random() < options.closed_share else rng.random()
        then = now if rng.random() < UNMOVED else rng.random()
        view, clouds = options.views.sample(rng), []
        for share, points in ((now, options.points), (then, GOAL_POINTS)):
            shares[joint] = share
            clouds.append(observe(posed, posed.poses(closed + shares * (opened - closed)), view, points, rng))
        if not clouds[0].shows(link):
            continue
        return turned(_pair(clouds[0], clouds[1], link, travel(posed, joint, now, then)), posed.camera.turn(view))
    return None


def travel(posed: Posed, joint: int, now: float, then: float) -> list[float]:
    """How far (rad or m) a joint, of which a share is open, would open to be closed, open, and as open as ``then``."""
    whole = float(abs(posed.opened[joint] - posed.closed[joint]))
    return [whole * (share - now) for share in (0.0, 1.0, then)]


def _pair(present: Cloud, other: Cloud, link: int, way: list[float]) -> TensorDict:
    posed = present.posed
    first, second = flow_sample(present, link), flow_sample(other, link)
    second["observation", "part_mask"] = second["observation", "valid"]
    first["observation", "part_mask"] = torch.zeros_like(first["observation", "valid"])
    second["privileged", "flow"] = torch.zeros_like(second["privileged", "flow"])
    sample: TensorDict = TensorDict(
        {
            group: {key: torch.cat([first[group, key], second[group, key]]) for key in first[group].keys()}
            for group in ("observation", "privileged")
        },
        batch_size=[],
    )
    sample["target"] = first["target"]
    parts = {below for openable in posed.openable for below in posed.obj.descendants(openable)}
    movable = np.isin(present.links, list(parts))
    sample["privileged", "movable"] = torch.from_numpy(np.concatenate([movable, np.zeros(GOAL_POINTS, dtype=bool)]))
    sample["privileged", "travel"] = torch.tensor(way)
    return sample


def blank_pair(points: int) -> TensorDict:
    """A pair of zeros, whose present cloud has so many points."""
    sample = blank_sample(points + GOAL_POINTS)
    sample["privileged", "movable"] = torch.zeros(points + GOAL_POINTS, dtype=torch.bool)
    sample["privileged", "travel"] = torch.zeros(3)
    return sample


PAIRS = SampleKind("pairs of clouds", draw_pair, blank_pair)
