"""A ManiSkill environment of stages: how its scenes are built, observed and drawn, independent of the task."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from typing import Any

import numpy as np
import sapien
import torch
from mani_skill import logger
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils.structs import Articulation
from mani_skill.utils.structs.types import SceneConfig, SimConfig
from numpy.typing import NDArray
from torch import Tensor

from fb3d_rl.assets.gripper import BODIES, FINGERS, TOOL
from fb3d_rl.camera.sapien import SENSOR, SapienCamera, camera_config
from fb3d_rl.env.gripper import FloatingSuctionGripper
from fb3d_rl.env.model import add_ground
from fb3d_rl.env.options import EnvOptions
from fb3d_rl.env.stage import Stage
from fb3d_rl.env.suction import ContactImpulses
from fb3d_rl.errors import UserError

logger.addFilter(
    lambda record: "does not support rendering" not in record.getMessage()
)  # pictures are drawn without it

PICTURE = 512
"""Width and height (pixels) of what ``render()`` returns."""


class StagedEnv(BaseEnv):
    """Parallel scenes, each of which a stage fills: an object and the gripper before a camera.

    A derived class sets ``options`` before it is initialized and ``stages`` before it is reset.
    """

    agent: FloatingSuctionGripper
    scene: Any
    options: EnvOptions
    """The task's constants."""
    stages: list[Stage]
    """The content of each of the E environments."""

    @property
    def _default_sim_config(self) -> SimConfig:
        gravity = [0.0, 0.0, -9.81 if self.options.gravity else 0.0]
        return SimConfig(scene_config=SceneConfig(gravity=gravity))

    # ---------------------------------------------------------------------------------------------- scenes

    def _clear(self) -> None:
        # BaseEnv collects garbage here, which takes 0.2 s with torch loaded; the scene is freed without it.
        self._close_viewer()
        self.scene = None
        self.__dict__.pop("agent", None)
        for name in ("articulation", "_built", "_impulses", "_rendered"):
            self.__dict__.pop(name, None)

    def _load_agent(self, options: dict[str, Any]) -> None:
        self.agent = FloatingSuctionGripper(
            self.scene,
            self._control_freq,
            self._control_mode,
            initial_pose=sapien.Pose(),
            options=self.options.gripper,
        )

    def _load_scene(self, options: dict[str, Any]) -> None:
        add_ground(self.scene)
        own = self.agent.robot.links_map
        built = [stage.build(self.scene, e, own) for e, stage in enumerate(self.stages)]
        for articulation in built:
            self.remove_from_state_dict_registry(articulation)
        if self.scene.can_render():
            for stage in self.stages:
                stage.show()
        self._built = built
        # One view of all objects, whose joint states are padded to the longest.
        self.articulation = Articulation.merge(built, name="object")
        self.add_to_state_dict_registry(self.articulation)
        joints = max(len(stage.order) for stage in self.stages)
        self._rows, self._columns = np.arange(self.num_envs)[:, None], np.zeros((self.num_envs, joints), dtype=np.int64)
        for row, stage in zip(self._columns, self.stages, strict=True):
            row[: len(stage.order)] = stage.order

    def joint_states(self) -> NDArray[np.float32]:
        """Joint states [E, J] (rad or m) in the order of each object's ``movable``, padded on the right."""
        if self.gpu_sim_enabled:
            states = self.articulation.get_qpos().cpu().numpy()
        else:
            states = self.articulation._objs[0].get_qpos()[None]
        found: NDArray[np.float32] = states[self._rows, self._columns]
        return found

    def joint_positions(self) -> Tensor:
        """:meth:`joint_states` as a tensor on the environments' device."""
        return torch.from_numpy(self.joint_states()).to(self.device)

    def contact_impulses(self) -> ContactImpulses:
        """A reader of the contacts of all environments for simulators without contact points."""
        return ContactImpulses(
            self.scene,
            self.agent.robot,
            FINGERS,
            BODIES,
            TOOL,
            [
                {i: built.links_map[stage.object.links[i].name] for i in stage.holdable(self.options.suction.hold)}
                for stage, built in zip(self.stages, self._built, strict=True)
            ],
        )

    # --------------------------------------------------------------------------------------------- pictures

    def _camera_poses(self) -> NDArray[np.float64]:
        """T_world_camera [E, 4, 4]."""
        return np.stack([stage.camera_pose for stage in self.stages])

    @property
    def _default_sensor_configs(self) -> list[CameraConfig]:
        return [camera_config(self.options.camera, self._camera_poses())]

    @property
    def _default_human_render_camera_configs(self) -> list[CameraConfig]:
        picture = replace(self.options.camera, resolution=PICTURE, shader="default")
        return [replace(camera_config(picture, self._camera_poses()), uid="render_camera")]

    def _after_reconfigure(self, options: dict[str, Any]) -> None:
        if self.scene.can_render():
            bodies = [[link.entity for link in stage.links] for stage in self.stages]
            self._rendered = SapienCamera(self._sensors[SENSOR], self.options.camera, self._camera_poses(), bodies)

    def render_rgb_array(self, camera_name: str | None = None) -> Tensor:
        """Pictures [E, H, W, 3] uint8 of the scenes: by SAPIEN where it renders, else shaded on the CPU."""
        if self.scene.can_render():
            pictures: Tensor = super().render_rgb_array(camera_name)
            return pictures
        return torch.from_numpy(np.stack([stage.picture(PICTURE) for stage in self.stages]))

    def _reconfigure(self, options: Any = None) -> None:
        with self._window() if self.render_mode == "human" else nullcontext():
            super()._reconfigure(options)

    def render_human(self) -> Any:
        """SAPIEN's viewer.

        Raises:
            UserError: there is no screen to open its window on.
        """
        with self._window():
            return super().render_human()

    @contextmanager
    def _window(self) -> Iterator[None]:
        """Where SAPIEN's viewer may open its window."""
        try:
            yield
        except RuntimeError as error:
            raise UserError(
                f"render_mode=human: no window can be opened ({error}); run it where there is a screen, or take "
                "render_mode=rgb_array"
            ) from error
