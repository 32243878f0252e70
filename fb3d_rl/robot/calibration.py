"""From pictures of a marker to the calibration, a verdict in words, and its file."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fb3d_rl.errors import UserError
from fb3d_rl.robot.calibration_session import Session, Truth
from fb3d_rl.robot.hand_eye import FEWEST, HandEye, calibrate
from fb3d_rl.robot.marker import Marker, Sighting, find

Array = NDArray[np.float64]

GOOD, FAIR = (0.2, 0.002), (0.5, 0.005)
"""Standard errors of the camera's orientation (degrees) and of points (m) up to which a calibration is good or fair."""

MOST_OUTLIERS = 0.25
"""Share of samples that may disagree with the others."""

ENOUGH = 15
"""Samples that a good calibration has; fewer cannot vouch for their own errors, which are twice what they seem."""


@dataclass(frozen=True)
class Calibrated:
    """A calibration of a session."""

    found: HandEye
    names: list[str]
    """Pictures in which the marker was seen; the arrays of ``found`` follow them."""
    unseen: list[str]
    """Pictures without it."""
    marker: Marker
    point: Array
    """Where the marker was on average [3] (m), in the camera's frame."""
    truth: Truth | None
    """Of a simulated cell."""

    @property
    def errors(self) -> tuple[float, float] | None:
        """Error of the camera's orientation (degrees) and position (m) in a simulated cell."""
        if self.truth is None:
            return None
        return pose_error(self.found.camera, self.truth.camera)

    @property
    def rescaled(self) -> bool:
        """Whether the marker is clearly of another size than was said."""
        return abs(self.found.scale - 1.0) > max(3.0 * self.found.scale_error, 0.003)

    @property
    def grade(self) -> str:
        """good, fair or poor."""
        expected = (self.found.rotation_error, self.found.point_error(self.point))
        if self.found.outliers.mean() > MOST_OUTLIERS:
            return "poor"
        for grade, limits in (("good", GOOD), ("fair", FAIR)):
            enough = grade != "good" or len(self.names) >= ENOUGH
            if enough and all(error <= limit for error, limit in zip(expected, limits, strict=True)):
                return grade
        return "poor"

    @property
    def verdict(self) -> str:
        """One sentence on how good the calibration is and, unless it is good, what would better it."""
        found = self.found
        text = (
            f"{self.grade}: the camera's orientation is known to about {found.rotation_error:.2f} degrees, and a point "
            f"where the marker was to about {1000 * found.point_error(self.point):.1f} mm"
        )
        wrong = [name for name, outlier in zip(self.names, found.outliers, strict=True) if outlier]
        if wrong:
            named = ", ".join(wrong[:5]) + (", ..." if len(wrong) > 5 else "")
            text += f"; {len(wrong)} of {len(self.names)} samples disagree with the others ({named})"
        if self.rescaled:
            side, error = (1000 * self.marker.side * number for number in (found.scale, found.scale_error))
            text += f"; the marker's side is {side:.2f} +- {error:.2f} mm, not {1000 * self.marker.side:g}"
        advice = {
            "good": "",
            "fair": "; more samples, turned further about different axes, would better it",
            "poor": "; do not use it: check the intrinsics and that the poses are T_base_flange in "
            "m, then take about 30 samples turned by 30 degrees or more about different axes",
        }
        return text + advice[self.grade]

    def entry(self) -> dict[str, Any]:
        """The content of calibration.json."""
        found = self.found
        content: dict[str, Any] = {
            "T_base_camera": found.camera.tolist(),
            "T_flange_marker": found.marker.tolist(),
            "verdict": self.verdict,
            "grade": self.grade,
            "standard_error": {
                "rotation_deg": found.rotation_error,
                "position_mm": 1000 * found.position_error,
                "point_mm": 1000 * found.point_error(self.point),
            },
            "marker_side_mm": {
                "given": 1000 * self.marker.side,
                "found": 1000 * self.marker.side * found.scale,
                "standard_error": 1000 * self.marker.side * found.scale_error,
            },
            "turned_deg": found.turned.tolist(),
            "samples": [
                {"image": name, "rotation_deg": float(turn), "position_mm": 1000 * float(shift), "outlier": bool(wrong)}
                for name, turn, shift, wrong in zip(
                    self.names, found.rotation_errors, found.position_errors, found.outliers, strict=True
                )
            ],
            "not_seen": self.unseen,
        }
        if self.truth is not None and self.errors is not None:
            turn, shift = self.errors
            content["truth"] = {
                "T_base_camera": self.truth.camera.tolist(),
                "T_flange_marker": self.truth.mount.tolist(),
                "error": {"rotation_deg": turn, "position_mm": 1000 * shift},
            }
        return content


def calibrated(session: Session, marker: Marker) -> Calibrated:
    """Find the marker in a session's pictures and calibrate.

    Raises:
        UserError: the marker is seen in too few of them, or the poses do not determine the camera.
    """
    if len(session.names) < FEWEST:
        raise UserError(f"{len(session.names)} samples are too few to calibrate; take at least {FEWEST}, better 30")
    seen: list[Sighting] = []
    at: list[int] = []
    for i, picture in enumerate(session.pictures()):
        sighting = find(picture, marker, session.lens)
        if sighting is not None:
            seen.append(sighting)
            at.append(i)
    if len(seen) < FEWEST:
        raise UserError(
            f"marker {marker.id} of {marker.dictionary} was found in {len(seen)} of {len(session.names)} images, and "
            f"{FEWEST} are needed; check the dictionary, the id, that it is there once, sharp, and has a white rim"
        )
    poses = np.stack([sighting.pose for sighting in seen])
    rays = np.stack([sighting.rays for sighting in seen])
    found = calibrate(session.flange[at], poses, rays, marker.corners)
    unseen = [name for i, name in enumerate(session.names) if i not in at]
    return Calibrated(
        found, [session.names[i] for i in at], unseen, marker, found.scale * poses[:, :3, 3].mean(0), session.truth
    )


def pose_error(pose: Array, truth: Array) -> tuple[float, float]:
    """Angle (degrees) and distance (m) between two poses [4, 4]."""
    angle = Rotation.from_matrix(pose[:3, :3].T @ truth[:3, :3]).magnitude()
    return math.degrees(angle), float(np.linalg.norm(pose[:3, 3] - truth[:3, 3]))
