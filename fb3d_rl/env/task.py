"""The ManiSkill task: open a part of an articulated object with the floating suction gripper."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from typing import Any

warnings.filterwarnings("ignore", message="Failed to find system libvulkan")  # nothing is rendered

import numpy as np
import sapien
import torch
import trimesh
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils.registration import register_env
from mani_skill.utils.structs import Articulation
from mani_skill.utils.structs.types import SceneConfig, SimConfig
from numpy.typing import NDArray
from sapien.physx import (
    PhysxArticulationLinkComponent,
    PhysxCollisionShapeBox,
    PhysxCollisionShapeConvexMesh,
    PhysxCollisionShapeTriangleMesh,
    PhysxRigidStaticComponent,
    get_default_material,
)
from torch import Tensor

from fb3d_rl.assets.articulation import ArticulatedObject, Joint, Mesh
from fb3d_rl.camera.raycast import RaycastCamera
from fb3d_rl.contract import UserError
from fb3d_rl.env.gripper import BODIES, FINGERS, TOOL, FloatingSuctionGripper
from fb3d_rl.env.options import EnvOptions, Trial, default_trial
from fb3d_rl.env.suction import Suction
from fb3d_rl.flow.articulation_flow import articulation_flow, normalize_flow
from fb3d_rl.flow.kinematics import KinematicTree
from fb3d_rl.flow.opening import opening_range, standing_pose
from fb3d_rl.perception.cloud import sample_cloud

OBJECT_BIT = 30
"""Bit of collision group 2 that the object's links and the ground share, so that they do not collide.

