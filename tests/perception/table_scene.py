"""A table with an object and a robot's arm as a depth camera sees them, and what of it is whose."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fb3d_rl.assets.articulation import ArticulatedObject, Mesh
from fb3d_rl.camera.noise import DepthNoiseOptions, measured
from fb3d_rl.camera.options import CameraOptions
from fb3d_rl.camera.raycast import RaycastCamera
from fb3d_rl.camera.views import View
from fb3d_rl.perception.depth import Intrinsics, points_of
from fb3d_rl.scene.posed import FAR_BELOW, Posed

OPTICS = CameraOptions(resolution=320, fov=36.0, margin=1.3)
"""About 2 mm between points, as an Azure Kinect at 1 m."""

DIAGONAL = 0.6
"""Of the objects, m."""


def shrunk(obj: ArticulatedObject, factor: float) -> ArticulatedObject:
    """The object at another size."""
    links = []
    for link in obj.links:
        joint = link.joint
        if joint is not None:
            origin = joint.origin.copy()
            origin[:3, 3] *= factor
            limits = tuple(factor * x for x in joint.limits) if joint.type == "prismatic" else joint.limits
            joint = replace(joint, origin=origin, limits=limits)
        visuals, collisions = (
            tuple(Mesh(mesh.vertices * factor, mesh.faces) for mesh in meshes)
            for meshes in (link.visuals, link.collisions)
        )
        links.append(replace(link, joint=joint, visuals=visuals, collisions=collisions))
    return replace(obj, links=tuple(links))


def _mesh(made: trimesh.Trimesh) -> Mesh:
    return Mesh(np.array(made.vertices), np.array(made.faces, dtype=np.int64))


def _bone(start: NDArray[np.float64], end: NDArray[np.float64], radius: float) -> Mesh:
    return _mesh(trimesh.creation.cylinder(radius, segment=np.stack([start, end]), sections=24))


class Seen(NamedTuple):
    """What the camera measured, in the frame that it believes to be the table's, pixel by pixel.

    Attributes:
        points: [P, 3] m, NaN where nothing was measured.
        label: [P] 0 on the object, 1 on the table, 2 on the robot, -1 between them or where nothing was measured.
        link: [P] the object's link at each pixel, before any error; other numbers elsewhere.
        depth: [H, W] m.
        robot: [H, W] m, of the robot's model alone.
    """

    points: NDArray[np.float64]
    label: NDArray[np.int64]
    link: NDArray[np.int64]
    depth: NDArray[np.float32]
    robot: NDArray[np.float32]


class Scene:
    """An object on a table of 1.08 x 1.00 m, its parts a little open, and an arm that is about to touch it."""

    def __init__(self, obj: ArticulatedObject) -> None:
        size = float(np.linalg.norm(np.ptp(Posed(obj).bounds(Posed(obj).closed), axis=0)))
        posed = Posed(shrunk(obj, DIAGONAL / size))
        self.posed = posed
        self.poses = posed.poses(posed.closed + 0.15 * (posed.opened - posed.closed))
        low, high = posed.bounds(posed.closed)
        front, middle = np.array([low[0], 0.0, 0.0]), 0.5 * (low + high)
        tip = front + [-0.03, 0.05, middle[2]]
        wrist, elbow = tip + [-0.12, 0.0, 0.02], tip + [-0.3, 0.3, 0.25]
        arm = (_bone(tip, wrist, 0.015), _bone(wrist, wrist + [-0.1, 0.0, 0.03], 0.045), _bone(wrist, elbow, 0.05))
        table = _mesh(trimesh.creation.box(extents=(1.08, 1.0, 0.02)))
        self.links = len(posed.obj.links)
        self.camera = RaycastCamera(posed.obj, [(table,), arm], OPTICS)
        self.table = np.eye(4)
        self.table[:3, 3] = [middle[0], middle[1], -0.01]

    def see(
        self,
        view: View,
        noise: DepthNoiseOptions,
        seed: int,
        degrees: float = 0.0,
        metres: float = 0.0,
        arm: bool = True,
    ) -> Seen:
        """A picture, where the calibrated camera pose is off by a turn and a shift in directions that are drawn."""
        away = np.eye(4)
        away[2, 3] = FAR_BELOW
        placed = np.concatenate([self.poses, [self.table, np.eye(4) if arm else away]])
        depth, bodies = self.camera.depth_image(placed, view)
        shot = measured(depth, OPTICS.ticks, OPTICS.ticks, noise, seed, bodies=bodies)
        axis, way = np.random.default_rng(seed).normal(size=(2, 3))
        off = np.eye(4)
        off[:3, :3] = Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis)).as_matrix()
        off[:3, 3] = metres * way / np.linalg.norm(way)
        true = self.camera.pose(view)
        believed = true @ off
        alone = [away] * (self.links + 1)
        # The robot as the believed camera would see it.
        robot, _ = self.camera.depth_image(np.stack([*alone, true @ np.linalg.inv(believed)]), view)
        points = points_of(shot.depth, Intrinsics(*OPTICS.pinhole), 1.0).astype(np.float64)
        whose = np.where(bodies < 0, -1, np.maximum(bodies - self.links + 1, 0)).ravel()
        label = np.where(shot.source.ravel() >= 0, whose[shot.source.ravel()], -1)
        return Seen(points @ believed[:3, :3].T + believed[:3, 3], label, bodies.ravel(), shot.depth, robot)
