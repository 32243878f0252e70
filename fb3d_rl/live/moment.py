"""What an interactive view shows at one moment: bodies, cloud, flows, contact point and the state of a trial."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FLOWS = {"true": ("privileged", "flow"), "predicted": ("prediction", "flow")}
"""The flows that a policy can act on; the expert acts on the true one."""


@dataclass(frozen=True, eq=False)
class Contact:
    """A contact [3] (m) with the unit vectors [3] of the pull and from the contact to the hand's standoff pose."""

    point: NDArray[np.float32]
    pull: NDArray[np.float32]
    standoff: NDArray[np.float32]


@dataclass(frozen=True)
class Progress:
    """State of a trial.

    Attributes:
        steps: control steps made.
        phase: the policy's phase, one of :data:`fb3d_rl.policies.flow_policy.PHASES`.
        distance: normalized distance, 1 at the start and 0 at the joint's limit.
        attached: whether suction holds the part.
        success: whether the part counts as open.
        done: whether the trial is over.
        by: who made the last step, "learner", "person" or "expert"; "" where nobody but the policy acts, and at the
            start.
    """

    steps: int
    phase: str
    distance: float
    attached: bool
    success: bool
    done: bool
    by: str = ""


@dataclass(frozen=True, eq=False)
class Moment:
    """All that a page shows.

    Attributes:
        poses: T_world_body [L, 4, 4] of the links; in a trial [L + 3, 4, 4] with hand, left and right finger.
        qpos: joint state [J], rad or m.
        tip: the suction tip's pose [7] in the world, p (m) and q (wxyz).
        camera: T_world_camera [4, 4]; x right, y down, z forward.
        points: the M points of the cloud [M, 3], m.
        part: [M], whether a point lies on the part to open.
        flows: the true and, with a network, the predicted flow [M, 3] by their names in :data:`FLOWS`.
        metrics: errors of the prediction (:func:`fb3d_rl.flow.metrics.flow_metrics`); empty without one.
        contact: the policy's contact; None where it has none.
        trial: state of the trial; None if none runs.
    """

    poses: NDArray[np.float64]
    qpos: NDArray[np.float64]
    tip: NDArray[np.float32]
    camera: NDArray[np.float64]
    points: NDArray[np.float32]
    part: NDArray[np.bool_]
    flows: dict[str, NDArray[np.float32]]
    metrics: dict[str, float]
    contact: Contact | None
    trial: Progress | None


def status(moment: Moment, playing: bool) -> str:
    """The state of the trial, in a line or two."""
    trial = moment.trial
    if trial is None:
        if moment.contact is None:
            return "No contact point can be chosen from what the camera sees."
        return "Click the blue part to choose another contact point."
    if trial.done:
        outcome = ("**opened**" if trial.success else "**not opened** in time") + ", "
    elif trial.by:  # the phase is the expert's, who looks on
        outcome = "" if playing else "**paused**, "
    else:
        outcome = ("" if playing else "paused in phase ") + f"**{trial.phase}**, "
    held = "holds the part" if trial.attached else "holds nothing"
    return f"step {trial.steps}: {outcome}{held}\n\nnormalized distance **{trial.distance:.2f}**"
