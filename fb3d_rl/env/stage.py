"""What stands in the scene of one environment: the object, built from what was read of it, and the running trial."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import sapien
import torch
from numpy.typing import NDArray
from sapien.physx import (
    PhysxArticulationLinkComponent,
    PhysxCollisionShapeConvexMesh,
    PhysxCollisionShapeTriangleMesh,
    PhysxRigidStaticComponent,
    get_default_material,
)

from fb3d_rl.assets.articulation import ArticulatedObject, Joint, Mesh
from fb3d_rl.assets.gripper import gripper_meshes
from fb3d_rl.camera.raycast import RaycastCamera
from fb3d_rl.env.options import EnvOptions, Trial
from fb3d_rl.env.suction import Suction
from fb3d_rl.errors import UserError
from fb3d_rl.kinematics.opening import box_bounds, box_corners, openable_links, opening_range, standing_pose
from fb3d_rl.kinematics.tree import KinematicTree

if TYPE_CHECKING:
    from mani_skill.envs.scene import ManiSkillScene
    from mani_skill.utils.structs import Articulation

OBJECT_BIT = 30
"""Bit of collision group 2 that the object's links and the ground share, so that they do not collide.

Parts of real objects overlap at rest and hulls overlap even more, so contact among them would jam every joint; and
an object that stands on the ground would rub on it. The gripper has no such bit: it touches all of them.
"""


PLATE = 0.002
"""Thickness (m) of what PhysX cannot make a body of; it makes flat panes as thick by itself."""


class Model:
    """What is computed of an object once, however often it is built into a scene.

    Attributes:
        object: the object.
        tree: its kinematic tree.
        closed: joint state [J] in which everything is closed.
        opened: joint state [J] in which everything is open.
        T_world_base: pose [4, 4] that stands it on the ground.
        links: what of it can be opened.
        gripper: meshes of the gripper's hand, left and right finger, each in its own frame.
    """

    def __init__(self, obj: ArticulatedObject, options: EnvOptions) -> None:
        self.object = obj
        self.tree = KinematicTree.from_object(obj)
        self.closed, self.opened = opening_range(obj)
        self.T_world_base = standing_pose(obj)
        self.links = openable_links(obj)
        self.gripper = gripper_meshes()
        self._options = options

    @cached_property
    def camera(self) -> RaycastCamera:
        """Sees the object's links and then the gripper's bodies."""
        return RaycastCamera(self.object, self.gripper, self._options.camera)

    @cached_property
    def shapes(self) -> list[list[Any]]:
        """Collision shapes of each link [L], cooked once: making them anew takes longer than the rest of a reset.

        What moves collides as the convex hulls of its collision meshes (more PhysX does not simulate), what does not
        move as both sides of their surface, placed in the world: a hull would close hollow bodies.
        """
        moves = self.tree.descendants.any(0).tolist()
        poses = self.poses(np.zeros(len(self.object.movable)))
        shapes: list[list[Any]] = []
        for link, pose, moving in zip(self.object.links, poses, moves, strict=True):
            shapes.append([])
            for mesh in link.collisions:
                if moving:
                    shape = _hull(mesh)
                    shape.set_density(self._options.density)
                else:
                    shape = _surface(mesh)
                    shape.local_pose = sapien.Pose(pose)
                shape.set_collision_groups([1, 1, 1 << OBJECT_BIT, 0])
                shapes[-1].append(shape)
        return shapes

    def build(self, scene: ManiSkillScene, e: int) -> Articulation:
        """Build the object in environment ``e``.

        It is built from what was read of it: its files are from strangers and are not parsed a second time.
        """
        obj, o = self.object, self._options
        builder = scene.create_articulation_builder()
        builder.set_scene_idxs([e])
        builder.initial_pose = sapien.Pose(self.T_world_base)
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
        articulation: Articulation = builder.build(name=f"object-{e}", fix_root_link=True)
        for joint in articulation.active_joints:
            joint.set_friction(o.joint_friction)
            joint.set_drive_properties(0.0, o.joint_damping, mode="acceleration")
        return articulation

    def add_shapes(self, links: Sequence[PhysxArticulationLinkComponent]) -> PhysxRigidStaticComponent:
        """Give the links their shapes; the result has those of what does not move.

        Only a static body can have a surface as its shape.
        """
        static = PhysxRigidStaticComponent()
        moves = self.tree.descendants.any(0).tolist()
        for component, shapes, moving in zip(links, self.shapes, moves, strict=True):
            for shape in shapes:
                (component if moving else static).attach(shape)
        return static

    def poses(self, state: Sequence[float] | NDArray[np.float64]) -> NDArray[np.float64]:
        """T_world_link [L, 4, 4] at a joint state [J]."""
        return np.asarray(self.T_world_base @ self.tree.forward(torch.as_tensor(state, dtype=torch.float64)).numpy())

    @cached_property
    def _corners(self) -> NDArray[np.float64]:
        return box_corners(self.object)

    def bounds(self, state: Sequence[float] | NDArray[np.float64]) -> NDArray[np.float64]:
        """Bounds [2, 3] (m, world) of the links' bounding boxes at a joint state [J]."""
        return box_bounds(self._corners, self.poses(state))


