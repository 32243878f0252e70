"""Options of the policies: how the flow policy chooses a contact point and moves, and the learner's network."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from fb3d_rl.errors import UserError
from fb3d_rl.options import check, group, option

BUDGETED = ("safe", "lazy", "thrifty")
"""Gates whose thresholds a budget sets."""

COMPARING = ("ensemble", "thrifty")
"""Gates that compare learners with each other."""


@dataclass(frozen=True)
class ContactOptions:
    """How the flow policy chooses a contact point; shares are of the cloud's largest flow."""

    neighbors: int = option(12, "points that make a neighbourhood", within="[3, inf)")
    curvature: float = option(
        0.03, "PCA curvature above which a point is no good place for a suction cup", within="[0, inf)"
    )
    rim: float = option(
        0.45,
        "a point whose neighbours on the part lie to one side is on its rim: largest distance from the point to their "
        "mean, as a share of their mean distance; .inf: the rim is as good",
        within="[0, inf)",
    )
    min_distance: float = option(
        0.02, "where the max-flow point is discarded, its stand-in is at least this far away (I.E)", "m", "[0, inf)"
    )
    min_flow: float = option(0.5, "share of the largest flow that a contact point must have", within="[0, 1]")
    # With 0 here and in turning the choice is the supplement's: the largest flow (I.E).
    near: float = option(
        10.0,
        "what a metre from the hand counts against a point; the larger, the more the choice depends on where the hand "
        "is, and the less on which points the camera happens to see",
        "shares of the largest flow per m",
        "[0, inf)",
    )
    turning: float = option(
        1.0,
        "what it counts against a point that the hand has to turn to stand off it, for 1 - cosine of the angle",
        "shares of the largest flow",
        "[0, inf)",
    )
    facing: float = option(
        0.35,
        "cosine between flow and surface normal below which the hand approaches along the normal",
        within="[-1, 1]",
    )
    collisions: bool = option(
        True,
        "whether the hand's way to the point, and with the part from there, has to be free of the cloud and the "
        "ground; without it the supplement's rule is left: what is flat is good",
    )
    hand_radius: float = option(
        0.055, "radius of the free cylinder that the hand needs in front of the point", "m", "[0, inf)"
    )
    clearance: float = option(0.06, "where that cylinder starts, in front of the point", "m", "[0, inf)")
    reach: float = option(0.6, "where that cylinder ends", "m", "(0, inf)")
    run_up: float = option(0.1, "straight way that the tip needs above the ground before it touches", "m", "[0, inf)")
    weak_flow: float = option(
        0.1, "share of the largest flow that does if no point with more can be moved freely", within="[0, 1]"
    )
    candidates: int = option(64, "points whose way along the flow is checked", within="[1, inf)")
    sweep: float = option(
        1.0, "how far along its way a point has to be free, or sweep_angle if that is less", "m", "(0, inf)"
    )
    sweep_angle: float = option(1.6, "see sweep", "rad", "(0, inf)")
    sweep_steps: int = option(8, "places along the way that are checked", within="[1, inf)")


@dataclass(frozen=True)
class TouchOptions:
    """What the flow policy learns from its pulls, see fb3d_rl.policies.touch; "part" is the held point of the part."""

    speed: float = option(0.2, "of the tip in a slow pull, until it is known that the part follows", "m/s", "(0, inf)")
    free_after: float = option(0.03, "way of the part after which a slow pull becomes fast", "m", "[0, inf)")
    limit_stretch: float = option(
        0.03,
        "stretch of the suction's spring at which a slow pull has met a limit, if the part moved less than half of it",
        "m",
        "(0, inf)",
    )
    still: float = option(
        0.35, "share of its speed below which a hand that presses on the part stands still", within="[0, 1]"
    )
    resistance: float = option(
        0.15, "share of its speed by which the hand lags behind where a fast pull becomes slow", within="[0, 1]"
    )
    # Fitted to pulls in the simulated task with the default env.gripper and env.suction: effective values, which differ
    # by direction by a factor of up to two. The lag grows with the spring's constants and falls with the drives'.
    stiffness: float = option(
        0.85,
        "lag of the hand for each metre of the spring's stretch, for the default gripper and suction",
        "1/s",
        "(0, inf)",
    )
    damping: float = option(
        0.19, "lag of the hand for each m/s at which the stretch grows, likewise", within="(0, inf)"
    )
    ease_speed: float = option(0.1, "speed at which the hand backs off while it presses on the part", "m/s", "[0, inf)")
    slack_gain: float = option(2.0, "rate at which the tip gives way to stretch across the pull", "1/s", "[0, inf)")
    yield_gain: float = option(6.0, "rate at which it gives way to all stretch at resistance", "1/s", "[0, inf)")
    spacing: float = option(0.015, "way of the part between two measurements of its direction", "m", "(0, inf)")
    noise: float = option(0.0002, "variance of a measured direction times the way that it is of", "m", "(0, inf)")
    deviation: float = option(0.35, "standard deviation of the network's direction", within="(0, inf)")
    turn_deviation: float = option(1.0, "standard deviation of the network's turn", "rad/m", "(0, inf)")
    certainty: float = option(0.8, "probability of the network's sense of the motion", within="(0, 1)")
    at_once: float = option(0.05, "a limit that is met within this way is met at once", "m", "[0, inf)")
    against_at_once: float = option(
        4.0, "log-odds against a direction in which a limit is met at once", within="[0, inf)"
    )
    against: float = option(1.5, "log-odds against a direction in which a limit is met later", within="[0, inf)")
    convincing: float = option(
        0.15, "way of the part that counts 1 for its direction in log-odds, at most 4", "m", "(0, inf)"
    )
    keeps: float = option(5.0, "log-odds for the direction of a pull, until it meets a limit", within="[0, inf)")


