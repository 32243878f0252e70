"""Options of the simulated environment and the trial it is reset to; no simulator is imported here."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from fb3d_rl.camera.options import CameraOptions
from fb3d_rl.camera.views import View, ViewRange
from fb3d_rl.errors import UserError
from fb3d_rl.options import group, option

if TYPE_CHECKING:
    from fb3d_rl.assets.articulation import ArticulatedObject


Start = Literal["reference", "closed", "random"]
"""How far a part is open at the start: 20 % in some categories, else closed; closed; up to 90 %."""


@dataclass(frozen=True)
class GripperOptions:
    """Limits and drives of the floating gripper."""

    v_max: float = option(2.0, "speed of each slide at action 1", "m/s")
    w_max: float = option(3.0, "speed of each hinge at action 1", "rad/s")
    f_max: float = option(0.05, "speed of each finger at action 1", "m/s")
    force_limit: float = option(3000.0, "largest force of a slide's drive", "N")
    torque_limit: float = option(300.0, "largest torque of a hinge's drive", "N m")
    finger_force_limit: float = option(100.0, "largest force of a finger's drive", "N")
    damping: float = option(
        10000.0, "velocity gain of the slides: how hard they resist a velocity other than the commanded one", "N s/m"
    )
    angular_damping: float = option(200.0, "velocity gain of the hinges", "N m s/rad")
    distance: float = option(0.6, "distance of the hand's origin in front of the object at the start", "m")

    def start(self, bounds: NDArray[np.float64]) -> NDArray[np.float64]:
        """The hand's origin at the start [3] (m), in front of an object within ``bounds`` [2, 3] (m).

        The hand points along the world's x axis.
        """
        return np.array([bounds[0, 0] - self.distance, 0.0, 0.5 * (bounds[0, 2] + bounds[1, 2])])


@dataclass(frozen=True)
class SuctionOptions:
    """The spring that models suction (supplement, II.C: a strong force between gripper and part)."""

    hold: Literal["target", "any"] = option(
        "target",
        "what suction holds: the part to open only, or every movable part",
        null="any where policy.mask is none, else target",
    )
    stiffness: float = option(45000.0, "stiffness of the spring between tip and part", "N/m")
    damping: float = option(3000.0, "damping of the spring", "N s/m")
    angular_damping: float = option(1.0, "damping of the hand's free rotation about the anchor", "N m s/rad")
    breaking_force: float = option(math.inf, "the spring's force above which suction is lost", "N")
    max_stretch: float = option(0.06, "the spring's length above which suction is lost", "m")
    touch: float = option(0.002, "surfaces closer than this, or with a contact impulse, count as touching", "m")
    reach: float = option(0.05, "largest distance between tip and contact point at which suction engages", "m")


@dataclass(frozen=True)
class EnvOptions:
    """The simulated task. ``start`` is for trials that the environment draws itself, ``points`` is N of a cloud."""

    gripper: GripperOptions = group(GripperOptions)
    suction: SuctionOptions = group(SuctionOptions)
    camera: CameraOptions = CameraOptions()
    views: ViewRange = ViewRange()
    start: Start = "reference"
    points: int = 1200
    horizon: int = option(150, "length at which an episode is truncated", "control steps", "[1, inf)")
    success: float = option(0.1, "normalized distance below which a part is open")
    sim_freq: int = option(100, "physics steps per second", "Hz")
    control_freq: int = option(20, "control steps per second; divides sim_freq", "Hz", "[1, inf)")
    # PartNet-Mobility objects span about 2 m, so a laptop's lid would weigh 90 kg.
    gravity: bool = option(False, "whether gravity acts on the object; the gripper floats in any case")
    joint_friction: float = option(0.1, "PhysX's friction coefficient of the object's joints")
    # Parts weigh from grams to 100 kg: light ones stay easy to open and heavy ones do not coast on after a push.
    joint_damping: float = option(5.0, "rate at which a joint that nobody pushes loses its speed, per inertia", "1/s")
    # Parts are hollow, but their hulls are solid and overlap: at the density of wood a wide drawer would weigh 600 kg.
    density: float = option(100.0, "of the convex hulls of the object's parts; furniture is hollow", "kg/m^3")

    task: str | None = option(
        None,
        "a task of ManiSkill in place of opening parts, such as PickCube-v1: algo=bc or dagger, with expert.target",
    )
    task_options: dict[str, Any] = option({}, "of env.task: arguments of gymnasium.make, such as control_mode")
    sees: Literal["state", "points"] = option(
        "state",
        "of env.task, what the learner sees: the state of all that is there, or what the robot feels and a cloud of "
        "data.points points, which needs a renderer",
    )

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> EnvOptions:
        """The inverse of ``dataclasses.asdict``, also once that has been through JSON; what is left out is the default.

        Raises:
            UserError: there is no such option.
        """
        kinds: dict[str, Any] = {
            "gripper": GripperOptions, "suction": SuctionOptions, "camera": CameraOptions, "views": ViewRange,
        }  # fmt: skip
        try:
            given = {name: kinds[name](**value) if name in kinds else value for name, value in values.items()}
            if "views" in given:
                ranges = {name: tuple(ends) for name, ends in asdict(given["views"]).items()}
                given["views"] = ViewRange(**ranges)
            return cls(**given)
        except TypeError as error:
            raise UserError(f"the task's options {dict(values)} are none of this version ({error})") from error


@dataclass(frozen=True)
class Trial:
    """One scheduled episode.

    Attributes:
        object: the object's id.
        link: index of the link to open.
        start: joint state [J] (rad or m) in the order of the object's ``movable``.
        view: the camera's viewpoint.
        seed: seed of the random draws within the episode.
        goal: position (rad or m) that the part's joint is to reach; None for fully open.
    """

    object: str
    link: int
    start: tuple[float, ...]
    view: View
    seed: int = 0
    goal: float | None = None

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Trial:
        """The inverse of ``dataclasses.asdict``, also once that has been through JSON.

        Raises:
            UserError: it is no trial.
        """
        try:
            return cls(**{**values, "start": tuple(values["start"]), "view": View(**values["view"])})
        except (TypeError, KeyError) as error:
            raise UserError(
                f"{dict(values)} is no trial; give object, link, start, and view with azimuth and elevation"
            ) from error

    def cloud_rng(self, step: int = 0) -> np.random.Generator:
        """The generator of the cloud after ``step`` control steps; a restored state sees the same cloud."""
        return np.random.default_rng([self.seed, step])

    def __str__(self) -> str:
        return f"object {self.object}, link {self.link}, seed {self.seed}"


def drawn_fraction(start: Start, rng: np.random.Generator) -> float | None:
    """How far a part is open at the start of a trial, for :func:`default_trial`; draws for "random" only."""
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
        seed: seed of the random draws within the episode.
        fraction: how far the part is open at the start; the protocol's share unless given.
        goal: how far it is to be open at the end, a fraction; None for fully open.

    Raises:
        UserError: nothing of the object can be opened.
    """
    # Imported late: it imports torch, which takes seconds, and the configuration's checks need none of it.
    from fb3d_rl.kinematics.opening import openable_links, opening_range, start_fraction

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
