"""The task observed as ManiSkill observes it, for comparison of speed."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

from mani_skill.envs.sapien_env import BaseEnv

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.env.options import EnvOptions
from fb3d_rl.env.task import OpenArticulatedEnv


class StockCloudEnv(OpenArticulatedEnv):
    """The same scenes and physics, seen by ManiSkill's own ``obs_mode="pointcloud"`` with its fastest shader pack.

    Args:
        objects: the objects that trials may name.
        options: the task's constants.
        resolution: pixels along each side of the image.

    Raises:
        UserError: there is no renderer.
    """

    def __init__(self, objects: Iterable[ArticulatedObject], options: EnvOptions, resolution: int = 128) -> None:
        camera = replace(options.camera, kind="sapien", shader="minimal", resolution=resolution)
        super().__init__(objects, replace(options, camera=camera), obs_mode="pointcloud")

    def get_obs(self, info: dict[str, Any] | None = None, unflattened: bool = False) -> Any:
        """ManiSkill's observation: a point for each pixel, with colour and segmentation; no flow."""
        return BaseEnv.get_obs(self, info, unflattened)
