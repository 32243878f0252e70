"""The pictures of a film, drawn on the CPU: the part to open in blue, its flow as orange arrows."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from fb3d_rl.camera.views import View, look_at
from fb3d_rl.drawing.bodies import GRIPPER, Body, Color, Part, Placed, link_colors
from fb3d_rl.drawing.camera import Camera
from fb3d_rl.drawing.signs import FLOW, FREE, HOLDING, arrow_mesh, cup_mesh
from fb3d_rl.drawing.studio import Studio
from fb3d_rl.geometry.points import farthest_point_sample
from fb3d_rl.kinematics.opening import standing_bounds
from fb3d_rl.rollout.film import Film

ARROWS = 26
"""Flow arrows on the part."""

VIEWS = tuple(
    View(azimuth, elevation) for elevation in (22.0, 34.0) for azimuth in (-35.0, 35.0, -20.0, 20.0, -55.0, 55.0)
)
"""Directions that a film may be drawn from, in addition to that of the policy's camera."""


class Shot:
    """A film's bodies, and a camera that has all of them in its picture.

    Args:
        film: the film.
        width: of the pictures, pixels.
        height: of the pictures, pixels; unless given, 0.8 to 1.3 times the width, depending on the scene.
        view: direction of the camera; the one that shows the part's motion best unless given.
    """

    def __init__(self, film: Film, width: int, height: int | None = None, view: View | None = None) -> None:
        self.film = film
        count = len(film.obj.links)
        # The suction cup, the last body, moves with the hand, the first after the links.
        poses = np.concatenate([film.poses, film.poses[:, [count]]], axis=1)
        meshes = [*(link.visuals for link in film.obj.links), *film.gripper, [cup_mesh(film.gripper)]]
        colors = [*link_colors(film.obj, film.link), *[GRIPPER] * 3]

        def bodies(groups: Sequence[Sequence[int]], cup: Color = FREE) -> list[tuple[Body, int]]:
            made = []
            for members in groups:
                to_body = np.linalg.inv(poses[0, members[0]])
                parts = [Part(meshes[i], [*colors, cup][i], to_body @ poses[0, i]) for i in members]
                made.append((Body(parts, opaque=members[0] >= count), members[0]))
            return made

        # The object's root stands still, and so does all that is fixed to it.
        standing, *sliding = _rigid_groups(poses, range(count))
        self._still = Body(Part(meshes[i], colors[i], poses[0, i]) for i in standing)
        self._parts = bodies(sliding)
        gripper = _rigid_groups(poses, range(count, count + 4))
        self._gripper = {held: bodies(gripper, HOLDING if held else FREE) for held in (False, True)}
        self._anchors = _anchors(film)
        bounds = standing_bounds(film.obj)
        self._centre, self._span = bounds.mean(0), float(np.linalg.norm(bounds[1] - bounds[0]))
        self._length = 0.14 * self._span
        self.view = view or self._best_view()
        extent = self._extent()
        if height is None:
            across, down = np.ptp(Camera.fitting(self.view, extent, (width, width)).project(extent), axis=0)
            height = round(width * float(np.clip(down / across, 0.8, 1.3)))
        self.camera = Camera.fitting(self.view, extent, (width, height))
        self._studio = Studio(self.camera, self._still)

    def _extent(self) -> NDArray[np.float64]:
        """Points [P, 3] (m) that have to be in the picture: the outlines of all bodies at all times, and arrows.

        A gripper that flies far off leaves the picture.
        """
        outlines = [self._still.outline()]
        around = np.linalg.norm(self.film.tips - self._centre, axis=-1) < 1.2 * self._span
        for _, t in moments(self.film):
            starts, flows = self.arrows(t)
            outlines.append(starts + self._length * flows)
        for body, leader in [*self._parts, *self._gripper[False]]:
            poses = self.film.poses[around if leader >= len(self.film.obj.links) else slice(None), leader]
            turned = np.einsum("tij,pj->tpi", poses[:, :3, :3], body.outline())
            outlines.append((turned + poses[:, None, :3, 3]).reshape(-1, 3))
        return np.concatenate(outlines)

    def _best_view(self) -> View:
        """The view that shows most of the flow, and the suction tip, at the film's moments."""
        film, views = self.film, (self.film.view, *VIEWS)
        scores = np.zeros(len(views))
        for _, t in moments(film):
            starts, flows = self.arrows(t)
            points = np.concatenate([film.tips[[t]], starts]).astype(np.float32)
            for number, view in enumerate(views):
                outward = -look_at(view, np.zeros(3), 1.0)[:3, 2].astype(np.float32)
                rays = np.tile(outward, (len(points), 1))
                hidden = self._still.blocks(np.eye(4), points + 0.02 * rays, rays, np.inf)
                # The gripper is left out: it hides little of the part, and the tip is its own.
                for body, leader in self._parts:
                    hidden |= body.blocks(film.poses[t, leader], points + 0.02 * rays, rays, np.inf)
                across = np.linalg.norm(np.cross(flows, outward), axis=-1)
                shown = float(~hidden[0]) + (across * ~hidden[1:]).sum() / max(len(flows), 1)
                # The square root favours views that show something at all moments over those that show much at a few.
                scores[number] += np.sqrt(shown)
        return views[int(scores.argmax())]

    def arrows(self, t: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Where the flow's arrows start [A, 3] (m, on the part) and the flow there [A, 3], at moment ``t``."""
        film, pose = self.film, self.film.poses[t, self.film.link]
        starts = self._anchors @ pose[:3, :3].T + pose[:3, 3]
        points, flow = film.points[t][film.part[t]], film.flow[t][film.part[t]]
        if not len(points) or not len(starts):
            return np.zeros((0, 3)), np.zeros((0, 3))
        nearest = np.linalg.norm(starts[:, None] - points, axis=-1)
        chosen = nearest.argsort(axis=1, kind="stable")[:, :3]
        flows = flow[chosen].mean(1).astype(np.float64)
        # Arrows are drawn only where the policy's camera sees the part.
        seen = (nearest.min(1) < 0.08) & (np.linalg.norm(flows, axis=-1) > 0.12)
        return starts[seen], flows[seen]

    def picture(self, t: int) -> NDArray[np.uint8]:
        """The image [H, W, 3] of moment ``t``."""
        starts, flows = self.arrows(t)
        signs = Body([Part(arrow_mesh(starts, self._length * flows, 0.13 * self._length), FLOW)], sign=True)
        bodies = [*self._parts, *self._gripper[bool(self.film.attached[t])]]
        moving: list[Placed] = [(body, self.film.poses[t, leader]) for body, leader in bodies]
        return self._studio.picture([*moving, (signs, np.eye(4))])


def _rigid_groups(poses: NDArray[np.float64], among: Iterable[int], slack: float = 2e-3) -> list[list[int]]:
    """Bodies ``among`` those of ``poses`` [T, B, 4, 4], in groups whose members keep their places in the first's frame.

    The ``slack`` (m, or rad) is less than a pixel; the fingers have as much play.
    """
    groups: list[list[int]] = []
    for i in among:
        for group in groups:
            relative = np.linalg.inv(poses[:, group[0]]) @ poses[:, i]
            if np.ptp(relative, axis=0).max() < slack:
                group.append(i)
                break
        else:
            groups.append([i])
    return groups


def _anchors(film: Film) -> NDArray[np.float64]:
    """Points [A, 3] in the part's frame, spread over all of it that the policy's camera sees at some time."""
    seen = []
    for t in np.unique(np.linspace(0, len(film) - 1, 6).astype(int)):
        pose = film.poses[t, film.link]
        seen.append((film.points[t][film.part[t]] - pose[:3, 3]) @ pose[:3, :3])
    points = np.concatenate(seen)
    if not len(points):
        return points
    chosen = points[farthest_point_sample(torch.from_numpy(points)[None], ARROWS)[0].numpy()]
    gaps = np.linalg.norm(chosen[:, None] - chosen, axis=-1)
    return chosen[[bool((gaps[i, :i] > 0.01).all()) for i in range(len(chosen))]]


class Course(Protocol):
    """What a film tells of its moments; see :class:`~fb3d_rl.rollout.film.Film`."""

    @property
    def attached(self) -> NDArray[np.bool_]: ...

    @property
    def opened(self) -> NDArray[np.floating]: ...

    @property
    def tips(self) -> NDArray[np.floating]: ...

    @property
    def success(self) -> bool: ...

    @property
    def aim(self) -> tuple[str, str]: ...

    def moment(self, t: int) -> str: ...

    def __len__(self) -> int: ...


def moments(film: Course) -> list[tuple[str, int]]:
    """Up to six important moments of a film, in order, each with its name."""
    last = len(film) - 1
    if film.attached.any():
        contact = int(film.attached.argmax())
        far = np.linalg.norm(film.tips[:contact] - film.tips[contact], axis=-1) > 0.1
        before = int(np.flatnonzero(far)[-1]) if far.any() else 0
        gain = film.opened[last] - film.opened[contact]
        chosen = [("start", 0), ("pre-contact", before), ("contact", contact)]
        for name, share in (("one third", 1 / 3), ("two thirds", 2 / 3)):
            if gain > 0.3:
                reached = film.opened[contact:] - film.opened[contact] >= share * gain
                chosen.append((name, contact + int(reached.argmax())))
            else:
                t = contact + round(share * (last - contact))
                chosen.append((film.moment(t), t))
    else:
        between = np.linspace(0, last, 6).round().astype(int)[1:-1].tolist()
        chosen = [("start", 0)] + [(film.moment(t), t) for t in between]
    end = (film.aim[1] if film.success else "end", last)
    return [item for item, after in zip(chosen, [*chosen[1:], end], strict=True) if item[1] < after[1]] + [end]
