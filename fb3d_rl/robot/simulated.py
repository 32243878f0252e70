"""The simulated cell: an arm, an object on the table and a camera, as a :class:`~fb3d_rl.robot.driver.Driver`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.camera.noise import EXACT, DepthNoiseOptions, incidence, measured
from fb3d_rl.drawing.bodies import GRIPPER, STATIC, link_colors
from fb3d_rl.errors import UserError
from fb3d_rl.flow.articulation_flow import articulation_flow, normalize_flow
from fb3d_rl.options import check, option
from fb3d_rl.perception.depth import Intrinsics
from fb3d_rl.perception.suction import CupOptions
from fb3d_rl.robot.arm import Arm
from fb3d_rl.robot.attempt import Observation
from fb3d_rl.robot.collision import box_distance
from fb3d_rl.robot.cup import SimulatedCup
from fb3d_rl.robot.driver import JointState, Picture, Wrench
from fb3d_rl.robot.physics import TableModel, add_arm, add_boxes, new_scene
from fb3d_rl.robot.sight import ArmSight, Bodies, box_mesh
from fb3d_rl.robot.workspace import CAMERA, CENTRE, TABLE, cell
from fb3d_rl.seeds import derived

Array = NDArray[np.float64]

LENS = Intrinsics(504.0, 504.0, 239.5, 207.5, 480, 416)
"""The middle of an Azure Kinect's depth image in its narrow mode without binning (640 x 576), about."""

SHAPE = (416, 480)

AIM = (CENTRE[0] - 0.1, CENTRE[1], 0.1)
"""What the camera looks at, m: the objects' fronts."""


@dataclass(frozen=True, eq=False)
class TableObject:
    """An object of table size that stands on the table.

    Attributes:
        obj: the object, m.
        link: the part to open.
        start: joint state [J] at the start, rad or m.
        place: x, y of the object's origin (m) and its turn about z (rad) in the base's frame; at turn 0 its front faces
            the robot, -x.
        masses: of the links [L], kg; those of links that do not move do not matter.
        friction: of each joint, as a coefficient of PhysX (:attr:`fb3d_rl.env.options.EnvOptions.joint_friction`).
        damping: of each joint, Nm s/rad or N s/m.
    """

    obj: ArticulatedObject
    link: int
    start: Sequence[float]
    place: tuple[float, float, float]
    masses: Sequence[float]
    friction: float = 0.05
    damping: float = 0.05

    @property
    def pose(self) -> Array:
        """T_base_world [4, 4]: where the object's standing frame is in the robot's."""
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("z", self.place[2]).as_matrix()
        pose[:3, 3] = *self.place[:2], TABLE
        return pose


@dataclass(frozen=True)
class CellOptions:
    """How real a simulated cell is."""

    noise: DepthNoiseOptions = field(default_factory=lambda: EXACT)
    suction: Literal["seal", "perfect"] = option(
        "seal", "seal: the surface decides whether the cup holds, and loads tear it; perfect: it always holds"
    )
    force_bias: float = option(2.0, "largest bias of the force at the tip along each axis", "N", "[0, inf)")
    force_noise: float = option(0.3, "standard deviation of the force along each axis", "N", "[0, inf)")
    rate: int = option(100, "control steps per second", "Hz", "[100, inf)")
    substeps: int = option(4, "physics steps in a control step", within="[1, inf)")
    cup: CupOptions = field(default_factory=CupOptions)

    def __post_init__(self) -> None:
        check(self)


