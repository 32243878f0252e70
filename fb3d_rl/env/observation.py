"""The task's observation by the data contract's keys, batched over its E environments."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from fb3d_rl.camera.sapien import SapienCamera
from fb3d_rl.env.gripper import FloatingSuctionGripper
from fb3d_rl.env.stage import Stage

Observation = dict[str, dict[str, Tensor]]
"""Entries [E, ...] of the groups "observation" and "privileged"."""

CLOUD = {"points": "observation", "valid": "observation", "part_mask": "observation"} | dict.fromkeys(
    ("flow", "link"), "privileged"
)
"""The groups of a cloud's entries."""


def gripper_and_joint(
    stages: Sequence[Stage],
    poses: Sequence[NDArray[np.float64]],
    gripper: FloatingSuctionGripper,
    force: NDArray[np.float32],
    position: NDArray[np.float32],
) -> Observation:
    """State of the grippers, and the true joints to open.

    Args:
        stages: the E environments.
        poses: poses of the bodies of each (:meth:`~fb3d_rl.env.stage.Stage.poses`).
        gripper: the grippers of all environments.
        force: norm [E, 1] of the contact force on each gripper, N.
        position: position [E, 1] of each joint to open, rad or m.
    """

    def tensor(rows: Any) -> Tensor:
        return torch.from_numpy(np.array(rows)).to(gripper.device)

    truth = tensor([stage.joint_truth(pose) for stage, pose in zip(stages, poses, strict=True)])
    return {
        "observation": {
            "qpos": gripper.robot.get_qpos(),
            "qvel": gripper.robot.get_qvel(),
            "tool_pose": gripper.tool_pose(),
            "attached": tensor([[stage.suction.attached] for stage in stages]),
            "contact_force": tensor(force),
            "camera_position": tensor([stage.camera_pose[:3, 3] for stage in stages]).float(),
            "goal_sense": tensor([[stage.sense] for stage in stages]).float(),
        },
        "privileged": {
            "joint_axis": truth[:, :3],
            "joint_origin": truth[:, 3:],
            "joint_prismatic": tensor([[stage.prismatic] for stage in stages]),
            "joint_position": tensor(position),
        },
    }


def clouds(
    stages: Sequence[Stage],
    poses: Sequence[NDArray[np.float64]],
    count: int,
    steps: Tensor,
    rendered: SapienCamera | None,
) -> Observation:
    """The clouds of the cameras, with ground truth.

    Args:
        stages: the E environments.
        poses: poses of the bodies of each.
        count: number N of points.
        steps: number of control steps made [E]; the result is on this device.
        rendered: SAPIEN's camera after a capture; None for the ray caster.
    """
    each = [
        stage.observe(pose, count, int(steps[e]), None if rendered is None else rendered.cloud(e))
        for e, (stage, pose) in enumerate(zip(stages, poses, strict=True))
    ]
    result: Observation = {"observation": {}, "privileged": {}}
    for key, group in CLOUD.items():
        values = [cloud[key] for cloud in each]
        stacked = values[0][None] if len(values) == 1 else torch.stack(values)  # one is not copied
        result[group][key] = stacked.to(steps.device)
    return result
