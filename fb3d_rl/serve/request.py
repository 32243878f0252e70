"""What a client may send: what its camera sees, where its tool is, and what it asks for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from fb3d_rl.assets.gripper import TIP
from fb3d_rl.errors import UserError
from fb3d_rl.geometry.transforms import apply, euler_xyz_to_matrix, matrix_to_quaternion, quaternion_to_matrix
from fb3d_rl.perception.arrays import as_mask, as_points, near_origin
from fb3d_rl.perception.depth import intrinsics_in, points_of
from fb3d_rl.predict.setting import Array, moved, numbers, position, seen_from

PLANNING = ("up", "front", "tilt", "ground", "foreground", "far")

KEYS = {
    "points": "[N, 3] m, in any frame that stays the same for an episode; what is not finite counts as missing",
    "depth": "[H, W] in place of points: floats in m, or whole numbers in 1/depth_scale m; 0 is missing",
    "intrinsics": "of depth: [fx, fy, cx, cy] in pixels, a 3 x 3 matrix, or a map as in a camera's file",
    "depth_scale": "units of depth in a metre (default: what the intrinsics say, 1 for floats, else 1000)",
    "camera": "where the camera stood, [3], or its pose T_cloud_camera [4, 4]; a pose moves the points of depth by it",
    "mask": "[N] or [H, W], the part to open, as of fb3d_rl.plan",
    "tool_pose": "[7] of the suction tip in the cloud's frame: p (m) and q (wxyz)",
    "qpos": "[8] of the gripper in the world frame: x y z (m), roll pitch yaw (rad), fingers (m)",
    "qvel": "[8] the same per second (default: by the difference to the request before)",
    "attached": "whether suction holds something (default: false)",
    "force": "norm of the contact force on the gripper, N (default: 0)",
    "goal_sense": "1 to open, -1 to close some way (default: 1)",
    "T_world_cloud": "[4, 4] to the world frame: z up, ground at z = 0, the object's front to -x, the points no more "
    "than the object (default: as an earlier answer of the episode says, else as the plan finds it)",
    "reset": "true: this is the first request of another episode (the first of a connection is anyway)",
    "plan": "true: answer with a plan, too",
    "flow": "true: the plan has the flow of each point, [N, 3]",
    **dict.fromkeys(PLANNING, "as of fb3d_rl.plan"),
}
"""The names in a request with their meaning."""


@dataclass(frozen=True, eq=False)
class Cloud:
    """What a client sees, in its own frame.

    Attributes:
        points: [N, 3] as given, or of a depth image.
        measured: [N] bool; what is not finite or far away is missing.
        mask: [N] bool, on the part to open; None where nobody says.
        camera: [3] where the camera stood; None where nobody says.
        planning: what :func:`fb3d_rl.plan` is told besides.
    """

    points: NDArray[Any]
    measured: Tensor
    mask: Tensor | None
    camera: Array | None
    planning: dict[str, Any]


def require_known(request: Mapping[str, Any]) -> None:
    """Check the names in a request.

    Raises:
        UserError: there is an unknown one, or nothing is seen.
    """
    for name in request:
        if name not in KEYS:
            raise UserError(f"{name[:80]!r} is unknown in a request: choose from {', '.join(KEYS)}.")
    if ("points" in request) == ("depth" in request):
        raise UserError("A request holds points or depth, one of the two.")


def cloud_of(request: Mapping[str, Any]) -> Cloud:
    """The cloud of a request.

    Raises:
        UserError: a shape or a value is none that is known.
    """
    optical = "depth" in request
    raw = _depth(request) if optical else as_points(request["points"]).numpy()
    camera = request.get("camera")
    if camera is not None:
        position(camera)  # refuses what is none
    points, camera, assumed = seen_from(raw, camera, optical)
    planning = assumed | {key: request[key] for key in PLANNING if request.get(key) is not None}
    for key in ("tilt", "ground", "far", "foreground"):
        if key in planning:
            planning[key] = number(planning, key)
    mask = request.get("mask")
    if mask is not None:
        values = np.asarray(mask)
        if optical and values.shape == np.shape(request["depth"]):
            values = values.reshape(-1)
        mask = as_mask(values, len(points))
    near, _ = near_origin(torch.from_numpy(points))
    measured = near.isfinite().all(1)
    if int(measured.sum()) < 3:
        raise UserError(f"The cloud has {int(measured.sum())} points that are finite: nothing is to be seen.")
    return Cloud(points, measured, mask, None if camera is None else position(camera), planning)


def _depth(request: Mapping[str, Any]) -> NDArray[np.float32]:
    """The points [H * W, 3] of a depth image, in the camera's frame."""
    depth, about = np.asarray(request["depth"]), request.get("intrinsics")
    if depth.ndim != 2 or depth.dtype.kind not in "fiu":
        raise UserError(f"depth is {depth.dtype} {list(depth.shape)}: give numbers [H, W].")
    if about is None:
        raise UserError("depth comes without intrinsics: give [fx, fy, cx, cy] in pixels.")
    if not isinstance(about, Mapping):
        matrix = np.shape(about) == (3, 3)
        values = numbers(about, (3, 3) if matrix else (4,), "intrinsics").tolist()
        about = {"K": values} if matrix else dict(zip(("fx", "fy", "cx", "cy"), values, strict=True))
    camera = intrinsics_in(dict(about), "intrinsics")
    usual = camera.per_metre or (1.0 if depth.dtype.kind == "f" else 1000.0)
    units = number(request, "depth_scale", usual)
    if not units > 0:
        raise UserError(f"depth_scale is {units:g}: give more than 0.")
    with np.errstate(over="ignore", invalid="ignore"):
        return points_of(depth.astype(np.float32), camera, units)


