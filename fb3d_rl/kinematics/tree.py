"""Forward kinematics of an articulated object, batched over joint states."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.geometry.transforms import axis_angle_to_matrix, rigid


@dataclass(frozen=True, eq=False)
class KinematicTree:
    """The joint tree of one object as tensors; L links, parents first, J joints that move by themselves, M that move.

    A joint that follows another one (mimic) has no position of its own: of the M >= J joints that move, the first J are
    those of a joint state, and each of the others is at ``ratio`` times the position of one of these plus an offset.

    Attributes:
        parents: parent's index of each link, -1 for the root.
        origins: T_parent_joint [L, 4, 4] at joint position 0.
        axes: unit joint axes [L, 3] in the joint's frame, which is the link's.
        joint_index: position in a joint state of what moves each link's joint, -1 for a fixed joint and the root.
        prismatic: whether each link's joint slides.
        movable: the link of each joint that moves [M], int64.
        descendants: [J, L] bool, the links that joint j moves: its own link, those of its followers, all links below.
        ratios: of each link's joint, 1 for one that moves by itself.
        offsets: likewise (rad or m), else 0.
    """

    parents: tuple[int, ...]
    origins: Tensor
    axes: Tensor
    joint_index: tuple[int, ...]
    prismatic: tuple[bool, ...]
    movable: Tensor
    descendants: Tensor
    ratios: tuple[float, ...]
    offsets: tuple[float, ...]

    @classmethod
    def from_object(cls, obj: ArticulatedObject, dtype: torch.dtype = torch.float64) -> KinematicTree:
        """Build the tree of ``obj``; positions of a joint state are in the order of ``obj.movable``."""
        joints = [link.joint for link in obj.links]
        order = {link: j for j, link in enumerate(obj.movable)}
        order |= {link: order[leader] for link, leader in obj.followers.items()}
        mimics = [None if joint is None else joint.mimic for joint in joints]
        descendants = torch.zeros(len(obj.movable), len(obj.links), dtype=torch.bool)
        for j, link in enumerate(obj.movable):
            descendants[j, list(obj.descendants(link))] = True
        return cls(
            parents=tuple(link.parent for link in obj.links),
            origins=torch.as_tensor(
                np.stack([np.eye(4) if joint is None else joint.origin for joint in joints]), dtype=dtype
            ),
            axes=torch.as_tensor(
                np.stack([np.zeros(3) if joint is None else joint.axis for joint in joints]), dtype=dtype
            ),
            joint_index=tuple(order.get(i, -1) for i in range(len(obj.links))),
            prismatic=tuple(joint is not None and joint.type == "prismatic" for joint in joints),
            movable=torch.tensor([*obj.movable, *obj.followers], dtype=torch.int64),
            descendants=descendants,
            ratios=tuple(1.0 if mimic is None else mimic.multiplier for mimic in mimics),
            offsets=tuple(0.0 if mimic is None else mimic.offset for mimic in mimics),
        )

    @cached_property
    def moves(self) -> Tensor:
        """Whether any joint moves each link [L] bool."""
        return self.descendants.any(0)

    @cached_property
    def screws(self) -> Tensor:
        """Axes [M, 3, 2] of joints that turn (first column) and that slide (second column) in their links' frames."""
        slides = torch.tensor(self.prismatic, device=self.axes.device)[self.movable, None]
        axes = self.axes[self.movable]
        return torch.stack([axes.masked_fill(slides, 0.0), axes.masked_fill(~slides, 0.0)], dim=-1)

    @cached_property
    def drivers(self) -> Tensor:
        """Position [M] in a joint state of what moves each joint."""
        return torch.tensor(self.joint_index, device=self.movable.device)[self.movable]

    @cached_property
    def ratio(self) -> Tensor:
        """How far each joint [M] moves for each rad or m of what moves it."""
        return torch.tensor(self.ratios, dtype=self.axes.dtype, device=self.axes.device)[self.movable]

    @cached_property
    def carried(self) -> Tensor:
        """[1 + L, M], 1 where joint m carries link i at row i + 1: row 0 is for points without a link (-1)."""
        below = torch.zeros(1 + len(self.parents), len(self.movable), dtype=self.axes.dtype, device=self.axes.device)
        below[self.movable + 1, torch.arange(len(self.movable))] = 1.0
        for i, parent in enumerate(self.parents):
            below[i + 1] = torch.maximum(below[i + 1], below[parent + 1])
        return below

    def positions(self, qpos: Tensor) -> Tensor:
        """Positions [..., M] (rad or m) of all joints that move at joint states ``qpos`` [..., J]."""
        offset = torch.tensor(self.offsets, dtype=self.axes.dtype, device=self.axes.device)[self.movable]
        return qpos.to(self.axes.dtype)[..., self.drivers] * self.ratio + offset

    def forward(self, qpos: Tensor) -> Tensor:
        """Link poses T_base_link [..., L, 4, 4] at joint states ``qpos`` [..., J] (rad or m)."""
        qpos = qpos.to(self.origins.dtype)
        if qpos.dim() == 1:
            # As in a batch: on some processors PyTorch multiplies single matrices by a routine that rounds otherwise.
            alone: Tensor = self.forward(qpos[None])[0]
            return alone
        batch = qpos.shape[:-1]
        eye = torch.eye(3, dtype=qpos.dtype, device=qpos.device)
        poses: list[Tensor] = []
        for i, parent in enumerate(self.parents):
            pose = self.origins[i].expand(*batch, 4, 4)
            if parent >= 0:
                pose = poses[parent] @ pose
            if (j := self.joint_index[i]) >= 0:
                axis, position = self.axes[i], qpos[..., j]
                if self.ratios[i] != 1.0 or self.offsets[i]:
                    position = self.ratios[i] * position + self.offsets[i]
                if self.prismatic[i]:
                    moved = rigid(eye, axis * position[..., None])
                else:
                    moved = rigid(axis_angle_to_matrix(axis.expand(*batch, 3), position), torch.zeros_like(axis))
                pose = pose @ moved
            poses.append(pose)
        return torch.stack(poses, dim=-3)
