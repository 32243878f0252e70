"""An object in the simulator: built from its parsed model, with collision shapes that PhysX can simulate."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import sapien
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
from fb3d_rl.env.options import EnvOptions
from fb3d_rl.scene.posed import Posed

if TYPE_CHECKING:
    from mani_skill.envs.scene import ManiSkillScene
    from mani_skill.utils.structs import Articulation

OBJECT_BIT = 30
"""Bit of collision group 2 that the object's links and the ground share, so that they do not collide.

Parts of real objects overlap at rest and hulls overlap even more, so contact among them would jam every joint; and
an object on the ground would rub on it. The gripper has no such bit: it touches all of them.
"""


PLATE = 0.002
"""Thickness (m) of the plate that replaces a flat mesh; PhysX itself makes flat panes as thick."""


TENDON = 1e5
"""Stiffness (N m/rad or N/m) of the tendon between joints that move together. Stiffer ones swallow what is pushed."""

UNLIMITED = (-np.inf, np.inf)
"""Limits of a joint that follows another one, whose limits hold for both."""


def add_ground(scene: ManiSkillScene) -> None:
    """Add the plane z = 0, which does not collide with the object."""
    ground = scene.create_actor_builder()
    ground.add_plane_collision(sapien.Pose(q=[0.7071068, 0, -0.7071068, 0]))
    ground.collision_groups[2] |= 1 << OBJECT_BIT
    ground.initial_pose = sapien.Pose()
    ground.build_static(name="ground")


class Model(Posed):
    """An object with all that is computed once, although it is built into many scenes.

    Its further bodies are the gripper's: hand, left and right finger, each in its own frame.

    Args:
        obj: the object.
        options: the task's constants.
    """

    def __init__(self, obj: ArticulatedObject, options: EnvOptions) -> None:
        super().__init__(obj, options.camera, gripper_meshes())
        self._options = options

    @cached_property
    def shapes(self) -> list[list[Any]]:
        """Collision shapes of each link [L], cooked once: making them anew takes longer than the rest of a reset.

        Links that move collide as the convex hulls of their collision meshes, since PhysX simulates no others. Static
        links collide as both sides of the meshes' surface, placed in the world: a hull would close hollow bodies.
        """
        poses = self.poses(np.zeros(len(self.obj.movable)))
        shapes: list[list[Any]] = []
        for link, pose, moving in zip(self.obj.links, poses, self.tree.moves.tolist(), strict=True):
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

        It is built from its parsed model: the files are not trusted and are not parsed a second time.
        """
        obj, o = self.obj, self._options
        builder = scene.create_articulation_builder()
        builder.set_scene_idxs([e])
        builder.initial_pose = sapien.Pose(self.T_world_base)
        links: list[Any] = []
        for i, link in enumerate(obj.links):
            parent, offset = self._carrier(i)
            links.append(builder.create_link_builder(links[parent] if link.joint is not None else None))
            links[-1].set_name(link.name)
            if link.joint is None:
                links[-1].set_joint_properties("fixed", [], sapien.Pose(), sapien.Pose())
                continue
            links[-1].set_joint_name(link.joint.name)
            axis = sapien.Pose(_axis_frame(link.joint))
            # SAPIEN calls a hinge with limits "revolute_unwrapped" and one without "revolute".
            kinds = {"revolute": "revolute_unwrapped", "continuous": "revolute"}
            links[-1].set_joint_properties(
                kinds.get(link.joint.type, link.joint.type),
                [list(UNLIMITED if link.joint.mimic else link.joint.limits)] if link.joint.movable else [],
                sapien.Pose(offset @ link.joint.origin) * axis,
                axis,
            )
        articulation: Articulation = builder.build(name=f"object-{e}", fix_root_link=True)
        for joint in articulation.active_joints:
            joint.set_friction(o.joint_friction)
            joint.set_drive_properties(0.0, o.joint_damping, mode="acceleration")
        for follower, leader in obj.followers.items():
            self._couple(articulation, follower, leader)
        return articulation

    def _carrier(self, link: int) -> tuple[int, NDArray[np.float64]]:
        """The link to whose body a link is joined, and T_carrier_parent [4, 4]: its parent, as it is in the file.

        Where joints follow others it is the next link above that moves, or the root: PhysX couples joints only if no
        fixed one is between them.
        """
        parent, offset = self.obj.links[link].parent, np.eye(4)
        while self.obj.followers and parent > 0 and not (joint := self.obj.joint_of(parent)).movable:
            parent, offset = self.obj.links[parent].parent, joint.origin @ offset
        return parent, offset

    def _couple(self, articulation: Articulation, follower: int, leader: int) -> None:
        """Let a joint follow another one: by a tendon, a spring on ``follower - ratio * leader - offset``, both ways.

        A tendon runs over all joints that move between the two, of which the others have the coefficient 0.
        """
        ways = [[follower], [leader]]
        for way in ways:
            while way[0] > 0:
                way.insert(0, self._carrier(way[0])[0])
        while len(ways[0]) > 1 and len(ways[1]) > 1 and ways[0][1] == ways[1][1]:
            del ways[0][0], ways[1][0]
        if len(ways[0]) == 1 or len(ways[1]) == 1:  # one carries the other: the tendon starts above it
            above = self._carrier(ways[0][0])[0]
            ways = [[above, *way] for way in ways]
        chain = list(dict.fromkeys([*ways[0], *ways[1]]))
        multiplier, offset = self.tree.ratios[follower], self.tree.offsets[follower]
        factors = [{follower: 1.0, leader: -multiplier}.get(i, 0.0) for i in chain]
        links = [articulation.links_map[self.obj.links[i].name]._objs[0] for i in chain]
        articulation._objs[0].create_fixed_tendon(
            links, factors, [1.0 / factor if factor else 0.0 for factor in factors],
            rest_length=offset, stiffness=TENDON,
        )  # fmt: skip

    def add_shapes(self, links: Sequence[PhysxArticulationLinkComponent]) -> PhysxRigidStaticComponent:
        """Give the moving links their shapes; return a body with those of the static links.

        Only a static body can have a surface as its shape.
        """
        static = PhysxRigidStaticComponent()
        for component, shapes, moving in zip(links, self.shapes, self.tree.moves.tolist(), strict=True):
            for shape in shapes:
                (component if moving else static).attach(shape)
        return static


@contextmanager
def _quiet() -> Iterator[None]:
    """Without PhysX' warnings about meshes that are repaired here."""
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
    """The mesh's surface; a plate where PhysX finds it too thin.

    For PhysX a triangle has one side, but the faces of real meshes point either way or are open sheets.
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
    """The reversed faces [F, 3], without those that the mesh has already, as many of the dataset's meshes do."""
    number = np.unique(mesh.vertices.astype(np.float32), axis=0, return_inverse=True)[1].reshape(-1)

    def keys(faces: NDArray[np.int64]) -> NDArray[np.int64]:
        """Faces as numbers of their corners, the lowest first: the same for the same side of the same triangle."""
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