class Stage:
    """One of the parallel environments: the trial that runs there, and the object as it stands in its scene.

    Attributes:
        trial: the running trial.
        model: its object.
        target: position of the part's joint in a joint state [J].
        goal: position (rad or m) that this joint is to reach: the trial's, or that in which it is open.
        sense: +1 if the goal lies where the joint opens, -1 if the part has to be closed to get there.
        sign: +1 if the joint opens towards higher positions, -1 if towards lower ones.
        moved: [L] bool, the links that the joint carries.
        direction: [J], ``sign`` at the target and 0 elsewhere.
        scene: the environment's own scene.
        links: the object's links in the simulator, in the order of ``object.links``.
        order: column of each of the J joints in the simulator's joint state.
        static: what of the object collides as a surface.
        bodies: the gripper's links that have a shape.
        suction: holds the part.
    """

    scene: sapien.Scene
    links: list[PhysxArticulationLinkComponent]
    order: list[int]
    static: PhysxRigidStaticComponent
    bodies: list[PhysxArticulationLinkComponent]
    suction: Suction

    def __init__(self, trial: Trial, model: Model) -> None:
        obj = model.object
        if trial.link not in obj.movable or len(trial.start) != len(obj.movable):
            raise UserError(
                f"object {obj.id}: link {trial.link} with a start of {len(trial.start)} joints does not fit; "
                f"its movable links are {obj.movable}"
            )
        self.trial, self.model, self.target = trial, model, obj.movable.index(trial.link)
        opened, start = float(model.opened[self.target]), trial.start[self.target]
        self.goal = opened if trial.goal is None else trial.goal
        if abs(self.goal - start) < 1e-6:
            where = "fully open" if trial.goal is None else "at its goal"
            raise UserError(f"object {obj.id}: link {trial.link} starts {where}; choose another start or link")
        self.sign = 1.0 if opened > float(model.closed[self.target]) else -1.0
        self.sense = self.sign if self.goal > start else -self.sign
        self.moved = model.tree.descendants[self.target]
        self.direction = torch.zeros(len(obj.movable), dtype=torch.float64)
        self.direction[self.target] = self.sign

    def goals(self) -> NDArray[np.float64]:
        """Positions [J] (rad or m) in which each part counts as open, for the part to open its goal.

        Not a number where a joint opens nothing, or starts fully open.
        """
        goals = self.model.opened.copy()
        goals[self.target] = self.goal
        opens = np.isin(self.object.movable, self.model.links) & (np.abs(goals - np.array(self.trial.start)) > 1e-6)
        opens[self.target] = True
        return np.where(opens, goals, np.nan)

    @property
    def object(self) -> ArticulatedObject:
        """The object."""
        return self.model.object

    @property
    def tree(self) -> KinematicTree:
        """The object's kinematic tree."""
        return self.model.tree

    def place(self, trial: Trial) -> Stage:
        """Another trial with the object that is built here already."""
        stage = Stage(trial, self.model)
        for name in ("scene", "links", "order", "static", "bodies", "suction"):
            setattr(stage, name, getattr(self, name))
        return stage

    def poses(self) -> NDArray[np.float64]:
        """World poses [L + 3, 4, 4] of the object's links, then of the gripper's hand and fingers."""
        bodies = (*self.links, *self.bodies)
        return np.array([body.entity_pose.to_transformation_matrix() for body in bodies], dtype=np.float64)