Parts of real objects overlap at rest and hulls overlap even more, so contact among them would jam every joint; and
an object that stands on the ground would rub on it. The gripper has no such bit: it touches all of them.
"""


@register_env("OpenArticulated-v1")
class OpenArticulatedEnv(BaseEnv):
    """Open one part of an articulated object.

    **Task Description:**
    A floating suction gripper, commanded by eight velocities, opens the given part (a door, a drawer, a lid ...) of an
    object whose base is fixed. It sees the object as a cloud of points from one camera. Suction holds the part as
    soon as a finger touches it. Contact between gripper, object and ground is physical; the object's parts do not
    collide with each other. The collision shape of a part is the convex hull of each of its collision meshes, but for
    hollow bodies such as a pot (``options.hollow``).

    **Randomizations:**
    None of its own: a :class:`~fb3d_rl.env.options.Trial`, handed to ``reset(options={"trial": trial})``, fixes the
    object, the part, the joint state at the start, the camera's view and the seed of the points that are drawn from
    the depth image. The same trial gives the same bits: every reset builds a new scene, because PhysX keeps contacts
    and solver state of the episode before.

    **Success Conditions:**
    - the normalized distance |q_goal - q| / |q_goal - q_start| of the part's joint is below ``options.success``;
      q_goal is the joint limit that opens. The episode then terminates; it is truncated after ``options.horizon``
      control steps.

    Args:
        objects: the objects that trials may name.
        options: the task's constants.
        kwargs: for ManiSkill's ``BaseEnv``. ``obs_mode`` is "pointcloud", "state_dict" (no points) or "none".

    Raises:
        UserError: there is no object, or the first one has nothing to open.
    """

    SUPPORTED_OBS_MODES = ("pointcloud", "state_dict", "none")
    SUPPORTED_REWARD_MODES = ("normalized_dense", "sparse", "none")
    SUPPORTED_ROBOTS = [FloatingSuctionGripper.uid]
    agent: FloatingSuctionGripper
    scene: Any
    articulation: Any
    suction: Suction

    def __init__(self, objects: Iterable[ArticulatedObject], options: EnvOptions | None = None, **kwargs: Any) -> None:
        self.objects = {obj.id: obj for obj in objects}
        if not self.objects:
            raise UserError("the environment has no object; give it at least one")
        self.options = options or EnvOptions()
        self.trial = default_trial(next(iter(self.objects.values())))
        self._cameras: dict[str, RaycastCamera] = {}
        self._hollow: dict[str, frozenset[tuple[int, int]]] = {}
        super().__init__(
            robot_uids=FloatingSuctionGripper.uid,
            sim_config=dict(sim_freq=self.options.sim_freq, control_freq=self.options.control_freq),
            **{"sim_backend": "physx_cpu", "render_backend": "none", **kwargs},
        )

    @property
    def _default_sim_config(self) -> SimConfig:
        gravity = [0.0, 0.0, -9.81 if self.options.gravity else 0.0]
        return SimConfig(scene_config=SceneConfig(gravity=gravity))

    # ------------------------------------------------------------------------------------------------ reset

    def reset(
        self, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start an episode.

        Args:
            seed: unused; the trial has the seed.
            options: ``{"trial": Trial}``; without one the last trial is run again.

        Raises:
            UserError: the trial names an object or a part that does not exist, or that cannot be opened.
        """
        options = dict(options or {})
        self._set_trial(options.pop("trial", self.trial))
        return super().reset(seed=[self.trial.seed], options=options | {"reconfigure": True})

    def _set_trial(self, trial: Trial) -> None:
        obj = self.objects.get(trial.object)
        if obj is None:
            raise UserError(f"the trial's object {trial.object!r} is none of the environment's {len(self.objects)}")
        if trial.link not in obj.movable or len(trial.start) != len(obj.movable):
            raise UserError(
                f"object {obj.id}: link {trial.link} with a start of {len(trial.start)} joints does not fit; "
                f"its movable links are {obj.movable}"
            )
        joint = obj.movable.index(trial.link)
        goal = float(opening_range(obj)[1][joint])
        if abs(goal - trial.start[joint]) < 1e-6:
            raise UserError(f"object {obj.id}: link {trial.link} starts fully open; choose another start or link")
        self.trial, self.object, self.target, self.goal = trial, obj, joint, goal

    def _clear(self) -> None:
        # BaseEnv collects garbage here, which takes 0.2 s with torch loaded; the scene is freed without it.
        self._close_viewer()
        self.scene = None
        for name in ("agent", "suction", "articulation", "_links", "_bodies", "_static"):
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
        ground = self.scene.create_actor_builder()
        ground.add_plane_collision(sapien.Pose(q=[0.7071068, 0, -0.7071068, 0]))
        ground.collision_groups[2] |= 1 << OBJECT_BIT
        ground.initial_pose = sapien.Pose()
        ground.build_static(name="ground")
        self.tree = KinematicTree.from_object(self.object)
        base = standing_pose(self.object)
        self.T_world_base = torch.as_tensor(base)
        self.articulation = _build(self, self.object, base, self.options)
        links = self.articulation.links_map
        self._links: list[PhysxArticulationLinkComponent] = [links[link.name]._objs[0] for link in self.object.links]
        if self.object.id not in self._hollow:
            self._hollow[self.object.id] = _hollow_meshes(self.object, self.tree, self.options.hollow)
        self._static = _add_shapes(self.object, self._links, self._hollow[self.object.id], self.options.density)
        entity = sapien.Entity()
        entity.add_component(self._static)
        self.scene.sub_scenes[0].add_entity(entity)
        own = self.agent.robot.links_map
        self._bodies = [own[name]._objs[0] for name in BODIES]
        active = [joint.child_link.name for joint in self.articulation.active_joints]
        self._order = torch.tensor([active.index(self.object.links[i].name) for i in self.object.movable])
        joints = range(len(self.object.movable)) if self.options.suction.hold == "any" else [self.target]
        holdable = self.tree.descendants[list(joints)].any(0).nonzero().flatten().tolist()
        self.suction = Suction(
            self.scene.sub_scenes[0],
            tool=own[TOOL]._objs[0],
            fingers=[own[name]._objs[0] for name in FINGERS],
            body=self._bodies,
            parts={i: self._links[i] for i in holdable},
            options=self.options.suction,
        )
        if self.object.id not in self._cameras:
            boxes = [_box_meshes(body) for body in self._bodies]
            self._cameras[self.object.id] = RaycastCamera(self.object, boxes, self.options.camera)

    def _initialize_episode(self, env_idx: Tensor, options: dict[str, Any]) -> None:
        qpos = torch.zeros(self.num_envs, len(self._order))
        qpos[:, self._order] = torch.tensor(self.trial.start, dtype=torch.float32)
        self.articulation.set_qpos(qpos)
        solid = [body for body in (*self._links, self._static) if body.collision_shapes]
        boxes = np.stack([body.compute_global_aabb_tight() for body in solid])
        low, high = boxes[:, 0].min(0), boxes[:, 1].max(0)
        hand = torch.zeros(self.num_envs, 8)
        hand[:, 0] = float(low[0]) - self.options.gripper.distance
        hand[:, 2] = 0.5 * float(low[2] + high[2])
        self.agent.reset(hand)
        eye = self._cameras[self.object.id].pose(self.trial.view)[:3, 3]
        self._camera_position = torch.as_tensor(eye, dtype=torch.float32).repeat(self.num_envs, 1)
        self._rng = np.random.default_rng(self.trial.seed)
        self._contact = torch.zeros(self.num_envs, 1, dtype=torch.bool)
        self._force = torch.zeros(self.num_envs, 1)

    # ------------------------------------------------------------------------------------------------- step

    def step(self, action: Tensor) -> tuple[dict[str, Any], Tensor, Tensor, Tensor, dict[str, Any]]:
        """Make one control step; ``action`` [E, 8] in [-1, 1]."""
        obs, reward, terminated, _, info = super().step(action)
        truncated = (self._elapsed_steps >= self.options.horizon) & ~terminated
        return obs, reward, terminated, truncated, info

    def _after_simulation_step(self) -> None:
        self.suction.update()
        held = self.suction.held
        self._contact |= held is not None and bool(self.tree.descendants[self.target, held])

    def _after_control_step(self) -> None:
        self._force[:] = float(np.linalg.norm(self.suction.take_impulse())) / self.control_timestep

    def joint_positions(self) -> Tensor:
        """Joint state [E, J] of the object (rad or m) in the order of its ``movable``."""
        return self.articulation.get_qpos()[:, self._order]

    def evaluate(self) -> dict[str, Tensor]:
        """Metrics: normalized_distance [E, 1], contact [E, 1] (suction has held the part) and success [E]."""
        position = self.joint_positions()[:, [self.target]]
        # Signed, so that a part pushed past its limit by the solver's slack counts as open.
        distance = (self.goal - position) / (self.goal - self.trial.start[self.target])
        distance = distance.clamp_min(0.0)
        return {
            "normalized_distance": distance,
            "contact": self._contact.clone(),
            "success": (distance < self.options.success)[:, 0],
        }

    def compute_normalized_dense_reward(self, obs: Any, action: Tensor, info: dict[str, Any]) -> Tensor:
        """How far the part is open [E]: 0 at the start, 1 at the goal."""
        return (1.0 - info["normalized_distance"][:, 0]).clamp(0.0, 1.0)

    def compute_sparse_reward(self, obs: Any, action: Tensor, info: dict[str, Any]) -> Tensor:
        """1 on success, else 0 [E]."""
        return info["success"].float()

    # ------------------------------------------------------------------------------------------ observation

    def get_obs(self, info: dict[str, Any] | None = None, unflattened: bool = False) -> dict[str, Any]:
        """Observation and privileged truth, by the data contract's keys, each batched over E."""
        if self._obs_mode == "none":
            return {}
        robot = self.agent.robot
        obs: dict[str, dict[str, Tensor]] = {
            "observation": {
                "qpos": robot.get_qpos().clone(),
                "qvel": robot.get_qvel().clone(),
                "tool_pose": self.agent.tool_pose(),
                "attached": torch.full((self.num_envs, 1), self.suction.attached),
                "contact_force": self._force.clone(),
                "camera_position": self._camera_position.clone(),
            },
            "privileged": self._joint_truth(),
        }
        if self._obs_mode == "pointcloud":
            cloud, truth = self._cloud()
            obs["observation"] |= cloud
            obs["privileged"] |= truth
        return obs

    def _joint_truth(self) -> dict[str, Tensor]:
        joint = self.object.joint_of(self.trial.link)
        pose = self._links[self.trial.link].entity_pose.to_transformation_matrix()
        sign = 1.0 if self.goal > self.trial.start[self.target] else -1.0
        axis = torch.as_tensor(sign * pose[:3, :3] @ joint.axis, dtype=torch.float32)
        return {
            "joint_position": self.joint_positions()[:, [self.target]],
            "joint_axis": axis[None],
            "joint_origin": torch.as_tensor(pose[:3, 3], dtype=torch.float32)[None],
            "joint_prismatic": torch.full((self.num_envs, 1), joint.type == "prismatic"),
        }

    def _cloud(self) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        poses = np.stack([body.entity_pose.to_transformation_matrix() for body in (*self._links, *self._bodies)])
        points, ids = self._cameras[self.object.id].capture(poses.astype(np.float64), self.trial.view)
        on_object = ids < len(self._links)
        cloud, ids = sample_cloud(points[on_object], ids[on_object], self.options.points, self._rng)
        link = torch.from_numpy(ids)[None]
        world = torch.from_numpy(cloud)[None]
        direction = torch.zeros(self.num_envs, len(self.object.movable), dtype=torch.float64)
        direction[:, self.target] = 1.0 if self.goal > self.trial.start[self.target] else -1.0
        flow = articulation_flow(self.tree, world, link, self.joint_positions(), direction, self.T_world_base)
        valid = link >= 0
        part = self.tree.descendants[self.target][link.clamp_min(0)] & valid
        return (
            {"points": world, "valid": valid, "part_mask": part},
            {"flow": normalize_flow(flow), "link": link},
        )

    # ------------------------------------------------------------------------------------------------ state

    def get_state_dict(self) -> dict[str, Any]:
        """The simulation's state, with suction and the episode's counters."""
        held = -1 if self.suction.held is None else self.suction.held
        spring = np.concatenate([[held], *self.suction.anchors])
        state: dict[str, Any] = super().get_state_dict()
        state["suction"] = torch.as_tensor(spring, dtype=torch.float64)[None]
        state["episode"] = torch.cat([self._elapsed_steps[:, None], self._contact, self._force], dim=-1)
        return state

    def set_state_dict(self, state: dict[str, Any], env_idx: Tensor | None = None) -> None:
        """Restore a state of :meth:`get_state_dict`, taken in the same trial."""
        super().set_state_dict(state, env_idx)
        held, on_tool, on_part = np.split(state["suction"][0].numpy(), [1, 4])
        self.suction.release()
        if held[0] >= 0:
            self.suction.hold(int(held[0]), on_tool, on_part)
        elapsed, contact, force = state["episode"].split(1, dim=-1)
        self._elapsed_steps[:] = elapsed[:, 0].to(self._elapsed_steps.dtype)
        self._contact, self._force = contact.bool(), force.clone()

    # ---------------------------------------------------------------------------------------------- pictures

    def body_poses(self) -> NDArray[np.float64]:
        """World poses [L + 3, 4, 4] of the object's links, and of the gripper's hand, left and right finger."""
        poses = [body.entity_pose.to_transformation_matrix() for body in (*self._links, *self._bodies)]
        return np.stack(poses).astype(np.float64)

    def gripper_meshes(self) -> list[list[Mesh]]:
        """Meshes of the gripper's hand, left and right finger, each in its own frame."""
        return [_box_meshes(body) for body in self._bodies]