def tool_of(request: Mapping[str, Any], pose: Array) -> tuple[Tensor, Tensor] | None:
    """The tool in the world: qpos [8] and the pose of the tip [7], float64; None if the request does not say.

    Args:
        request: holds tool_pose, in the cloud's frame, or qpos, or both.
        pose: T_world_cloud [4, 4].

    Raises:
        UserError: one of the two is none.
    """
    given = numbers(request["qpos"], (8,), "qpos") if request.get("qpos") is not None else None
    if request.get("tool_pose") is not None:
        tool = numbers(request["tool_pose"], (7,), "tool_pose")
        if not bool(tool[3:].any()):
            raise UserError("tool_pose has the quaternion 0: give p (m) and q (wxyz).")
        place = torch.from_numpy(pose)
        rotation = place[:3, :3] @ quaternion_to_matrix(tool[3:])
        if np.array_equal(pose, np.eye(4)):
            tip = tool  # the same bits
        else:
            tip = torch.cat([apply(place, tool[None, :3])[0], matrix_to_quaternion(rotation)])
        if given is None:
            hand = tip[:3] - TIP * rotation[:, 0]
            given = torch.cat([hand, _euler_xyz(rotation), torch.zeros(2, dtype=torch.float64)])
        return given, tip
    if given is None:
        return None
    rotation = euler_xyz_to_matrix(given[3:6])
    return given, torch.cat([given[:3] + TIP * rotation[:, 0], matrix_to_quaternion(rotation)])


def _euler_xyz(rotation: Tensor) -> Tensor:
    """Angles [3] of a rotation [3, 3], the inverse of ``euler_xyz_to_matrix``; calm where roll and yaw are one."""
    pitch = torch.asin(rotation[0, 2].clamp(-1.0, 1.0))
    if abs(float(rotation[0, 2])) > 1 - 1e-9:
        return torch.stack([torch.atan2(rotation[2, 1], rotation[1, 1]), pitch, torch.zeros_like(pitch)])
    return torch.stack(
        [torch.atan2(-rotation[1, 2], rotation[2, 2]), pitch, torch.atan2(-rotation[0, 1], rotation[0, 0])]
    )


def pose_of(request: Mapping[str, Any]) -> Array | None:
    """T_world_cloud [4, 4] of a request, if it names one.

    Raises:
        UserError: it is no rigid transform.
    """
    if request.get("T_world_cloud") is None:
        return None
    pose = numbers(request["T_world_cloud"], (4, 4), "T_world_cloud").numpy()
    moved(np.zeros((1, 3)), pose)  # refuses what is not rigid
    return pose


def number(request: Mapping[str, Any], name: str, default: float = 0.0) -> float:
    """One finite number, or true or false; the default if there is none.

    Raises:
        UserError: it is something else.
    """
    if request.get(name) is None:
        return default
    try:
        values = np.asarray(request[name], dtype=np.float64)
    except (ValueError, TypeError) as error:
        raise UserError(f"{name} is no number.") from error
    if values.size != 1 or not np.isfinite(values).all():
        raise UserError(f"{name} is {list(values.shape)}: give one finite number.")
    return float(values.reshape(()))
