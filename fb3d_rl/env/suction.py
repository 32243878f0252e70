"""Suction: a strong spring between the gripper's tip and the part that it touches (supplement, II.C)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from fb3d_rl.env.options import SuctionOptions

if TYPE_CHECKING:
    import sapien
    from mani_skill.envs.scene import ManiSkillScene
    from mani_skill.utils.structs import Articulation, Link
    from sapien.physx import PhysxArticulationLinkComponent, PhysxContactPoint, PhysxDriveComponent

Vector = NDArray[np.float64]


@dataclass
class Contacts:
    """The contacts of one gripper in a physics step.

    Attributes:
        impulse: net impulse [3] on the gripper, N s, world.
        touches: for each part that may be held where the fingers touch it, [3] each, m, world.
    """

    impulse: Vector
    touches: dict[int, list[Vector]]


class ContactImpulses:
    """Contacts of all environments where the simulator gives impulses but no points (on CUDA).

    A finger that presses on a part counts as touching it at the tip's centre.

    Args:
        scene: the scene of all environments.
        robot: the grippers.
        fingers: names of its links whose touch engages suction.
        body: names of all its links that have a shape.
        tool: name of the link at the suction tip.
        parts: for each environment the links that may be held, by number.
    """

    def __init__(
        self,
        scene: ManiSkillScene,
        robot: Articulation,
        fingers: Sequence[str],
        body: Sequence[str],
        tool: str,
        parts: Sequence[Mapping[int, Link]],
    ) -> None:
        from mani_skill.utils.structs import Link

        self._scene, self._robot, self._body = scene, robot, list(body)
        self._fingers = [robot.links_map[name] for name in fingers]
        self._tool = robot.links_map[tool]
        # The k-th part of every environment makes one view; environments with fewer parts repeat their last one.
        self._numbers = [list(own) for own in parts]
        views = range(max(map(len, parts)))
        chosen = [[own[numbers[min(k, len(own) - 1)]] for own, numbers in zip(parts, self._numbers, strict=True)]
                  for k in views]  # fmt: skip
        self._views = [Link.merge(links, name=f"holdable-{k}") for k, links in zip(views, chosen, strict=True)]

    def read(self) -> list[Contacts]:
        """The contacts of the physics step that was just made, one entry for each environment."""
        net = self._robot.get_net_contact_impulses(self._body).sum(1).double().cpu().numpy()
        contacts = [Contacts(impulse, {}) for impulse in net]
        for k, view in enumerate(self._views):
            pairs = [self._scene.get_pairwise_contact_impulses(finger, view) for finger in self._fingers]
            pressed = torch.stack(pairs).norm(dim=-1).amax(0).cpu() > 0
            for e in pressed.nonzero().flatten().tolist():
                tip = np.asarray(self._tool._objs[e].entity_pose.p, dtype=np.float64)
                contacts[e].touches.setdefault(self._numbers[e][min(k, len(self._numbers[e]) - 1)], [tip])
        return contacts


class Suction:
    """Holds the part that a finger of the gripper touches, until the spring breaks.

    The spring is linear and acts between the tip and the touched link. It is anchored on both where they touch, so
    that it is slack when it engages, and leaves the hand free to turn about the anchor.

    Args:
        scene: the scene of one environment.
        tool: the link at the suction tip, on which the spring pulls.
        fingers: links of the gripper whose touch engages suction.
        body: all links of the gripper that have a shape; their contact force is measured.
        parts: the links that may be held, by a number that names each; touching anything else never holds.
        options: the spring's constants.
    """

    def __init__(
        self,
        scene: sapien.Scene,
        tool: PhysxArticulationLinkComponent,
        fingers: Sequence[PhysxArticulationLinkComponent],
        body: Sequence[PhysxArticulationLinkComponent],
        parts: Mapping[int, PhysxArticulationLinkComponent],
        options: SuctionOptions,
    ) -> None:
        self.options = options
        self.held: int | None = None
        self.anchors: tuple[Vector, Vector] = (np.zeros(3), np.zeros(3))
        self._ends = np.zeros((2, 4))  # the anchors as homogeneous coordinates
        self._scene, self._tool = scene, tool
        self._fingers, self._body = frozenset(fingers), frozenset(body)
        self._parts = dict(parts)
        self._numbers = {link: number for number, link in parts.items()}
        self._drive: PhysxDriveComponent | None = None
        self._impulse = np.zeros(3)

    @property
    def attached(self) -> bool:
        """Whether a part is held."""
        return self.held is not None

    @property
    def stretch(self) -> float:
        """Length of the spring, m (0 while nothing is held)."""
        if self.held is None:
            return 0.0
        on_tool = self._tool.entity_pose.to_transformation_matrix() @ self._ends[0]
        between = (on_tool - self._parts[self.held].entity_pose.to_transformation_matrix() @ self._ends[1])[:3]
        return math.sqrt(between.dot(between))

    def contacts(self) -> Contacts:
        """The contacts of the physics step that was just made, where the simulator gives points (on the CPU)."""
        impulses: list[Vector] = []
        signs: list[float] = []
        touched: dict[int, list[Vector]] = {}
        for contact in self._scene.physx_system.get_contacts():
            first, second = contact.bodies
            if first in self._body:
                own, other, sign = first, second, 1.0
            elif second in self._body:
                own, other, sign = second, first, -1.0
            else:
                continue
            points = contact.points
            impulses.extend([point.impulse for point in points])
            signs.extend([sign] * len(points))
            number = self._numbers.get(other)
            if number is not None and own in self._fingers and not self.attached:
                touches = self._touches(points)
                if touches:
                    touched.setdefault(number, []).extend(touches)
        if not impulses:
            return Contacts(np.zeros(3), touched)
        return Contacts((np.array(impulses, dtype=np.float64) * np.array(signs)[:, None]).sum(0), touched)

    def update(self, contacts: Contacts) -> bool:
        """Hold, keep or lose a part after a physics step with these contacts.

        Returns:
            Whether a part is held that was not before.
        """
        self._impulse += contacts.impulse
        if self.attached:
            stretch = self.stretch
            if stretch > self.options.max_stretch or stretch * self.options.stiffness > self.options.breaking_force:
                self.release()
            return False
        touches = contacts.touches
        if touches:
            # The part with the touch nearest to the tip's centre; ties go to the lower number.
            tip = np.asarray(self._tool.entity_pose.p, dtype=np.float64)
            number = min(touches, key=lambda n: (min(np.linalg.norm(p - tip) for p in touches[n]), n))
            where = np.mean(touches[number], axis=0)
            self.hold(
                number,
                _to_local(self._tool.entity_pose, where),
                _to_local(self._parts[number].entity_pose, where),
            )
        return self.attached

    def _touches(self, points: Sequence[PhysxContactPoint]) -> list[Vector]:
        tip = np.asarray(self._tool.entity_pose.p, dtype=np.float64)
        return [
            position
            for point in points
            if (point.separation < self.options.touch or np.any(point.impulse))
            and np.linalg.norm((position := np.asarray(point.position, dtype=np.float64)) - tip) < self.options.reach
        ]

    def hold(self, number: int, on_tool: Vector, on_part: Vector) -> None:
        """Hold part ``number`` by a spring between the anchors [3] in the tool's and the part's frame, m."""
        import sapien

        self.release()
        part = self._parts[number]
        drive = self._scene.create_drive(self._tool, sapien.Pose(on_tool), part, sapien.Pose(on_part))
        for set_axis in (drive.set_drive_property_x, drive.set_drive_property_y, drive.set_drive_property_z):
            set_axis(self.options.stiffness, self.options.damping)
        drive.set_drive_property_slerp(0.0, self.options.angular_damping)
        self._drive, self.held, self.anchors = drive, number, (on_tool, on_part)
        self._ends = np.column_stack([self.anchors, np.ones(2)])

    def release(self) -> None:
        """Let go of the part, if one is held."""
        if self._drive is not None:
            self._drive.entity.remove_component(self._drive)
        self._drive, self.held = None, None

    @property
    def state(self) -> Vector:
        """Number of the part that is held, -1 for none, and the anchors, [7]."""
        return np.concatenate([[-1 if self.held is None else self.held], *self.anchors])

    def restore(self, state: Vector) -> None:
        """Go back to a :attr:`state` [7]."""
        held, on_tool, on_part = np.split(state, [1, 4])
        self.release()
        if held[0] >= 0:
            self.hold(int(held[0]), on_tool, on_part)

    def take_impulse(self) -> Vector:
        """Net contact impulse [3] on the gripper (N s, world) since the last call."""
        impulse, self._impulse = self._impulse, np.zeros(3)
        return impulse


def _to_local(pose: sapien.Pose, point: Vector) -> Vector:
    return np.asarray(pose.inv().to_transformation_matrix() @ np.append(point, 1.0))[:3]