def _build(env: OpenArticulatedEnv, obj: ArticulatedObject, base: NDArray[np.float64], o: EnvOptions) -> Articulation:
    """Build the object from what was read of it: its files are from strangers and are not parsed a second time."""
    builder = env.scene.create_articulation_builder()
    builder.initial_pose = sapien.Pose(base)
    links: list[Any] = []
    for link in obj.links:
        links.append(builder.create_link_builder(links[link.parent] if link.joint is not None else None))
        links[-1].set_name(link.name)
        if link.joint is None:
            links[-1].set_joint_properties("fixed", [], sapien.Pose(), sapien.Pose())
            continue
        links[-1].set_joint_name(link.joint.name)
        axis = sapien.Pose(_axis_frame(link.joint))
        # SAPIEN calls a hinge with limits "revolute_unwrapped" and one that turns on and on "revolute".
        kinds = {"revolute": "revolute_unwrapped", "continuous": "revolute"}
        links[-1].set_joint_properties(
            kinds.get(link.joint.type, link.joint.type),
            [list(link.joint.limits)] if link.joint.movable else [],
            sapien.Pose(link.joint.origin) * axis,
            axis,
        )
    articulation: Articulation = builder.build(name="object", fix_root_link=True)
    for joint in articulation.active_joints:
        joint.set_friction(o.joint_friction)
        joint.set_drive_properties(0.0, o.joint_damping, mode="acceleration")
    return articulation