@contextmanager
def _quiet() -> Iterator[None]:
    """PhysX' complaints about meshes that are mended."""
    sapien.set_log_level("off")
    try:
        yield
    finally:
        sapien.set_log_level("warn")  # SAPIEN's default; there is no way to ask for the present one


def _hull(mesh: Mesh) -> PhysxCollisionShapeConvexMesh:
    """The mesh's convex hull; a plate where that has no volume, such as that of a triangle."""
    # From points (not from the file) PhysX makes a thin plate of most flat meshes, such as a pane of glass.
    try:
        with _quiet():
            return PhysxCollisionShapeConvexMesh(mesh.vertices.astype(np.float32), [1.0] * 3, get_default_material())
    except RuntimeError:
        return PhysxCollisionShapeConvexMesh(_plate(mesh.vertices), [1.0] * 3, get_default_material())


def _surface(mesh: Mesh) -> PhysxCollisionShapeTriangleMesh | PhysxCollisionShapeConvexMesh:
    """The mesh's surface; a plate where that is too thin for PhysX to have any.

    For PhysX a triangle has one side, while real meshes look either way or are open sheets.
    """
    faces = np.concatenate([mesh.faces, _other_sides(mesh)]).astype(np.uint32)
    try:
        with _quiet():
            return PhysxCollisionShapeTriangleMesh(
                mesh.vertices.astype(np.float32), faces, [1.0] * 3, get_default_material()
            )
    except RuntimeError:
        return _hull(mesh)


def _other_sides(mesh: Mesh) -> NDArray[np.int64]:
    """The faces [F, 3] turned over, without those that the mesh holds already, as many of the dataset's do."""
    number = np.unique(mesh.vertices.astype(np.float32), axis=0, return_inverse=True)[1].reshape(-1)

    def keys(faces: NDArray[np.int64]) -> NDArray[np.int64]:
        """Faces by their corners' places, the lowest first: the same for the same side of the same triangle."""
        places = number[faces]
        first = places.argmin(1)[:, None]
        in_turn: NDArray[np.int64] = np.take_along_axis(places, (first + np.arange(3)) % 3, axis=1)
        return in_turn @ np.array([len(number) ** 2, len(number), 1])

    turned = mesh.faces[:, ::-1]
    return turned[~np.isin(keys(turned), keys(mesh.faces))]


def _plate(vertices: NDArray[np.float64]) -> NDArray[np.float32]:
    """Points [8 V, 3] whose hull is that of ``vertices`` [V, 3], grown to ``PLATE`` along axes where it is thinner."""
    spread = vertices - vertices.mean(0)
    axes = np.linalg.eigh(spread.T @ spread)[1].T
    lacks = np.maximum(PLATE - np.ptp(spread @ axes.T, axis=0), 0.0)
    grown = 0.5 * np.array(list(itertools.product((-1, 1), repeat=3))) * lacks @ axes
    return (vertices[:, None] + grown).reshape(-1, 3).astype(np.float32)


def _axis_frame(joint: Joint) -> NDArray[np.float64]:
    """T_joint_axis [4, 4] whose x axis is the joint's axis: PhysX's joints move along or about x."""
    frame = np.eye(4)
    if joint.movable:
        y = np.cross(joint.axis, np.eye(3)[np.abs(joint.axis).argmin()])
        y /= np.linalg.norm(y)
        frame[:3, :3] = np.stack([joint.axis, y, np.cross(joint.axis, y)], axis=1)
    return frame
