"""The depth camera on SAPIEN's renderer (Vulkan: a GPU, or Mesa's lavapipe on a CPU), with RaycastCamera's clouds.

For a ManiSkill task: :func:`add_visuals` makes its bodies visible, :func:`camera_config` describes the sensor, and
:class:`SapienCamera` reads clouds and pictures from the sensor that ManiSkill makes of it. What is drawn are the meshes
that were read with the object: no file is parsed a second time.
"""

from __future__ import annotations

import colorsys
import functools
from collections.abc import Sequence

import numpy as np
import sapien
import sapien.render
import torch
from mani_skill.sensors.camera import Camera, CameraConfig
from numpy.typing import NDArray
from torch import Tensor

from fb3d_rl.assets.articulation import Mesh
from fb3d_rl.camera.raycast import CameraOptions
from fb3d_rl.camera.views import pixel_points, pixel_rays
from fb3d_rl.errors import UserError

SENSOR = "depth"
"""Name of the camera among a task's sensors."""

_T_CAMERA_SAPIEN = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
"""SAPIEN's cameras have x forward, y left and z up; ours have x right, y down and z forward."""


@functools.cache
def _renderer(device: str) -> sapien.render.RenderSystem:
    """SAPIEN's renderer on a device, kept for the life of the process.

    Without one, compiled shaders are lost with the last scene, so at every reset that builds a new one, and it takes
    seconds to compile them.
    """
    return sapien.render.RenderSystem(sapien.Device(device))


def require_renderer(
    need: str = "camera.kind=sapien",
    otherwise: str = "use camera.kind=raycast",
    devices: Sequence[tuple[str, str]] = (("gpu", "cuda"), ("cpu", "cpu")),
) -> str:
    """Start the renderer and keep it, so that a machine without one fails before any work.

    Args:
        need: what needs the renderer, for the message.
        otherwise: what to do without it, for the message.
        devices: ManiSkill's ``render_backend`` and SAPIEN's device of those that will do, the best first.

    Returns:
        The ``render_backend`` of the first device that renders.

    Raises:
        UserError: Vulkan finds nothing to render on.
    """
    reasons = []
    sapien.render.set_log_level("critical")  # the exceptions hold the message
    for backend, device in devices:
        try:
            _renderer(device)
        except RuntimeError as error:
            reasons.append(str(error))
        else:
            sapien.render.set_log_level("warn")
            return backend
    raise UserError(
        f"{need} needs Vulkan, not found ({'; '.join(reasons)}); install the GPU's Vulkan driver or, "
        "for rendering on the CPU, Mesa's lavapipe 24.3 or later (Debian and Ubuntu: mesa-vulkan-drivers), or "
        f"{otherwise}"
    )


def add_visuals(entity: sapien.Entity, meshes: Sequence[Mesh], index: int) -> None:
    """Make a body visible: all its meshes in one colour, which follows from the body's index.

    Call it before ManiSkill sets the scene up; the body may be in the scene already, with or without collision shapes.

    Args:
        entity: the body's entity, whose frame is that of the meshes.
        meshes: what is seen of the body; none leaves it invisible.
        index: of the body; neighbours differ in hue.
    """
    if not meshes:
        return
    corners = np.concatenate([mesh.vertices[mesh.faces] for mesh in meshes])  # [F, 3, 3]
    # SAPIEN draws front faces only, and the faces of real objects point either way: draw both sides.
    corners = np.concatenate([corners, corners[:, ::-1]])
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True).clip(min=1e-30)
    vertices = corners.reshape(-1, 3).astype(np.float32)
    shape = sapien.render.RenderShapeTriangleMesh(
        vertices,
        np.arange(len(vertices), dtype=np.uint32).reshape(-1, 3),
        normals.repeat(3, axis=0).astype(np.float32),  # edges stay sharp: every face has its own corners
        np.zeros_like(vertices[:, :2]),
        sapien.render.RenderMaterial(base_color=[*colorsys.hsv_to_rgb(0.618034 * index % 1.0, 0.45, 0.9), 1.0]),
    )
    body = sapien.render.RenderBodyComponent()
    body.attach(shape)
    entity.add_component(body)