def _hollow_meshes(obj: ArticulatedObject, tree: KinematicTree, fraction: float) -> frozenset[tuple[int, int]]:
    """(link, collision mesh) of what cannot move and whose hull covers more than ``fraction`` of a closed part."""
    closed, _ = opening_range(obj)
    poses = tree.forward(torch.as_tensor(closed)).numpy()

    def in_base(link: int, mesh: Mesh) -> NDArray[np.float64]:
        return np.asarray(mesh.vertices @ poses[link, :3, :3].T + poses[link, :3, 3])

    moves = tree.descendants.any(0).tolist()
    parts = [
        np.concatenate([in_base(i, mesh) for mesh in link.visuals])
        for i, link in enumerate(obj.links)
        if moves[i] and link.visuals
    ]
    found = set()
    for i, link in enumerate(obj.links):
        for k, mesh in enumerate(() if moves[i] else link.collisions):
            points = in_base(i, mesh)
            low, high = points.min(0), points.max(0)
            # Cheap test first: most meshes are boards, whose bounding box holds no part.
            boxed = [part for part in parts if ((part > low) & (part < high)).all(-1).mean() > fraction]
            if boxed:
                hull = PhysxCollisionShapeConvexMesh(points.astype(np.float32), [1.0, 1.0, 1.0], get_default_material())
                corners = hull.vertices[hull.triangles]
                normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
                heights = (normals * corners[:, 0]).sum(-1)
                outward = np.sign(heights - normals @ hull.vertices.mean(0))
                covered = [((part @ normals.T - heights) * outward < 0).all(-1).mean() for part in boxed]
                if max(covered) > fraction:
                    found.add((i, k))
    return frozenset(found)