class SimulatedCell:
    """A cell with one object; the methods of :class:`~fb3d_rl.robot.driver.Driver`, and the truth beside them.

    Args:
        arm: the arm; it starts at its home.
        content: the object on the table.
        options: errors and suction.
        session: seed of what stays the same in a session: the camera's bias and which bodies are dark.
        seed: of all else that is drawn in this trial.
        error: T_true_believed [4, 4] of the camera's calibration: what :attr:`believed` is off.

    Attributes:
        camera: the true T_base_camera [4, 4].
        believed: the calibrated one, ``camera @ error``.
    """

    def __init__(
        self,
        arm: Arm,
        content: TableObject,
        options: CellOptions | None = None,
        session: int = 0,
        seed: int = 0,
        error: Array | None = None,
    ) -> None:
        self.arm, self.content, self.options = arm, content, options or CellOptions()
        obj = content.obj
        if content.link not in obj.movable or len(content.start) != len(obj.movable):
            raise UserError(
                f"object {obj.id}: link {content.link} with a start of {len(content.start)} joints does not fit; "
                f"its movable links are {obj.movable}"
            )
        self.camera = looking(np.array(CAMERA), np.array(AIM))
        self.believed = self.camera if error is None else self.camera @ error
        self.model = TableModel(obj, content.pose, content.masses, content.friction)
        self._session, self._seed, self._frame = session, seed, 0
        self._rng = np.random.default_rng(derived(seed, "force"))
        self._bias = self._rng.uniform(-1.0, 1.0, 6) * self.options.force_bias * ([1.0] * 3 + [0.1] * 3)
        self._labels = np.zeros((0, 0), dtype=np.int64)
        self._build()

    def _build(self) -> None:
        o, content = self.options, self.content
        scene = new_scene(1.0 / (o.rate * o.substeps))
        boxes = cell()
        add_boxes(scene, boxes)
        self._arm = add_arm(scene, self.arm)
        self._object, self._links = self.model.put(scene)
        names = [joint.child_link.name for joint in self._object.active_joints]
        places = {link.name: i for i, link in enumerate(self._links)}
        moving = [places[name] for name in names]
        which = [*content.obj.movable, *content.obj.followers]
        self._columns = [moving.index(i) for i in which]
        for joint in self._object.active_joints:
            joint.set_drive_properties(0.0, content.damping, mode="force")
        state = np.zeros(len(which), dtype=np.float32)
        positions = self.model.tree.positions(torch.tensor(list(content.start), dtype=torch.float64)).numpy()
        state[self._columns] = positions
        self._object.set_qpos(state)
        self._scene = scene.sub_scenes[0]
        self._sight = ArmSight(self.arm)
        surfaces = [link.visuals for link in content.obj.links]
        self._moving = Bodies([*surfaces, *self._sight.meshes])
        # The camera sees neither itself nor the post that carries it.
        static = [box_mesh(box) for box in boxes if box_distance(self.camera[:3, 3], box) > 0.1]
        self._still, self._cell = Bodies([static]).depth(np.eye(4)[None], self.camera, LENS, SHAPE)
        self._cup = SimulatedCup(
            self._scene, self._arm.links[-1], self._links, Bodies(surfaces), o.cup, o.suction == "perfect"
        )
        self._target = np.asarray(self._arm.qpos, dtype=np.float64)
        self._time = 0.0
        self._command(np.zeros_like(self._target))
        self._scene.step()

    # ------------------------------------------------------------------------------------------------- the driver

    def joints(self) -> JointState:
        """See :class:`~fb3d_rl.robot.driver.Driver`."""
        position, velocity = (np.asarray(x, dtype=np.float64) for x in (self._arm.qpos, self._arm.qvel))
        return JointState(position, velocity, self._time)

    def wrench(self) -> Wrench:
        """See :class:`~fb3d_rl.robot.driver.Driver`."""
        truth = np.concatenate(self.true_wrench())
        noise = self._rng.standard_normal(6) * self.options.force_noise * ([1.0] * 3 + [0.1] * 3)
        felt = truth + self._bias + noise
        return Wrench(felt[:3], felt[3:])

    def move(self, velocity: Array) -> None:
        """See :class:`~fb3d_rl.robot.driver.Driver`."""
        velocity = np.asarray(velocity, dtype=np.float64)
        most = self.arm.velocity.numpy()
        if velocity.shape != self._target.shape or not (np.abs(velocity) <= most + 1e-6).all():  # NaN is not
            self._command(np.zeros_like(self._target))
            raise UserError("a joint velocity is not finite or beyond the arm's limits; the arm was stopped")
        self._command(velocity)
        for _ in range(self.options.substeps):
            self._scene.step()
        self._time += 1.0 / self.options.rate
        self._cup.update()

    def _command(self, velocity: Array) -> None:
        position = np.asarray(self._arm.qpos, dtype=np.float64)
        target = self._target + velocity / self.options.rate
        # What stops the arm does not wind up the drives further than their largest torques.
        self._target = np.clip(target, position - 0.02, position + 0.02)
        for joint, place, speed in zip(self._arm.active_joints, self._target.tolist(), velocity.tolist(), strict=True):
            joint.set_drive_target([place])
            joint.set_drive_velocity_target([speed])

    def suction(self, on: bool) -> bool:
        """See :class:`~fb3d_rl.robot.driver.Driver`."""
        if on:
            return self._cup.hold()
        self._cup.release()
        return False

    def picture(self) -> Picture:
        """See :class:`~fb3d_rl.robot.driver.Driver`."""
        poses = self.poses()
        depth, bodies = self._moving.depth(poses, self.camera, LENS, SHAPE)
        behind = (self._still > 0) & ((depth == 0) | (self._still < depth))
        depth, bodies = np.where(behind, self._still, depth), np.where(behind, len(poses), bodies)
        columns: Array = np.asarray((np.arange(SHAPE[1]) - LENS.cx) / LENS.fx, dtype=np.float64)
        rows: Array = np.asarray((np.arange(SHAPE[0]) - LENS.cy) / LENS.fy, dtype=np.float64)
        frame = derived(self._seed, "picture", self._frame) % 2**31
        shot = measured(depth, columns, rows, self.options.noise, self._session, frame, bodies)
        self._frame += 1
        shown = np.where(shot.source >= 0, bodies.ravel()[shot.source], -1)
        count = len(self._links)
        self._labels = np.where(shown < count, shown, np.where(shown < len(poses), -2, -3))
        shade = 0.35 + 0.65 * incidence(depth.astype(np.float64), columns, rows)
        colour = np.where(bodies[..., None] >= 0, shade[..., None] * self._colours[bodies], 0.0)
        return Picture(shot.depth.astype(np.float32), (255 * colour).astype(np.uint8), LENS, self._time)

    @cached_property
    def _colours(self) -> Array:
        """Of all bodies that are seen [B, 3]."""
        links = link_colors(self.content.obj, self.content.link)
        return np.array([*links, *[GRIPPER] * len(self._sight.meshes), STATIC])

    # -------------------------------------------------------------------------------------------------- the truth

    def poses(self) -> Array:
        """T_base_body [B, 4, 4] of all that moves: the object's links, then base, links and tip of the arm."""
        links = [link.entity_pose.to_transformation_matrix() for link in self._links]
        return np.concatenate([np.array(links, dtype=np.float64), self._sight.poses(self.joints().position)])

    def true_wrench(self) -> tuple[Array, Array]:
        """Force [3] and moment [3] at the tip without bias and noise."""
        at_joint = np.asarray(self._arm.get_link_incoming_joint_forces()[-1], dtype=np.float64)
        turn = np.asarray(self._arm.links[-1].entity_pose.to_transformation_matrix(), dtype=np.float64)[:3, :3]
        turn = turn @ _JOINT  # what the joint exerts on the tip balances what the world does
        return -turn @ at_joint[:3], -turn @ at_joint[3:]

    def flow(self, points: NDArray[np.floating]) -> Array:
        """The true flow [N, 3] of points [N, 3] (m, base) near the object's surface; the largest norm is 1."""
        poses = self.poses()[: len(self._links)]
        links = self._nearest_links(np.asarray(points, dtype=np.float64), poses)
        direction = self.model.direction(self.content.link)
        found = articulation_flow(
            self.model.tree, torch.as_tensor(points), torch.from_numpy(links), torch.from_numpy(poses), direction
        )
        return np.asarray(normalize_flow(found).double().numpy())

    def expert(self, observation: Observation) -> Array:
        """The predictor that knows the truth."""
        return self.flow(observation.points)

    def _nearest_links(self, points: Array, poses: Array) -> NDArray[np.int64]:
        """The link [N] whose surface each point is nearest to."""
        distance = np.stack(
            [
                tree.query((points - pose[:3, 3]) @ pose[:3, :3])[0]
                for tree, pose in zip(self._samples, poses, strict=True)
            ]
        )
        return distance.argmin(0)

    @cached_property
    def _samples(self) -> list[cKDTree]:
        """Points spread over each link's surface, in its frame."""
        import trimesh

        trees = []
        for i, link in enumerate(self.content.obj.links):
            points = [np.full((1, 3), 1e3)]
            for mesh in link.visuals:
                surface = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
                count = int(np.clip(surface.area / 0.004**2, 20, 20000))
                points.append(np.asarray(trimesh.sample.sample_surface(surface, count, seed=i)[0]))
            trees.append(cKDTree(np.concatenate(points)))
        return trees

    def labels(self) -> NDArray[np.int64]:
        """What each pixel [H, W] of the last picture truly shows: a link's index, -1 nothing, -2 arm, -3 the cell."""
        return self._labels

    def position(self) -> float:
        """Of the joint to open, rad or m."""
        column = self._columns[self.content.obj.movable.index(self.content.link)]
        return float(self._object.qpos[column])

    def distance(self) -> float:
        """Normalised distance to fully open: 1 at the start, 0 open."""
        joint = self.content.obj.movable.index(self.content.link)
        start, opened = self.content.start[joint], float(self.model.opened[joint])
        return float(np.clip((opened - self.position()) / (opened - start), 0.0, None))

    @property
    def held(self) -> int | None:
        """The link that the cup holds now."""
        return self._cup.held

    @property
    def cup(self) -> SimulatedCup:
        """The cup: why it did not seal or tore."""
        return self._cup


_JOINT = Rotation.from_quat([0.0, -np.sqrt(0.5), 0.0, np.sqrt(0.5)]).as_matrix()
"""R_tip_joint of the fixed joint that carries the tip."""


def looking(eye: Array, at: Array) -> Array:
    """T_base_camera [4, 4] of a camera at ``eye`` [3] (m) that looks at a point [3] (m), its image upright."""
    forward = (at - eye) / np.linalg.norm(at - eye)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = eye
    return pose
