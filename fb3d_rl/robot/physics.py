"""The simulated cell's physics: arm, boxes and object as PhysX simulates them, without a renderer."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import sapien
import torch
from defusedxml import ElementTree
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.envs.utils.system.backend import parse_sim_and_render_backend
from numpy.typing import NDArray
from sapien.physx import (
    PhysxArticulation,
    PhysxArticulationLinkComponent,
    PhysxCollisionShapeBox,
    PhysxCollisionShapeCapsule,
    PhysxCollisionShapeSphere,
    PhysxCpuSystem,
    PhysxRigidStaticComponent,
    get_default_material,
)

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.env.model import OBJECT_BIT, Model
from fb3d_rl.env.options import EnvOptions
from fb3d_rl.robot.arm import Arm
from fb3d_rl.robot.collision import Box

Array = NDArray[np.float64]

ARM_BIT = 29
"""Bit of collision group 2 that the arm's links share: capsules are larger than links, so that neighbours overlap; what
keeps the arm off itself is planning and :func:`~fb3d_rl.robot.velocity.resolve`."""

GAINS = (4000.0, 400.0)
"""Stiffness (Nm/rad) and damping (Nm s/rad) of the arm's joints: they follow the velocity and its integral."""

ARMATURE = 0.05
"""Inertia of a joint's motor behind its gear, kg m^2 (ours)."""

TOOL_MASS = 0.6
"""Of cup and gripper, kg (ours)."""

EFFORT = 50.0
"""Largest torque of a joint whose URDF gives none, Nm."""


class TableModel(Model):
    """An object that stands on a table, in the base's frame as world.

    Args:
        obj: the object.
        place: T_base_world [4, 4] of the point on the table where its origin stands; its front faces -x there.
        masses: of its links [L], kg.
    """

    def __init__(self, obj: ArticulatedObject, place: Array, masses: Sequence[float], friction: float) -> None:
        super().__init__(obj, EnvOptions(joint_friction=friction))
        self.T_world_base = place @ self.T_world_base
        self.masses = masses

    def put(self, scene: ManiSkillScene) -> tuple[PhysxArticulation, list[PhysxArticulationLinkComponent]]:
        """Build it; the articulation and its links [L]."""
        built = self.build(scene, 0)
        links = [built.links_map[link.name]._objs[0] for link in self.obj.links]
        entity = sapien.Entity()
        entity.add_component(self.add_shapes(links))
        scene.sub_scenes[0].add_entity(entity)
        for link, mass in zip(links, self.masses, strict=True):
            if link.collision_shapes and mass > 0.0:
                share = mass / link.mass
                link.inertia = link.inertia * share
                link.mass = mass
        return built._objs[0], links


def new_scene(timestep: float) -> ManiSkillScene:
    """An empty scene with gravity, on one core, without a renderer."""
    scene = sapien.Scene([PhysxCpuSystem()])
    scene.set_timestep(timestep)
    backend = parse_sim_and_render_backend("cpu", "none")
    return ManiSkillScene([scene], device=torch.device("cpu"), backend=backend)


def add_boxes(scene: ManiSkillScene, boxes: Sequence[Box]) -> None:
    """Add the cell's static boxes, which the object does not collide with: it stands on one of them."""
    static = PhysxRigidStaticComponent()
    for box in boxes:
        shape = PhysxCollisionShapeBox((np.asarray(box.size) / 2).tolist(), get_default_material())
        shape.local_pose = sapien.Pose(box.pose)
        shape.set_collision_groups([1, 1, 1 << OBJECT_BIT, 0])
        static.attach(shape)
    entity = sapien.Entity()
    entity.add_component(static)
    scene.sub_scenes[0].add_entity(entity)