def _add_shapes(
    obj: ArticulatedObject,
    links: Sequence[PhysxArticulationLinkComponent],
    hollow: frozenset[tuple[int, int]],
    density: float,
) -> PhysxRigidStaticComponent:
    """Give the links the convex hull of each collision mesh; the result has the hollow ones, as surfaces.

    Only a static body can have a surface as its shape.
    """
    static = PhysxRigidStaticComponent()
    material, unscaled = get_default_material(), [1.0, 1.0, 1.0]
    for i, (link, component) in enumerate(zip(obj.links, links, strict=True)):
        for k, mesh in enumerate(link.collisions):
            vertices = mesh.vertices.astype(np.float32)
            if (i, k) in hollow:
                shape = PhysxCollisionShapeTriangleMesh(vertices, mesh.faces.astype(np.uint32), unscaled, material)
                shape.local_pose = component.entity_pose
            else:
                # From points (not from the file) PhysX makes a thin plate of a flat mesh, such as a pane of glass.
                shape = PhysxCollisionShapeConvexMesh(vertices, unscaled, material)
                shape.set_density(density)
            shape.set_collision_groups([1, 1, 1 << OBJECT_BIT, 0])
            (static if (i, k) in hollow else component).attach(shape)
    return static


def _axis_frame(joint: Joint) -> NDArray[np.float64]:
    """T_joint_axis [4, 4] whose x axis is the joint's axis: PhysX's joints move along or about x."""
    frame = np.eye(4)
    if joint.movable:
        y = np.cross(joint.axis, np.eye(3)[np.abs(joint.axis).argmin()])
        y /= np.linalg.norm(y)
        frame[:3, :3] = np.stack([joint.axis, y, np.cross(joint.axis, y)], axis=1)
    return frame


def _box_meshes(body: PhysxArticulationLinkComponent) -> list[Mesh]:
    """The boxes of one of the gripper's links as meshes in the link's frame, for the camera."""
    meshes = []
    for shape in body.collision_shapes:
        assert isinstance(shape, PhysxCollisionShapeBox)
        box = trimesh.creation.box(
            extents=2.0 * np.asarray(shape.half_size), transform=shape.local_pose.to_transformation_matrix()
        )
        meshes.append(Mesh(np.asarray(box.vertices, dtype=np.float64), np.asarray(box.faces, dtype=np.int64)))
    return meshes