@dataclass(frozen=True)
class ArcOptions:
    """How the arcs of policy=flowbotpp and expert_arc are followed, see fb3d_rl.policies.arc."""

    look_every: int | None = option(
        10,
        "while the part is held, the network is called once in this many steps, and the tip follows an arc in between; "
        "null: once for each hold (open loop)",
        "control steps",
        "[1, inf)",
    )
    residual: float = option(
        0.4,
        "largest residual (sine of the angle between the predicted flow and that of the arc) at which the arc is "
        "followed; beyond, the tip follows the flow, which is predicted in each step",
        within="[0, 1]",
    )


@dataclass(frozen=True)
class FlowPolicyOptions:
    """How the flow policy moves; ``mask`` and ``contact`` are set from their own keys."""

    travel_speed: float = option(1.8, "of the tip around the object", "m/s", "(0, inf)")
    approach_speed: float = option(1.6, "of the tip on the way to the pre-contact point", "m/s", "(0, inf)")
    touch_speed: float = option(0.3, "of the tip from there on (guarded)", "m/s", "(0, inf)")
    pull_speed: float = option(
        0.8, "factor that turns the normalised flow into a tip velocity (I.G)", "m/s", "(0, inf)"
    )
    angular_gain: float = option(
        8.0, "factor that turns the rotation q_diff into an angular velocity (I.G)", "1/s", "(0, inf)"
    )
    precontact: float = option(
        0.1, "distance of the pre-contact point in front of the contact point (I.G)", "m", "(0, inf)"
    )
    line: float = option(
        0.06, "how far off the approach line the tip may be when it turns to the contact point", "m", "(0, inf)"
    )
    overshoot: float = option(
        0.08, "how far the tip may pass the contact point before the approach has failed", "m", "(0, inf)"
    )
    force: float = option(20.0, "contact force that ends an approach which does not hold", "N", "[0, inf)")
    patience: float = option(0.2, "how long that force is borne, since suction may still engage", "s", "[0, inf)")
    stuck_speed: float = option(
        0.08, "a pull is stuck if the tip moves slower than this along the flow ...", "m/s", "[0, inf)"
    )
    stuck_time: float = option(
        0.3, "... for longer than this: the hand tears itself off and tries elsewhere", "s", "[0, inf)"
    )
    release_time: float = option(0.9, "how long it tries to tear itself off before it pulls on", "s", "[0, inf)")
    fade: float = option(
        0.8,
        "share of the way behind it that still counts 0.05 s later where it has to go back",
        within="[0, 1]",
    )
    retries: int | None = option(
        None,
        "how often it chooses another contact point after it has missed one or lost hold; then it stays where it is; "
        "null: as often as there is time",
        within="[0, inf)",
    )
    retry_distance: float = option(
        0.08, "points nearer than this to a point that failed are not tried", "m", "[0, inf)"
    )
    nearby: float = option(
        0.1,
        "distance from the held point at which a point's flow counts half in the motion that is fitted there",
        "m",
        "(0, inf)",
    )
    # Half a step: the tip moves on the chord of its arc and does not drift outwards.
    lead: float = option(
        0.5,
        "how far ahead of the observation the flow is read along the part's motion",
        "control steps",
        "[0, inf)",
    )
    # A door that swings down would pin the hand between itself and the ground z = 0.
    clearance: float = option(0.07, "height below which the hand's far end does not sink", "m", "[0, inf)")
    funnel: float = option(
        0.5,
        "how much the tip stays farther out than the pre-contact point for each metre off the approach line",
        "m/m",
        "[0, inf)",
    )
    free: float = option(
        0.08,
        "distance from the visible points at which a straight way to the approach line is free",
        "m",
        "[0, inf)",
    )
    margin: float = option(
        0.1,
        "distance that the tip keeps from the object's bounding sphere where the straight way is not free",
        "m",
        "[0, inf)",
    )
    regrasp: float | None = option(
        None,
        "how much larger than where it holds the largest flow of the part has to be, as a share of it, for the hand to "
        "let go and hold there (FlowBotHD's smart grasp point is 0.2); null: it never does",
        within="(0, 1]",
    )
    learn: bool = option(True, "whether the flow that a network predicts is corrected by what its pulls measure")
    touch: TouchOptions = group(TouchOptions)
    arc: ArcOptions = group(ArcOptions)
    mask: Literal["target", "none"] = "target"
    contact: ContactOptions = ContactOptions()

    def require_mask(self, what: str) -> None:
        """Check that the policy is shown the part to open.

        Raises:
            UserError: it is not, and ``what`` cannot do without.
        """
        if self.mask != "target":
            raise UserError(f"{what} has to see which part to open: leave policy.mask=target")


