"""Options of the simulated environment and the trial it is reset to; no simulator is imported here."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.camera.raycast import CameraOptions
from fb3d_rl.camera.views import View, ViewRange
from fb3d_rl.errors import UserError
from fb3d_rl.kinematics.opening import openable_links, opening_range, start_fraction


@dataclass(frozen=True)
class GripperOptions:
    """Limits and drives of the floating gripper.

    Attributes:
        v_max: speed of each slide at action 1, m/s.
        w_max: speed of each hinge at action 1, rad/s.
        f_max: speed of each finger at action 1, m/s.
        force_limit: largest force of a slide's drive, N.
        torque_limit: largest torque of a hinge's drive, N m.
        finger_force_limit: largest force of a finger's drive, N.
        damping: velocity gain of the slides, N s/m: how hard they resist a velocity other than the commanded one.
        angular_damping: velocity gain of the hinges, N m s/rad.
        distance: distance (m) of the hand's origin in front of the object at the start.
    """

    v_max: float = 2.0
    w_max: float = 3.0
    f_max: float = 0.05
    force_limit: float = 3000.0
    torque_limit: float = 300.0
    finger_force_limit: float = 100.0
    damping: float = 10000.0
    angular_damping: float = 200.0
    distance: float = 0.6

    def start(self, bounds: NDArray[np.float64]) -> NDArray[np.float64]:
        """Where the hand's origin is at the start [3] (m), in front of an object within ``bounds`` [2, 3] (m).

        The hand looks along the world's x axis.
        """
        return np.array([bounds[0, 0] - self.distance, 0.0, 0.5 * (bounds[0, 2] + bounds[1, 2])])


@dataclass(frozen=True)
class SuctionOptions:
    """The spring that stands for suction (supplement, II.C: a strong force between gripper and part).

    Attributes:
        hold: "target" holds the part to open only, "any" every movable part.
        stiffness: of the spring between tip and part, N/m.
        damping: of the spring, N s/m.
        angular_damping: of the hand's free turning about the anchor, N m s/rad.
        breaking_force: the spring's force (N) above which suction is lost.
        max_stretch: the spring's length (m) above which suction is lost.
        touch: two surfaces that are closer than this (m), or press on each other, touch.
        reach: how far (m) from the tip's centre a finger may touch and still suck.
    """

    hold: Literal["target", "any"] = "target"
    stiffness: float = 45000.0
    damping: float = 3000.0
    angular_damping: float = 1.0
    breaking_force: float = math.inf
    max_stretch: float = 0.06
    touch: float = 0.002
    reach: float = 0.05


@dataclass(frozen=True)
class EnvOptions:
    """Options of the task.

    Attributes:
        gripper: drives of the gripper.
        suction: the suction spring.
        camera: the depth camera.
        views: where it may stand; trials that the environment draws have their view from here.
        start: how far the part to open is open at the start of such trials: "reference" (20 % in some categories, else
            closed), "closed" or "random" (up to 90 %).
        points: number N of points of an observed cloud.
        horizon: control steps after which an episode is truncated.
        success: an episode succeeds below this normalized distance.
        sim_freq: physics steps per second.
        control_freq: control steps per second; divides ``sim_freq``.
        gravity: whether gravity acts on the object (the gripper floats in any case). Off by default: PartNet-Mobility
            objects span about 2 m, so a laptop's lid would weigh 90 kg.
        joint_friction: PhysX's friction coefficient of the object's joints.
        joint_damping: rate (1/s) at which a joint that nobody pushes loses its speed. It is per inertia, since parts
            weigh from grams to 100 kg: light ones stay easy to open and heavy ones do not coast on after a push.
        density: of the object's parts, kg/m^3. Parts are hollow, but their hulls are solid and overlap: at the density
            of wood a wide drawer would weigh 600 kg.
    """

    gripper: GripperOptions = field(default_factory=GripperOptions)
    suction: SuctionOptions = field(default_factory=SuctionOptions)
    camera: CameraOptions = field(default_factory=CameraOptions)
    views: ViewRange = field(default_factory=ViewRange)
    start: Start = "reference"
    points: int = 1200
    horizon: int = 150
    success: float = 0.1
    sim_freq: int = 100
    control_freq: int = 20
    gravity: bool = False
    joint_friction: float = 0.1
    joint_damping: float = 5.0
    density: float = 100.0


@dataclass(frozen=True)
class Trial:
    """One scheduled episode.

    Attributes:
        object: the object's id.
        link: index of the link to open.
        start: joint state [J] (rad or m) in the order of the object's ``movable``.
        view: where the camera stands.
        seed: of the random draws within the episode.
        goal: position (rad or m) that the part's joint is to reach; None for fully open.
    """

    object: str
    link: int
    start: tuple[float, ...]
    view: View
    seed: int = 0
    goal: float | None = None

    def cloud_rng(self, step: int = 0) -> np.random.Generator:
        """Draws the cloud after so many control steps: one for each, so that a restored state sees the same again."""
        return np.random.default_rng([self.seed, step])

    def __str__(self) -> str:
        return f"object {self.object}, link {self.link}, seed {self.seed}"


Start = Literal["reference", "closed", "random"]
"""How far a part is open at the start: 20 % in some categories, else closed; closed; up to 90 %."""


def drawn_fraction(start: Start, rng: np.random.Generator) -> float | None:
    """How far a part is open at the start of a trial, for :func:`default_trial`; draws for "random" alone."""
    if start == "random":
        return float(rng.uniform(0.0, 0.9))
    return 0.0 if start == "closed" else None


def default_trial(
    obj: ArticulatedObject,
    link: int | None = None,
    view: View | None = None,
    seed: int = 0,
    fraction: float | None = None,
    goal: float | None = None,
) -> Trial:
    """The trial of the reference protocol: everything closed but the part to open, 20 % open in some categories.

    Args:
        obj: the object.
        link: the link to open; the first openable one unless given.
        view: the camera's view; from the front and 30 degrees above unless given.
        seed: of the random draws within the episode.
        fraction: how far the part is open at the start, where it is not the protocol's.
        goal: how far it is to be open at the end, a fraction, too; None for fully.

    Raises:
        UserError: nothing of the object can be opened.
    """
    if link is None:
        links = openable_links(obj)
        if not links:
            raise UserError(f"object {obj.id} has no part that opens; choose another object")
        link = links[0]
    closed, opened = opening_range(obj)
    start = closed.copy()
    j = obj.movable.index(link)
    start[j] += (start_fraction(obj.category) if fraction is None else fraction) * (opened[j] - closed[j])
    wanted = None if goal is None else float(closed[j] + goal * (opened[j] - closed[j]))
    return Trial(obj.id, link, tuple(float(q) for q in start), view or View(0.0, 30.0), seed, wanted)
