"""What an attempt makes of a picture: the object's cloud, and the motion of a part at a point of it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from fb3d_rl.errors import UserError
from fb3d_rl.geometry.rigid_motion import local_weight, rigid_motion
from fb3d_rl.perception.depth import Intrinsics, points_of
from fb3d_rl.perception.foreground import Plane, object_points, on_robot, table_plane
from fb3d_rl.robot.attempt import Ended, Observation, Predictor, Reason
from fb3d_rl.robot.driver import Driver, Picture
from fb3d_rl.robot.sight import ArmSight
from fb3d_rl.robot.workspace import CENTRE, SIZE, TABLE

Array = NDArray[np.float64]

FEWEST = 100
"""Points that an object has at least."""

CEILING = 0.8
"""Height up to which the workspace is looked at, m."""

INWARD = 0.03
"""What is nearer to the beams is not looked at: a calibration may be off, m."""

STEP = 0.015
"""Neighbouring pixels that differ by less in depth (m) show one surface."""

NEARBY = 0.15
"""The motion of a held part is seen if there are points of it this near to the cup, m."""

MOVES = 0.3
"""A point moves whose flow has this share of the largest one."""

SUPPORT = 8
"""So many points nearby have to move."""

DILATION = 8
"""Pixels by which the arm's outline is widened: a calibration that is off by half a degree and 5 mm shifts it by 7, and
what is left of the arm would be an object."""

SMOOTHED = 24
"""Points around one that tell where the surface is."""


class Seen(NamedTuple):
    """An object in a picture.

    Attributes:
        dense: all its points [D, 3], m, base.
        observation: what a predictor gets.
    """

    dense: Array
    observation: Observation


class Motion(NamedTuple):
    """How a part moves: a point p of it with the velocity ``velocity + turn x (p - at)``, per metre of the way of the
    point ``at``; all [3], m and rad, in the base's axes.
    """

    at: Array
    velocity: Array
    turn: Array

    def of(self, point: Array) -> Array:
        """The velocity [3] of a point [3]."""
        return np.asarray(self.velocity + np.cross(self.turn, point - self.at))


def look(
    driver: Driver,
    sight: ArmSight,
    camera: Array,
    points: int,
    rng: np.random.Generator,
    holding: bool = False,
    force: Array | None = None,
    dense: bool = True,
    deviations: float = 2.0,
    pictures: int = 1,
) -> Seen:
    """Take a picture and cut the object out.

    Args:
        driver: takes it.
        sight: the arm, which is not the object.
        camera: T_base_camera [4, 4].
        points: of the thinned cloud.
        rng: draws the planes that are tried and the thinned cloud.
        holding: whether the cup holds the part.
        force: [3] N at the tip.
        dense: whether the dense cloud is wanted; else it is that of the pixels.
        deviations: beyond which a point is an outlier (:func:`~fb3d_rl.perception.foreground.object_points`).
        pictures: taken one after the other while all stands still (see :func:`still_depth`).

    Raises:
        Ended: there is no picture, no depth or no object.
    """
    joints = driver.joints()
    depth, lens = still_depth([_checked(driver.picture()) for _ in range(pictures)])
    robot = on_robot(depth, sight.depth(joints.position, camera, lens, depth.shape), dilation=DILATION)
    cloud = _in_base(points_of(depth, lens, 1.0), camera)
    cloud[~_in_workspace(cloud)] = np.nan
    table = table_plane(cloud, rng, Plane(np.array([0.0, 0.0, 1.0]), TABLE))
    inside = object_points(cloud, table, robot.ravel(), deviations=deviations)
    if inside.sum() < FEWEST:
        raise Ended(
            Reason.NO_OBJECT,
            f"the camera sees no object on the table: {int(inside.sum())} points above it are not the arm's; put one "
            f"into the workspace, in view, and check the calibration",
        )
    whole = own = cloud[inside].astype(np.float64)
    if dense:
        fine = denser(np.where(inside.reshape(depth.shape), depth, 0.0))
        finer = Intrinsics(2 * lens.fx, 2 * lens.fy, 2 * lens.cx, 2 * lens.cy)
        whole = _in_base(points_of(fine, finer, 1.0), camera)
        whole = smoothed(whole[np.isfinite(whole).all(1)]).astype(np.float64)
    chosen = rng.choice(len(own), min(points, len(own)), replace=False)
    tip = np.asarray(sight.poses(joints.position)[-1])
    felt = np.zeros(3) if force is None else force
    observation = Observation(
        own[chosen].astype(np.float32), camera[:3, 3].copy(), tip, joints.position, TABLE, holding, felt
    )
    return Seen(whole, observation)


def still_depth(
    pictures: Sequence[tuple[NDArray[np.float32], Intrinsics]],
) -> tuple[NDArray[np.float32], Intrinsics]:
    """One depth image [H, W] (m) of several of the same scene: at each pixel the median of what was measured there.

    A pixel that fewer than half of them measured is 0: single points that fly, and edges, are not kept.
    """
    (depth, lens), *others = pictures
    if not others:
        return depth, lens
    measured = np.stack([depth, *(other for other, _ in others)])
    measured[measured == 0.0] = np.nan
    often = 2 * np.isfinite(measured).sum(0) >= len(measured)
    return np.where(often, np.nanmedian(np.where(often, measured, 0.0), axis=0), 0.0).astype(np.float32), lens


def _checked(picture: Picture | None) -> tuple[NDArray[np.float32], Intrinsics]:
    if picture is None:
        raise Ended(Reason.NO_PICTURE, "the camera gave no picture; check that it is connected and runs")
    depth = picture.depth
    if depth is None or np.ndim(depth) != 2 or not np.issubdtype(np.asarray(depth).dtype, np.floating):
        raise Ended(Reason.NO_DEPTH, "the camera gave no depth image [H, W] in metres; check the driver's picture()")
    depth = np.where(np.isfinite(depth), depth, 0.0).astype(np.float32)
    if not (depth > 0).any():
        raise Ended(Reason.NO_DEPTH, "the depth image is empty: nothing was measured; check the camera")
    if float(np.median(depth[depth > 0])) > 20.0:
        raise Ended(Reason.NO_DEPTH, "the depth image is not in metres: half of it is more than 20 m away")
    return depth, picture.lens


def _in_base(points: NDArray[np.floating], camera: Array) -> Array:
    return np.asarray(points @ camera[:3, :3].T + camera[:3, 3], dtype=np.float64)


def _in_workspace(points: Array) -> NDArray[np.bool_]:
    inside = np.abs(points[:, :2] - CENTRE) < np.array(SIZE) / 2 - INWARD  # NaN is not
    return np.asarray(inside.all(1) & (points[:, 2] < CEILING))


def denser(depth: NDArray[np.floating]) -> NDArray[np.float32]:
    """A depth image [2 H - 1, 2 W - 1] with a pixel between any two neighbours that show one surface.

    Planes stay planes, since 1 / depth is linear on them. A cup's lip is looked for among points that are not much
    farther apart than its bellows' travel, which a depth camera at a metre does not give by itself.
    """

    def between(a: NDArray[np.floating], b: NDArray[np.floating]) -> NDArray[np.floating]:
        one = (a > 0) & (b > 0) & (np.abs(a - b) < STEP)
        return np.where(one, 2.0 * a * b / np.maximum(a + b, 1e-9), 0.0)

    fine = np.zeros([2 * n - 1 for n in depth.shape], dtype=np.float32)
    fine[::2, ::2] = depth
    fine[::2, 1::2] = between(depth[:, :-1], depth[:, 1:])
    fine[1::2] = between(fine[:-2:2], fine[2::2])
    return fine


def smoothed(points: NDArray[np.floating]) -> NDArray[np.float32]:
    """Points [N, 3] moved along the normal of the plane that fits those around each, to their median height.

    So a place for the cup is judged by the surface and not by the camera's noise, and networks that were trained on
    exact clouds, and see objects much enlarged, are spared it.
    """
    around = points[cKDTree(points).query(points, min(SMOOTHED, len(points)))[1]].astype(np.float64)
    apart = around - around.mean(1, keepdims=True)
    normals = np.linalg.eigh(apart.swapaxes(1, 2) @ apart)[1][:, :, 0]
    heights = ((around - points[:, None]) @ normals[:, :, None]).squeeze(-1)
    return np.asarray(points + np.median(heights, axis=1)[:, None] * normals, dtype=np.float32)


def predicted(predictor: Predictor, observation: Observation) -> Array:
    """The flow [N, 3] that a predictor finds.

    Raises:
        Ended: it finds none, or no numbers.
    """
    try:
        flow: NDArray[Any] = np.asarray(predictor(observation), dtype=np.float64)
    except UserError as error:
        raise Ended(Reason.NO_FLOW, f"no flow was predicted: {error}") from error
    if flow.shape != observation.points.shape or not np.isfinite(flow).all():
        raise Ended(Reason.NO_FLOW, f"the predictor gave no finite flow of {len(observation.points)} points")
    if not flow.any():
        raise Ended(Reason.NO_FLOW, "nothing is predicted to move")
    return flow


def spread(dense: Array, observation: Observation, flow: Array) -> Array:
    """Flow [D, 3] of the dense cloud: that of the nearest of the thinned cloud's points [N]."""
    return np.asarray(flow[cKDTree(observation.points).query(dense)[1]])


def motion_at(points: NDArray[np.floating], flow: Array, at: Array) -> Motion | None:
    """The motion of the part at a point [3] that a flow [N, 3] of points [N, 3] shows; None if too few near it move."""
    distance = np.linalg.norm(points - at, axis=1)
    size = np.linalg.norm(flow, axis=1)
    if ((distance < NEARBY) & (size > MOVES * size.max())).sum() < SUPPORT:
        return None
    cloud, moves, place = (torch.as_tensor(np.asarray(x, dtype=np.float64))[None] for x in (points, flow, at))
    weight = local_weight(moves, torch.as_tensor(distance**2)[None])
    velocity, turn = (x[0].numpy() for x in rigid_motion(cloud, moves, weight, place, 1e-4))
    speed = float(np.linalg.norm(velocity))
    return Motion(at, velocity / speed, turn / speed) if speed > 1e-9 else None