@dataclass(frozen=True)
class PolicyOptions:
    """Which policy is evaluated (``policy=NAME``), and how all that follow a flow choose a contact point and move."""

    name: str = option("expert", "a name of conf/policy/")
    target: str | None = option(None, "of policy=plugin: package.module:make, your own policy")
    mask: Literal["target", "none"] | None = option(
        None,
        "which points the policy acts on: those of the part to open, or none, whatever has a flow (the "
        'paper\'s "without mask"); null: none for a network that was trained without a mask, else target',
    )
    flow: FlowPolicyOptions = group(FlowPolicyOptions)
    contact: ContactOptions = group(ContactOptions)


@dataclass(frozen=True)
class GateOptions:
    """When the expert takes over from the learner."""

    name: Literal["beta", "safe", "ensemble", "lazy", "thrifty"] = option("beta", "see fb3d_rl.policies.gates")
    options: dict[str, float] = option({}, "the gate's thresholds; its own defaults unless given")
    budget: float | None = option(
        None,
        "share of steps in which the expert may take over; sets the thresholds anew before every round",
        within="[0, 1]",
    )


@dataclass(frozen=True)
class LearnerOptions:
    """The network of a policy that imitates.

    Attributes:
        discrepancy: whether it also predicts its distance from the expert, which some gates ask for.
    """

    encoder: Literal["attention", "pointnet", "pointnet2", "dp3", "artflownet"] = option(
        "attention", "of the cloud; dp3 is that of 3D Diffusion Policy, artflownet the published flow network"
    )
    head: Literal["deterministic", "gaussian", "mixture", "act", "diffusion", "flow_matching"] = option(
        "deterministic", "how a plan is made, see fb3d_rl.models.heads"
    )
    flow: Literal["none", "ground_truth", "artflownet"] = option(
        "none", "the flow as a further input of each point; artflownet is its prediction"
    )
    points: int = option(
        256, "number of points of a cloud that the learner reads; clouds are in random order", within="[16, inf)"
    )
    width: int = option(64, "of the network's layers", within="[4, inf)")
    history: int = option(
        3, "steps before the present one whose proprioception and contact it remembers", "control steps", "[0, inf)"
    )
    chunk: int = option(1, "how far it plans ahead ...", "control steps", "[1, inf)")
    execute: int = option(1, "... of which this many are executed before the next plan", "control steps", "[1, inf)")
    ensemble: float | None = option(
        None,
        "temporal ensembling: it plans in every step, and executes the mean of all plans for this step, the i-th "
        "oldest with weight exp(-ensemble i); ACT's is 0.01; null: it executes the plan as it is",
        within="[0, inf)",
        later=True,
    )
    components: int = option(5, "normals of head=mixture", within="[1, inf)", later=True)
    calls: int = option(
        10, "calls of the network for a plan of head=diffusion and head=flow_matching", within="[1, inf)", later=True
    )
    normalize: bool | None = option(
        None,
        "whether velocities and angular velocities of the labels are divided by their root mean square in the first "
        "round; null: for the heads act, diffusion and flow_matching, which compare them with unit noise",
        later=True,
    )
    focus: Literal["none", "hand", "part"] = option(
        "none",
        "half of the points that it reads are those nearest to the hand, or points of the part to open; none: all of "
        "them are drawn evenly",
        later=True,
    )
    contact: bool = option(
        False,
        "whether it also learns to tell the expert's contact point, as a score for each point of the part, and from "
        "which side the hand comes; it plans for what it tells, and keeps to it on its way (best with focus=part)",
        later=True,
    )
    phase: bool = option(False, "likewise the expert's phase: on its way, approaching, pulling ...", later=True)
    frozen: bool = option(True, "whether encoder=artflownet keeps its published weights", later=True)
    discrepancy: bool = False

    @property
    def guided(self) -> bool:
        """Whether it tells what the expert is about to do."""
        return self.contact or self.phase

    @property
    def draws(self) -> bool:
        """Whether a plan is made from noise, which the trial's seed decides."""
        return self.head in ("diffusion", "flow_matching")

    @property
    def normalized(self) -> bool:
        """Whether labels are divided by their size."""
        return self.head == "act" or self.draws if self.normalize is None else self.normalize

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            UserError: a value is unknown or out of range.
        """
        check(self)
        if self.execute > self.chunk:
            raise UserError(f"execute={self.execute} is more than the chunk={self.chunk} that is planned")
        if self.ensemble is not None and (self.execute > 1 or self.chunk == 1):
            raise UserError(
                f"ensemble={self.ensemble} averages plans that overlap; give chunk=2 or more, and leave execute=1"
            )
