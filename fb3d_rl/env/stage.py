"""The content of one environment's scene: the object, the gripper's suction, and the running trial."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import sapien
from numpy.typing import NDArray
from sapien.physx import PhysxArticulationLinkComponent, PhysxRigidStaticComponent
from torch import Tensor

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.assets.gripper import BODIES, FINGERS, TOOL
from fb3d_rl.camera.sapien import add_visuals
from fb3d_rl.drawing.bodies import GRIPPER, Body, Part, link_colors
from fb3d_rl.drawing.camera import Camera
from fb3d_rl.drawing.studio import Studio
from fb3d_rl.env.model import Model
from fb3d_rl.env.options import SuctionOptions, Trial
from fb3d_rl.env.suction import Suction
from fb3d_rl.errors import UserError
from fb3d_rl.kinematics.tree import KinematicTree
from fb3d_rl.scene.observer import observe

if TYPE_CHECKING:
    from mani_skill.envs.scene import ManiSkillScene
    from mani_skill.utils.structs import Articulation


class Stage:
    """One of the parallel environments: its running trial, and the object in its scene.

    Attributes:
        trial: the running trial.
        model: the trial's object.
        target: position of the part's joint in a joint state [J].
        goal: position (rad or m) that this joint is to reach: the trial's goal, else fully open.
        sense: +1 if the joint opens towards the goal, -1 if it closes towards it.
        sign: +1 if the joint opens towards higher positions, -1 if towards lower ones.
        moved: [L] bool, the links that the joint carries.
        direction: [J], ``sign`` at the target and 0 elsewhere.
        prismatic: whether the joint slides.
        camera_pose: T_world_camera [4, 4].
        scene: the environment's own scene.
        links: the object's links in the simulator, in the order of ``object.links``.
        order: column of each of the J joints in the simulator's joint state.
        led: columns of the joints that follow these.
        static: the body with the static links' collision surfaces.
        gripper: the gripper's links by name.
        suction: the suction of its gripper.
    """

    scene: sapien.Scene
    links: list[PhysxArticulationLinkComponent]
    order: list[int]
    led: list[int]
    static: PhysxRigidStaticComponent
    gripper: dict[str, PhysxArticulationLinkComponent]
    suction: Suction

    def __init__(self, trial: Trial, model: Model) -> None:
        obj = model.obj
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
        self.direction = model.direction(trial.link)
        self.sign = float(self.direction[self.target])
        self.sense = self.sign if self.goal > start else -self.sign
        self.moved = model.tree.descendants[self.target]
        self.prismatic = obj.joint_of(trial.link).type == "prismatic"
        self.camera_pose = model.camera.pose(trial.view)

    def goals(self) -> NDArray[np.float64]:
        """Positions [J] (rad or m) in which each part counts as open, for the part to open its goal.

        NaN where a joint opens nothing, or starts fully open.
        """
        goals = self.model.opened.copy()
        goals[self.target] = self.goal
        opens = np.isin(self.object.movable, self.model.openable) & (np.abs(goals - np.array(self.trial.start)) > 1e-6)
        opens[self.target] = True
        return np.where(opens, goals, np.nan)

    @property
    def object(self) -> ArticulatedObject:
        """The object."""
        return self.model.obj

    @property
    def tree(self) -> KinematicTree:
        """The object's kinematic tree."""
        return self.model.tree

    @property
    def bodies(self) -> list[PhysxArticulationLinkComponent]:
        """The object's links, then those of the gripper that have a shape, as the camera numbers them."""
        return [*self.links, *(self.gripper[name] for name in BODIES)]

    # ------------------------------------------------------------------------------------------------ building

    def build(self, scene: ManiSkillScene, e: int, gripper: Mapping[str, Any]) -> Articulation:
        """Build the object in environment ``e``.

        Args:
            scene: the scene of all environments.
            e: number of the environment.
            gripper: the links of all environments' grippers by name.
        """
        articulation = self.model.build(scene, e)
        self.scene = scene.sub_scenes[e]
        self.links = [articulation.links_map[link.name]._objs[0] for link in self.object.links]
        active = [joint.child_link.name for joint in articulation.active_joints]
        self.order, self.led = (
            [active.index(self.object.links[i].name) for i in which]
            for which in (self.object.movable, self.object.followers)
        )
        self.gripper = {name: link._objs[e] for name, link in gripper.items()}
        self.static = self.model.add_shapes(self.links)
        entity = sapien.Entity()
        entity.add_component(self.static)
        self.scene.add_entity(entity)
        return articulation

    def show(self) -> None:
        """Make all bodies visible to SAPIEN's renderer."""
        for i, (body, meshes) in enumerate(zip(self.bodies, self.model.visuals, strict=True)):
            add_visuals(body.entity, meshes, i)

    def place(self, trial: Trial) -> Stage:
        """The stage of another trial with the object that is already built."""
        stage = Stage(trial, self.model)
        for name in ("scene", "links", "order", "led", "static", "gripper", "suction"):
            setattr(stage, name, getattr(self, name))
        return stage

    def holdable(self, hold: str) -> list[int]:
        """The links that suction may hold, by :attr:`fb3d_rl.env.options.SuctionOptions.hold`."""
        parts = self.tree.moves if hold == "any" else self.moved
        return [int(i) for i in parts.nonzero().flatten()]

    def begin(self, options: SuctionOptions) -> None:
        """Begin the trial: suction lets go of what it held, and may hold what this trial allows."""
        if hasattr(self, "suction"):
            self.suction.release()
        self.suction = Suction(
            self.scene,
            tool=self.gripper[TOOL],
            fingers=[self.gripper[name] for name in FINGERS],
            body=[self.gripper[name] for name in BODIES],
            parts={i: self.links[i] for i in self.holdable(options.hold)},
            options=options,
        )

    # ------------------------------------------------------------------------------------------- observation

    def poses(self) -> NDArray[np.float64]:
        """World poses [L + 3, 4, 4] of the object's links, then of the gripper's hand and fingers."""
        return np.array([body.entity_pose.to_transformation_matrix() for body in self.bodies], dtype=np.float64)

    def observe(
        self,
        poses: NDArray[np.float64],
        count: int,
        step: int,
        seen: tuple[NDArray[np.float64], NDArray[np.int64]] | None = None,
    ) -> dict[str, Tensor]:
        """The camera's cloud with its ground truth (:meth:`fb3d_rl.scene.observer.Cloud.with_truth`).

        Args:
            poses: the result of :meth:`poses`.
            count: number N of points.
            step: number of control steps made.
            seen: points and links of SAPIEN's picture; the ray caster takes one unless given.
        """
        rng = self.trial.cloud_rng(step)
        return observe(self.model, poses, self.trial.view, count, rng, seen).with_truth(self.direction)

    def joint_truth(self, poses: NDArray[np.float64]) -> NDArray[np.float32]:
        """The axis (towards opening) and the origin of the joint to open, in the world, [6]."""
        joint, pose = self.object.joint_of(self.trial.link), poses[self.trial.link]
        return np.concatenate([self.sign * pose[:3, :3] @ joint.axis, pose[:3, 3]]).astype(np.float32)

    def picture(self, size: int) -> NDArray[np.uint8]:
        """A picture [size, size, 3] from the trial's view, shaded on the CPU."""
        colors = [*link_colors(self.object, self.trial.link), *[GRIPPER] * len(BODIES)]
        body = Body(Part(*each) for each in zip(self.model.visuals, colors, self.poses(), strict=True))
        return Studio(Camera.fitting(self.trial.view, body.outline(), (size, size)), body).picture()
