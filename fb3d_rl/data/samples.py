"""One flow sample: a random object, joint state and viewpoint, seen by the depth camera, with its true flow."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict

from fb3d_rl.data.options import SampleOptions
from fb3d_rl.scene.observer import TRIES, Cloud, observe
from fb3d_rl.scene.posed import Posed


def flow_sample(cloud: Cloud, *targets: int, masked: bool = True) -> TensorDict:
    """The sample (contract group "sample") of a cloud whose targets are these links, or all movable parts.

    Its "target" is the link if it is one, else -1. If it is not ``masked``, the mask marks every point.
    """
    truth = cloud.with_truth(cloud.posed.direction(*targets))
    if not masked:
        truth["part_mask"] = truth["valid"]
    return TensorDict(
        {
            "observation": {key: truth[key] for key in ("points", "valid", "part_mask")},
            "privileged": {"flow": truth["flow"], "link": truth["link"].to(torch.int16)},
            "target": torch.tensor(targets[0] if len(targets) == 1 else -1),
        },
        batch_size=[],
    )


def draw_sample(posed: Posed, options: SampleOptions, rng: np.random.Generator) -> TensorDict | None:
    """Draw one sample of an object; None if no openable part is visible in :data:`TRIES` views."""
    movable, closed, opened = posed.obj.movable, posed.closed, posed.opened
    for _ in range(TRIES):
        link = int(rng.choice(posed.openable))
        qpos = np.where(rng.random(len(closed)) < options.others_closed, 0.0, rng.random(len(closed)))
        qpos[movable.index(link)] = 0.0 if rng.random() < options.closed_share else rng.random()
        poses = posed.poses(closed + qpos * (opened - closed))
        view = options.views.sample(rng)
        cloud = observe(posed, poses, view, options.points, rng)
        share = rng.random()
        if cloud.shows(link):
            masked = share < 1.0 - options.unmasked_share
            targets: tuple[int, ...] = (link,) if masked and share >= options.all_parts_share else ()
            if targets and share < options.all_parts_share + options.some_parts_share:
                targets += tuple(other for other in movable if other != link and rng.random() < 0.5)
            return turned(flow_sample(cloud, *targets, masked=masked), posed.camera.turn(view))
    return None


def turned(sample: TensorDict, turn: NDArray[np.float64] | None) -> TensorDict:
    """A sample whose points and flow are turned by R [3, 3]."""
    if turn is not None:
        rotation = torch.from_numpy(turn).float()
        for key in (("observation", "points"), ("privileged", "flow")):
            sample[key] = sample[key] @ rotation.T
    return sample


def blank_sample(points: int) -> TensorDict:
    """A sample of zeros, of so many points."""
    return TensorDict(
        {
            "observation": {
                "points": torch.zeros(points, 3),
                "valid": torch.zeros(points, dtype=torch.bool),
                "part_mask": torch.zeros(points, dtype=torch.bool),
            },
            "privileged": {"flow": torch.zeros(points, 3), "link": torch.zeros(points, dtype=torch.int16)},
            "target": torch.zeros((), dtype=torch.int64),
        },
        batch_size=[],
    )


@dataclass(frozen=True)
class SampleKind:
    """What the rows of a data set are.

    Attributes:
        name: by which data sets are told apart, a plural.
        draw: draws a sample of an object; None if none of its parts is visible.
        blank: a sample of zeros, of a cloud of so many points.
    """

    name: str
    draw: Callable[[Posed, SampleOptions, np.random.Generator], TensorDict | None]
    blank: Callable[[int], TensorDict]


FLOWS = SampleKind("flow samples", draw_sample, blank_sample)
"""The kind that flow networks learn from."""
