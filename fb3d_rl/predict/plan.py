"""Where and how to touch an object that somebody has seen with a camera of their own, and which way it would move.

The flow is the network's, the contact point, the pull and the gripper's orientation are what the flow policy would
choose (:mod:`fb3d_rl.policies.contact`, :mod:`fb3d_rl.policies.commands`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from fb3d_rl.errors import UserError
from fb3d_rl.geometry.transforms import alignment, matrix_to_quaternion, quaternion_to_matrix, rotate
from fb3d_rl.models.artflownet import LARGEST, POINTS, ArtFlowNet, needs_mask
from fb3d_rl.perception.arrays import as_mask, as_points, draw, finite, near_origin, nearest, places
from fb3d_rl.policies.commands import above_ground
from fb3d_rl.policies.contact import choose_contact
from fb3d_rl.policies.hand import hand_axis
from fb3d_rl.policies.options import FlowPolicyOptions
from fb3d_rl.predict.setting import Array, Setting, numbers, position

USUAL = (1.4, 4.0)
"""Diagonals (m) of the bounding boxes of clouds that the network gets as they are; it was trained on about 2.2."""

SIZE = 2.2
"""Diagonal (m) to which it gets others scaled: its ball radii are metres."""


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """One way in which the object may move, and how to take hold of it then. All in the cloud's frame, m.

    Attributes:
        probability: of this way; those of all hypotheses add up to 1.
        flow: [N, 3] f32, which way each point moves, largest norm about 1; 0 where nothing is known.
        contact_point: [3], which the suction cup touches.
        pull: [3] unit, the flow there: which way to pull.
        standoff: [3] unit, from the contact point to the hand.
        precontact_point: [3], where the straight approach along -standoff begins.
        rotation: [3, 3] R_cloud_tool of the gripper: its tool axis +x points from the hand to the suction tip. The spin
            about it is free: it is that of the shortest turn from the start.
        quaternion: [4] wxyz, w >= 0, the same.
    """

    probability: float
    flow: NDArray[np.float32]
    contact_point: Array
    pull: Array
    standoff: Array
    precontact_point: Array
    rotation: Array
    quaternion: Array


@dataclass(frozen=True, eq=False)
class Plan:
    """What :func:`plan` answers. All in the cloud's frame, m; the world frame is upright: z up, support at z = 0.

    Attributes:
        points: [N, 3] as they were given.
        foreground: [N] bool, on the object: measured, above its support, and not too far away.
        part: [N] bool, on the part to open; None without a mask.
        hypotheses: the most probable first, without those in which nothing moves.
        T_world_cloud: [4, 4] maps the cloud's frame to the world frame.
        camera: [3] where the camera stood.
        scale: by which the network saw the cloud enlarged.
        remarks: what was guessed, one sentence each.
    """

    points: NDArray[Any]
    foreground: NDArray[np.bool_]
    part: NDArray[np.bool_] | None
    hypotheses: tuple[Hypothesis, ...]
    T_world_cloud: Array
    camera: Array
    scale: float
    remarks: tuple[str, ...]

    def __getattr__(self, name: str) -> Any:
        """What the most probable hypothesis has: flow, contact_point, pull, standoff, precontact_point ..."""
        if name.startswith("_") or name not in Hypothesis.__dataclass_fields__:
            raise AttributeError(name)
        return getattr(self.hypotheses[0], name)


@torch.no_grad()
def plan(
    points: Any,
    mask: Any = None,
    camera: ArrayLike | None = None,
    *,
    model: ArtFlowNet | str = "pretrained",
    up: str | ArrayLike = "z",
    front: str | ArrayLike = "auto",
    tilt: float = 20.0,
    ground: float | None = None,
    foreground: bool = True,
    far: float = math.inf,
    tool_pose: ArrayLike | None = None,
    options: FlowPolicyOptions | None = None,
) -> Plan:
    """Plan how to open what a cloud shows.

    Args:
        points: [N, 3] m in any frame, as of :meth:`~fb3d_rl.models.artflownet.ArtFlowNet.predict`; any N.
        mask: [N], the part to open, likewise. None: whatever the network thinks moves most.
        camera: [3] where the camera stood, or its pose T_cloud_camera [4, 4], in the cloud's frame. None: it is guessed
            from what hides what.
        model: a network, a file of weights (.safetensors), or "pretrained".
        up: which way is up in the cloud's frame: "z", "y", "-y" ..., or a direction [3], such as minus gravity.
        front: where the front of the object is, likewise: the network knows objects from there. "auto": the side that
            the camera sees best, of the sides along the axes or of a body that stands askew.
        tilt: how far ``up`` may be off, degrees: a support plane within it is looked for, and its normal is up then.
        ground: height of the support along ``up`` (m), where it is known; None: that of the plane, or the lowest point.
        foreground: whether what lies on the support plane is left out, with points far sparser than the rest.
        far: distance from the camera (m) beyond which points are left out.
        tool_pose: [7] where the suction tip is now, p (m) + q (wxyz) in the cloud's frame: near points are preferred,
            as the policy does, and the orientation is the one with the least turning from there. None: the point of the
            largest flow, if a cup can hold it (supplement, I.E), and a turn from the world's axes.
        options: thresholds and distances of the flow policy.

    Raises:
        UserError: the cloud or the mask is none, nothing is left of it, or nothing is predicted to move.
    """
    net = ArtFlowNet.from_pretrained(model) if isinstance(model, str) else model
    options = options or FlowPolicyOptions()
    given = as_points(points).cpu()
    marked = None if mask is None else as_mask(mask, len(given))
    near, origin = near_origin(given)
    rows = places(finite(near))
    if len(rows) < 3:
        raise UserError(f"The cloud has {len(rows)} points that are finite: nothing is to be seen.")
    kept = rows[draw(len(rows), LARGEST)]
    place = None if camera is None else position(camera) - origin.double().numpy()
    scene = Setting.of(near[kept].double().numpy(), place, up, front, tilt, ground, foreground, far)
    inside, remarks = torch.from_numpy(scene.inside), list(scene.remarks)
    part = None if marked is None else marked[kept]
    if part is not None and not bool((part & inside).any()):
        raise UserError("The mask marks no point of the object: they are missing, on its support or too far away.")
    world, scale = torch.from_numpy(scene.points).float(), enlarging(scene.points[scene.inside])
    if scale != 1:
        remarks.append(f"the network saw the object {scale:.2f} times as large, of the size that it knows")
    if part is None and needs_mask(net):
        remarks.append("there is no mask: this network was trained with one, and is less sure without")
    about = part[inside] if part is not None else torch.ones(int(inside.sum()), dtype=torch.bool)
    asked = about if part is not None or needs_mask(net) else None
    found, probabilities = net.predict_all(world[inside] * scale, asked)
    flows = world.new_zeros(len(found), len(kept), 3)
    flows[:, inside] = found.cpu()
    grasps = [_grasp(scene, world, inside, part, flow, tool_pose, origin, options) for flow in flows]

    if not any(grasps):
        raise UserError("Nothing of the cloud is predicted to move: check the mask, up and the units (metres).")
    turned = flows if np.array_equal(scene.turn, np.eye(3)) else (flows.double() @ torch.from_numpy(scene.turn)).float()
    everywhere, shown = _to_all(turned, inside, near, rows, kept, marked)
    hypotheses = tuple(
        replace(grasp, probability=float(p), flow=flow.numpy())
        for grasp, p, flow in zip(grasps, probabilities, everywhere, strict=True)
        if grasp is not None
    )
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = scene.turn, -scene.turn @ (origin.double().numpy() + scene.base)
    stood = scene.turn.T @ scene.camera + scene.base + origin.double().numpy()
    all_marked = None if marked is None else marked.numpy()
    return Plan(given.numpy(), shown.numpy(), all_marked, hypotheses, pose, stood, scale, tuple(remarks))


def _to_all(
    flows: Tensor, inside: Tensor, near: Tensor, rows: Tensor, kept: Tensor, marked: Tensor | None
) -> tuple[Tensor, Tensor]:
    """From the kept points to all.

    Args:
        flows: [K, n, 3] of the kept points.
        inside: [n] bool, likewise.
        near: [N, 3] all points.
        rows: places of those that are measured.
        kept: [n] places of the kept points among all, n = len(rows) if they are the measured ones.
        marked: [N] bool, on the part.

    Returns:
        Flows [K, N, 3] and inside [N] bool.
    """
    source = torch.arange(len(rows))
    if len(kept) < len(rows):
        sides = torch.zeros(len(near), dtype=torch.bool) if marked is None else marked
        whole = len(rows) == len(near)
        source = nearest(near if whole else near[rows], near[kept], sides if whole else sides[rows], sides[kept])
        if whole:
            return flows.index_select(1, source), inside[source]
    everywhere = torch.zeros(len(flows), len(near), 3)
    everywhere[:, rows] = flows.index_select(1, source)
    shown = torch.zeros(len(near), dtype=torch.bool)
    shown[rows] = inside[source]
    return everywhere, shown


def _grasp(
    scene: Setting,
    world: Tensor,
    inside: Tensor,
    part: Tensor | None,
    flow: Tensor,
    tool_pose: ArrayLike | None,
    origin: Tensor,
    options: FlowPolicyOptions,
) -> Hypothesis | None:
    """What the flow policy would do with this flow [n, 3], as in its phase SELECT; the flow itself is left out. None if
    nothing moves.
    """
    rows = inside.nonzero().flatten()
    rows = rows[draw(len(rows), POINTS)]
    seen, moves = world[rows], flow[rows]
    on = None if part is None else part[rows]
    contact = options.contact
    start, tip = torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    turn, base = torch.from_numpy(scene.turn), torch.from_numpy(scene.base) + origin.double()
    if tool_pose is None:
        contact = replace(contact, near=0.0, turning=0.0)  # the supplement's rule
        axis = -start[:, 0]
    else:
        pose = numbers(tool_pose, (7,), "tool_pose")
        start, tip = turn @ quaternion_to_matrix(pose[3:]), turn @ (pose[:3] - base)
        axis = turn @ hand_axis(pose)
    if on is not None:
        moves = torch.where(on[:, None], moves, 0.0)
    chosen, _ = choose_contact(
        seen[None],
        torch.ones(1, len(seen), dtype=torch.bool),
        None if on is None else on[None],
        moves[None],
        torch.from_numpy(scene.camera).float()[None],
        tip.float()[None],
        axis.float()[None],
        torch.zeros(1, len(seen), dtype=torch.bool),
        contact,
    )
    point, pull, standoff = (x[0].double() for x in (chosen.point, chosen.flow, chosen.standoff))
    if not bool(pull.any()):
        return None
    lifted = above_ground(standoff[None], point[None], options.clearance)[0]
    rotation = turn.T @ rotate(start.T, alignment(axis, lifted).expand(3, 3)).T
    return Hypothesis(
        probability=1.0,
        flow=np.empty((0, 3), dtype=np.float32),
        contact_point=(turn.T @ point + base).numpy(),
        pull=(turn.T @ pull).numpy(),
        standoff=(turn.T @ standoff).numpy(),
        precontact_point=(turn.T @ (point + options.precontact * standoff) + base).numpy(),
        rotation=rotation.numpy(),
        quaternion=matrix_to_quaternion(rotation).numpy(),
    )


def enlarging(points: Array) -> float:
    """By how much the network is to see the cloud [n, 3] enlarged."""
    diagonal = float(np.linalg.norm(np.ptp(points, axis=0)))
    return 1.0 if USUAL[0] <= diagonal <= USUAL[1] else SIZE / max(diagonal, 1e-6)
