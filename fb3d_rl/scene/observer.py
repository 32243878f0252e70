"""Observation of an object: the cloud that policies get, its ground truth, and whether a part counts as visible."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from fb3d_rl.camera.views import View, ViewRange
from fb3d_rl.flow.articulation_flow import articulation_flow, normalize_flow
from fb3d_rl.perception.cloud import sample_cloud
from fb3d_rl.scene.posed import Posed

MIN_VISIBLE = 20
"""A part with fewer points counts as not visible."""

TRIES = 8
"""Largest number of views that are drawn until one shows the part to open."""


@dataclass(frozen=True, eq=False)
class Cloud:
    """N points on the surface of an object, and which link each lies on.

    Attributes:
        posed: the object.
        poses: T_world_link [L, 4, 4] of its links.
        points: [N, 3] float32, m, world; 0 on padding.
        links: [N] int64, the link of each point; -1 on padding.
    """

    posed: Posed
    poses: NDArray[np.float64]
    points: NDArray[np.float32]
    links: NDArray[np.int64]

    def shows(self, link: int) -> bool:
        """Whether the part of this link, with all that it carries, is visible."""
        return visible(self.links, self.posed.obj.descendants(link))

    def with_truth(self, direction: Tensor) -> dict[str, Tensor]:
        """The cloud with its ground truth.

        Args:
            direction: [J] float64 of :meth:`~fb3d_rl.scene.posed.Posed.direction`: signs of the moving joints, else 0.

        Returns:
            "points" [N, 3] float32, "valid" [N] (False on padding), "part_mask" [N] (on what these joints move),
            "flow" [N, 3] float32 (largest norm 1, 0 on what does not move) and "link" [N] int64 (-1 on padding).
        """
        tree, link, points = self.posed.tree, torch.from_numpy(self.links), torch.from_numpy(self.points)
        valid = link >= 0
        moved = tree.descendants[direction != 0].any(0)
        flow = articulation_flow(tree, points, link, torch.from_numpy(self.poses), direction)
        return {
            "points": points,
            "valid": valid,
            "part_mask": moved[link.clamp_min(0)] & valid,
            "flow": normalize_flow(flow),
            "link": link,
        }


def observe(
    posed: Posed,
    poses: NDArray[np.float64],
    view: View,
    count: int,
    rng: np.random.Generator,
    seen: tuple[NDArray[np.float64], NDArray[np.int64]] | None = None,
) -> Cloud:
    """The cloud of exactly ``count`` points that a camera sees of an object.

    Args:
        posed: the object.
        poses: T_world_body [L + bodies, 4, 4] of its links and of the further bodies.
        view: the camera's viewpoint.
        count: N.
        rng: draws which of the picture's points make the cloud.
        seen: points [P, 3] (m, world) of the object and their links [P], where another camera than the object's own
            has taken the picture.
    """
    if seen is None:
        seen = posed.camera.capture(poses, view, further=False)
    points, links = sample_cloud(*seen, count, rng)
    return Cloud(posed, poses[: len(posed.obj.links)], points, links)


def visible(links: NDArray[np.int64], part: Collection[int]) -> bool:
    """Whether enough points lie on a part.

    Args:
        links: [P], the link of each point.
        part: the links of the part.
    """
    return int(np.isin(links, list(part)).sum()) >= MIN_VISIBLE


def find_view(
    posed: Posed,
    link: int,
    state: Sequence[float] | NDArray[np.float64],
    views: ViewRange,
    rng: np.random.Generator,
    count: int | None,
) -> tuple[View, bool]:
    """Draw views until one shows a part, :data:`TRIES` at most.

    Args:
        posed: the object.
        link: the part's link.
        state: joint state [J] (rad or m).
        views: the range of the views.
        rng: draws views and clouds.
        count: points of the cloud in which the part has to be visible; None for all points of the picture.

    Returns:
        The view that was drawn last, and whether it shows the part.
    """
    poses, part = posed.poses_alone(state), posed.obj.descendants(link)
    for _ in range(TRIES):
        view = views.sample(rng)
        if count is None:
            _, links = posed.camera.capture(poses, view)
        else:
            links = observe(posed, poses, view, count, rng).links
        if shown := visible(links, part):
            break
    return view, shown