def camera_config(options: CameraOptions, poses: NDArray[np.float64]) -> CameraConfig:
    """The sensor, for a task's ``_default_sensor_configs``.

    Args:
        options: the camera's optics and shader pack.
        poses: T_world_camera [E, 4, 4] of each scene's camera, as RaycastCamera's ``pose`` gives it.
    """
    return CameraConfig(
        uid=SENSOR,
        pose=[sapien.Pose(pose @ _T_CAMERA_SAPIEN) for pose in poses],
        width=options.resolution,
        height=options.resolution,
        fov=float(np.radians(options.fov)),
        shader_pack=options.shader,
    )


class SapienCamera:
    """Reads the camera of a ManiSkill task, batched over its E scenes.

    Args:
        sensor: the task's sensor :data:`SENSOR`.
        options: the camera's optics, as for :func:`camera_config`.
        poses: T_world_camera [E, 4, 4], as for :func:`camera_config`.
        bodies: for each scene, the entities whose points are wanted, in the order of their indices. Others (a gripper)
            hide what is behind them and give no points.
    """

    def __init__(
        self,
        sensor: Camera,
        options: CameraOptions,
        poses: NDArray[np.float64],
        bodies: Sequence[Sequence[sapien.Entity]],
    ) -> None:
        self._sensor, self._poses = sensor, poses
        self._rays = [pixel_rays(pose, options.ticks) for pose in poses]
        ids = [[entity.per_scene_id for entity in scene] for scene in bodies]
        # Index of the body by scene and id; the last column is for all ids that are higher.
        self._index = torch.full((len(ids), max(max(scene) for scene in ids) + 2), -1, dtype=torch.int64)
        for scene, numbers in enumerate(ids):
            self._index[scene, numbers] = torch.arange(len(numbers))
        self._pictures: dict[str, Tensor] = {}

    def capture(self) -> None:
        """Take a picture of the present state of every scene; the other methods read it."""
        self._sensor.camera.scene.update_render(update_human_render_cameras=False)
        self._sensor.capture()
        self._pictures = {}

    def cloud(self, scene: int = 0) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """The cloud of one scene.

        Returns:
            World points [P, 3] (m), row by row of the image, and the index of the body that each lies on [P].
        """
        depth, ids = (image[scene].flatten().cpu() for image in self._depth_and_ids())
        labels = self._index[scene, ids.clamp(max=self._index.shape[1] - 1)]
        seen = labels.ge(0).nonzero().flatten()
        points = pixel_points(self._poses[scene], self._rays[scene], seen.numpy(), depth[seen].numpy())
        return points, labels[seen].numpy()

    def rgbd(self) -> tuple[Tensor, Tensor]:
        """Colours [E, H, W, 3] uint8 and depth [E, H, W, 1] float32 (m; 0 where nothing is) of all scenes."""
        color = self._sensor.config.shader_config.texture_transforms["Color"](self._picture("Color"))["rgb"]
        return color, self._depth_and_ids()[0][..., None]

    def _depth_and_ids(self) -> tuple[Tensor, Tensor]:
        """Depth (m) and entity id, both [E, H, W] and 0 where nothing is."""
        if "PositionSegmentation" in self._sensor.config.shader_config.texture_names:
            image = self._picture("PositionSegmentation")
            # Whole millimetres with the rest cut off: what was seen lies half of one behind them on average.
            depth, ids = 1e-3 * (0.5 - image[..., 2].float()), image[..., 3].long()
        else:
            depth, ids = -self._picture("Position")[..., 2], self._picture("Segmentation")[..., 1].long()
        return torch.where(ids > 0, depth, 0.0), ids

    def _picture(self, name: str) -> Tensor:
        """A texture [E, H, W, C] of the last capture."""
        if name not in self._pictures:
            (self._pictures[name],) = self._sensor.camera.get_picture([name])
        return self._pictures[name]
