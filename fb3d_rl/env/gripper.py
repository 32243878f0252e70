"""The floating suction gripper: an agent with eight velocity-controlled joints (supplement, II.C)."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import torch
from mani_skill.agents.base_agent import BaseAgent
from mani_skill.agents.controllers import PDJointVelControllerConfig
from mani_skill.agents.registration import register_agent
from torch import Tensor

from fb3d_rl.assets.gripper import TOOL, URDF
from fb3d_rl.contract import ACTION_DIM
from fb3d_rl.env.options import GripperOptions
from fb3d_rl.errors import UserError

JOINTS = ("x", "y", "z", "roll", "pitch", "yaw", "finger_left", "finger_right")
"""Joints in the order of actions, qpos and qvel."""


@register_agent()
class FloatingSuctionGripper(BaseAgent):
    """A hand on three slides (x, y, z) and three hinges (roll, pitch, yaw), with two closed fingers.

    The hand's origin is at the slides' positions and its rotation is ``Rx(roll) Ry(pitch) Rz(yaw)``
    (:func:`fb3d_rl.geometry.transforms.euler_xyz_to_matrix`). No gravity acts on it, and its own links do not
    collide with each other.
    """

    uid = "floating_suction_gripper"
    urdf_path = str(URDF)
    disable_self_collisions = True
    _builder: ClassVar[Any] = None

    def __init__(self, *args: Any, options: GripperOptions | None = None, **kwargs: Any) -> None:
        self.options = options or GripperOptions()
        super().__init__(*args, **kwargs)

    def _load_articulation(self, initial_pose: Any = None) -> None:
        """As ManiSkill's, but the URDF is parsed once: that takes longer than the rest of a reset."""
        cls = type(self)
        if cls._builder is None:
            loader = self.scene.create_urdf_loader()
            loader.name, loader.disable_self_collisions = self.uid, self.disable_self_collisions
            cls._builder = loader.parse(self.urdf_path)["articulation_builders"][0]
        builder = cls._builder.set_scene(self.scene)
        builder.scene_idxs, builder.initial_pose = None, initial_pose
        self.robot = builder.build()
        self.robot_link_names = [link.name for link in self.robot.get_links()]

    @property
    def _controller_configs(self) -> dict[str, PDJointVelControllerConfig]:
        o = self.options
        top = [o.v_max] * 3 + [o.w_max] * 3 + [o.f_max] * 2
        return {
            "velocity": PDJointVelControllerConfig(
                joint_names=list(JOINTS),
                lower=[-speed for speed in top],
                upper=top,
                damping=[o.damping] * 3 + [o.angular_damping] * 3 + [o.damping] * 2,
                force_limit=[o.force_limit] * 3 + [o.torque_limit] * 3 + [o.finger_force_limit] * 2,
            )
        }

    def set_action(self, action: Any) -> None:
        """As ManiSkill's, but one environment on the CPU gives the drives numbers, without a tensor for each joint.

        Args:
            action: [E, 8] in [-1, 1]: each joint's velocity as a share of its largest.
        """
        if self.scene.gpu_sim_enabled:
            super().set_action(action)
            return
        shares = np.asarray(action, dtype=np.float32)[0]
        if np.isnan(shares).any():
            raise ValueError(f"the action holds a number that is missing: {shares}")
        targets = self._middle + self._reach * shares.clip(-1.0, 1.0)
        for joint, target in zip(self._drives, targets.tolist(), strict=True):
            joint.set_drive_velocity_target(target)

    def _after_init(self) -> None:
        velocity = self.controllers["velocity"]
        low, high = (np.asarray(bound, dtype=np.float32) for bound in (velocity.config.lower, velocity.config.upper))
        self._middle, self._reach = np.float32(0.5) * (high + low), np.float32(0.5) * (high - low)
        self._drives = [joint._objs[0] for joint in velocity.joints]

    def tool_pose(self) -> Tensor:
        """Pose [E, 7] of the suction tip in the world: p (m) and q (wxyz, w >= 0)."""
        poses = [body.entity_pose for body in self.robot.links_map[TOOL]._objs]
        rows = np.array([np.concatenate([pose.p, pose.q]) for pose in poses], dtype=np.float32)
        rows[rows[:, 3] < 0, 3:] *= -1.0
        return torch.from_numpy(rows).to(self.device)


def checked_action(action: Tensor, envs: int) -> Tensor:
    """An action [E, 8] (or [8] with one environment) within [-1, 1].

    Raises:
        UserError: it has another shape, is not finite or out of range.
    """
    if action.shape not in ((envs, ACTION_DIM), (ACTION_DIM,) * (envs == 1)):
        raise UserError(f"the action has shape {tuple(action.shape)}; give one of {(envs, ACTION_DIM)}")
    # Rounding may leave the range by a little. Written so that nan fails too.
    if not bool((action.abs() <= 1.0 + 1e-4).all()):
        worst = action[~(action.abs() <= 1.0 + 1e-4)][0]
        raise UserError(f"the action holds {float(worst):.6g}; velocities are numbers from -1 to 1")
    return action.clamp(-1.0, 1.0)
