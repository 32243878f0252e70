"""What one attempt to open a part is given and gives: options, what a predictor sees, and how it went."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, Protocol, TypeAlias, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from fb3d_rl.options import check, option
from fb3d_rl.perception.suction import CupOptions, PlaceOptions

Array = NDArray[np.float64]

STAGES = ("seen", "segmented", "planned", "touched", "sealed", "moved", "opened")
"""What has to go well, in this order."""

OPEN = 0.1
"""A part is open if less than this share of the opening is left (supplement, IV: opened by more than 90 %)."""


@dataclass(frozen=True)
class AttemptOptions:
    """How an attempt moves, feels and gives up."""

    standoff: float = option(0.1, "distance from the contact at which the planned motion ends", "m", "(0, 0.5]")
    contacts: int = option(
        6,
        "contacts that are looked at until the arm can come to one and follow the part; the supplement has one",
        within="[1, inf)",
    )
    apart: float = option(0.04, "distance between these", "m", "(0, inf)")
    grips: int = option(
        3,
        "grips at most: after one that does not hold, or does not move the part, the arm goes back, looks again, and "
        "tries another place or another answer of the network; the supplement has one",
        within="[1, inf)",
    )
    approach_speed: float = option(0.025, "of the guarded approach", "m/s", "(0, 0.1]")
    approach_limit: float = option(0.15, "way of the guarded approach after which nothing was touched", "m", "(0, 0.5]")
    touch_force: float = option(
        4.0, "force against the approach, filtered and without bias, that is a touch", "N", "(0, inf)"
    )
    filter: float = option(20.0, "cut-off frequency of the force's low-pass filter", "Hz", "(0, inf)")
    settle: float = option(0.3, "how long the arm stands still while the force's bias is measured", "s", "(0, inf)")
    vacuum_time: float = option(0.5, "how long the vacuum may take", "s", "[0, inf)")
    pull_speed: float = option(0.05, "of the held point, times the normalised flow", "m/s", "(0, 0.2]")
    turn_gain: float = option(4.0, "angular velocity per angle between the cup's axis and the flow", "1/s", "[0, inf)")
    yield_gain: float = option(
        0.005,
        "velocity per force across the flow, to which a pull yields; 0 is the supplement's",
        "m/(s N)",
        "[0, inf)",
    )
    pictures: int = option(
        1,
        "pictures that are taken, and their depth's median, where nothing moves; the supplement has one",
        within="[1, inf)",
    )
    look_every: float = option(1.0, "time between pictures in a pull", "s", "(0, inf)")
    most_force: float = option(35.0, "force that ends an attempt", "N", "(0, inf)")
    stuck_time: float = option(1.5, "a pull ends if the tip has hardly moved for so long", "s", "(0, inf)")
    pull_time: float = option(40.0, "longest pull", "s", "(0, inf)")
    deviations: float = option(
        2.0, "standard deviations beyond which a point of the object's cloud is an outlier; inf: none"
    )
    points: int = option(1200, "points of the cloud that a predictor gets", within="[10, inf)")
    cup: CupOptions = field(default_factory=CupOptions)
    place: PlaceOptions = field(default_factory=PlaceOptions)

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True, eq=False)
class Observation:
    """What a predictor sees; in the robot's base frame, which the network's world frame is, too: z up, the table at
    ``table`` m, an object's front about to -x.

    Attributes:
        points: the object's cloud [N, 3] float32, m, thinned to :attr:`AttemptOptions.points`.
        camera: where the camera stands [3], m.
        tip: T_base_tip [4, 4].
        joints: joint state [J], rad.
        table: height of the table, m.
        holding: whether the cup holds the part.
        force: [3] N on the tip, filtered and without bias.
    """

    points: NDArray[np.float32]
    camera: Array
    tip: Array
    joints: Array
    table: float
    holding: bool
    force: Array


Predictor: TypeAlias = Callable[[Observation], NDArray[Any]]
"""Flow [N, 3] of an observation's points, of any scale; the largest ones are followed."""


@runtime_checkable
class Learns(Protocol):
    """A predictor that may be told of its mistakes."""

    def refute(self, at: Array, way: Array) -> None:
        """A pull at a point [3] (m) along a direction [3] of norm 1 has not moved the part."""
        ...


Puller: TypeAlias = Callable[[Observation], Array]
"""For a policy that knows no flow: the tip's velocity (m/s) and angular velocity (rad/s) [6] while it holds."""


class Reason(str, Enum):
    """Why an attempt ended before the part was open; rows and counts have the value."""

    NO_PICTURE = "no picture"
    NO_DEPTH = "no depth"
    NO_OBJECT = "no object"
    NO_FLOW = "no flow"
    NO_PLACE = "no place"
    UNREACHABLE = "unreachable"
    START_LIMITS = "start beyond limits"
    START_COLLISION = "start in collision"
    GOAL_COLLISION = "goal in collision"
    APPROACH_COLLISION = "approach in collision"
    TIMEOUT = "timeout"
    TRACKING = "off the path"
    BUMPED = "bumped"
    NO_TOUCH = "no touch"
    BAD_FORCE = "bad force"
    NO_VACUUM = "no vacuum"
    LOST_HOLD = "lost hold"
    JOINT_LIMITS = "joint limits"
    TOO_MUCH_FORCE = "too much force"
    STUCK = "stuck"
    PULL_TIME = "pull time"
    DRIVER = "driver"


class Ended(Exception):
    """Ends an attempt: why, and the same in one sentence."""

    def __init__(self, reason: Reason, sentence: str) -> None:
        super().__init__(sentence)
        self.reason, self.sentence = reason, sentence


@dataclass(frozen=True, eq=False)
class Attempt:
    """How an attempt went.

    Attributes:
        seen: whether the camera gave a picture with depth.
        segmented: whether there was an object in it.
        planned: whether there was a flow, a place for the cup, and a free way to it.
        touched: whether the guarded approach felt the object.
        sealed: whether the cup's vacuum held, in one of the grips.
        moved: whether the held point moved 2 cm or more, in one of them.
        opened: whether the part was open at the end; None if nobody could tell.
        reason: what ended the attempt, None if the part is open.
        sentence: the same in words.
        grips: how many times the arm went to touch.
        contact: the point [3] (m) that was chosen last, NaN without one.
        felt: where the tip touched [3] (m), NaN if it did not.
        way: how far the held point has moved, m.
        seconds: how long each stage took by the driver's clock, s, and "planning", "predicting" and "looking" by ours.
        times: [T] s, of the force trace, from the touch's approach on.
        forces: [T, 3] N on the tip, filtered and without bias.
        tips: [T, 3] m, where the tip was.
    """

    seen: bool = False
    segmented: bool = False
    planned: bool = False
    touched: bool = False
    sealed: bool = False
    moved: bool = False
    opened: bool | None = None
    reason: Reason | None = None
    sentence: str = ""
    grips: int = 0
    contact: Array = field(default_factory=lambda: np.full(3, np.nan))
    felt: Array = field(default_factory=lambda: np.full(3, np.nan))
    way: float = 0.0
    seconds: dict[str, float] = field(default_factory=dict)
    times: Array = field(default_factory=lambda: np.zeros(0))
    forces: Array = field(default_factory=lambda: np.zeros((0, 3)))
    tips: Array = field(default_factory=lambda: np.zeros((0, 3)))

    @property
    def failed(self) -> str | None:
        """The first stage that did not go well, of :data:`STAGES`; None if all did, or nobody can tell of the last."""
        return next((stage for stage in STAGES if getattr(self, stage) is False), None)