def add_arm(scene: ManiSkillScene, arm: Arm) -> PhysxArticulation:
    """Build an arm of its capsules, with the masses and torques of its URDF; gravity is compensated."""
    masses, efforts = _dynamics(arm)
    builder = scene.create_articulation_builder()
    builder.set_scene_idxs([0])
    builder.initial_pose = sapien.Pose()
    along = sapien.Pose(q=[np.sqrt(0.5), 0.0, -np.sqrt(0.5), 0.0])  # its x axis is the frame's z axis
    links: list[Any] = []
    limits = torch.stack([arm.lower, arm.upper], dim=-1).tolist()
    for i, parent in enumerate(arm.tree.parents):
        links.append(builder.create_link_builder(links[parent] if parent >= 0 else None))
        links[-1].set_name(f"arm_{i}")
        if parent < 0:
            links[-1].set_joint_properties("fixed", [], sapien.Pose(), sapien.Pose())
            continue
        links[-1].set_joint_name(f"arm_joint_{i}")
        j = arm.tree.joint_index[i]
        frame = sapien.Pose(_facing(arm.tree.axes[i].numpy())) if j >= 0 else along
        kind, limit = ("revolute_unwrapped", [limits[j]]) if j >= 0 else ("fixed", [])
        links[-1].set_joint_properties(kind, limit, sapien.Pose(arm.tree.origins[i].numpy()) * frame, frame)
    articulation = builder.build(name="arm", fix_root_link=True)._objs[0]
    for link in articulation.links:
        number = int(link.name.split("_")[-1])
        link.disable_gravity = True
        if number > 0:
            _shape(link, arm, number, masses[number])
    for joint, effort in zip(articulation.active_joints, efforts, strict=True):
        joint.set_drive_properties(*GAINS, force_limit=effort, mode="force")
        joint.set_armature([ARMATURE])
        joint.set_friction(0.0)
    articulation.set_qpos(arm.home.numpy().astype(np.float32))
    return articulation


def _facing(axis: Array) -> Array:
    """A pose [4, 4] whose x axis is an axis [3]."""
    pose = np.eye(4)
    y = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    y /= np.linalg.norm(y)
    pose[:3, :3] = np.stack([axis, y, np.cross(axis, y)], axis=1)
    return pose


def _shape(link: PhysxArticulationLinkComponent, arm: Arm, number: int, mass: float) -> None:
    """Give a link its capsules and its mass."""
    for ends, radius in zip(arm.ends[arm.links == number], arm.radii[arm.links == number], strict=True):
        way = ends[1] - ends[0]
        half = 0.5 * float(np.linalg.norm(way))
        material = get_default_material()
        pose = np.eye(4)
        if half > 1e-6:
            shape: Any = PhysxCollisionShapeCapsule(float(radius), half, material)
            pose = _facing(way / (2 * half))
        else:
            shape = PhysxCollisionShapeSphere(float(radius), material)
        pose[:3, 3] = ends.mean(0)
        shape.local_pose = sapien.Pose(pose)
        shape.set_collision_groups([1, 1, 1 << ARM_BIT, 0])
        link.attach(shape)
    if link.collision_shapes:
        link.inertia = link.inertia * (mass / link.mass)
        link.mass = mass
    else:
        link.mass = mass
        link.inertia = np.full(3, mass * 0.05**2)


def _dynamics(arm: Arm) -> tuple[list[float], list[float]]:
    """Masses (kg) of base, links and tip, and the largest torque (Nm) of each joint, of the arm's URDF."""
    root = ElementTree.parse(arm.urdf)
    joints: dict[str | None, Any] = {joint.get("name"): joint for joint in root.iter("joint")}
    links: dict[str | None, Any] = {link.get("name"): link for link in root.iter("link")}
    masses, efforts = [1.0], []
    for name in arm.joints:
        mass = links[joints[name].find("child").get("link")].find("inertial/mass")
        limit = joints[name].find("limit")
        masses.append(max(float(mass.get("value")), 0.1) if mass is not None else 1.0)
        efforts.append(float((limit.get("effort") if limit is not None else None) or EFFORT))
    return [*masses, TOOL_MASS], efforts
