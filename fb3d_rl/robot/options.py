"""Options of the robot's trials."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from fb3d_rl.camera.noise_options import PRESETS, TERMS, DepthNoiseOptions
from fb3d_rl.errors import UserError
from fb3d_rl.options import option


@dataclass(frozen=True)
class RobotOptions:
    """Trials of a robot arm in its cell: of protocol=robot alone."""

    arm: str = option(
        "sawyer",
        "the arm: sawyer, panda, or URDF:FLANGE, a file and the link that the cup is mounted on, along its z axis",
    )
    trials: int = option(5, "trials of each object, each with a pose of its own", within="[1, inf)")
    noise: str = option("azure_kinect", "the depth camera's errors", among=PRESETS)
    without: list[str] = option([], "terms of these errors to leave out: " + ", ".join(TERMS))
    pictures: int = option(
        1, "pictures whose depth's median is taken before the arm moves, against noise", within="[1, inf)"
    )
    calibration_deg: float | None = option(
        0.2,
        "turn by which the camera's calibration is off, about an axis drawn for the session",
        "degrees",
        "[0, inf)",
        null="the calibration is carried out in the simulated cell",
    )
    calibration_mm: float = option(
        2.0, "way by which it is off, in a direction drawn for the session", "mm", "[0, inf)"
    )
    seal: bool = option(True, "whether the surface and the loads decide if the cup holds; false: it always holds")
    rim: bool = option(True, "whether a place for the cup must have surface all around it (beyond the supplement)")
    outliers: bool = option(True, "whether outliers are removed from the object's cloud")
    grips: int = option(3, "grips in a trial at most; the supplement has one", within="[1, inf)")
    force_noise: bool = option(True, "whether the force at the tip has a bias and noise")

    def depth_noise(self) -> DepthNoiseOptions:
        """The camera's errors.

        Raises:
            UserError: there is no such term.
        """
        for name in self.without:
            if name not in TERMS:
                raise UserError(f"robot.without={name} is no term of the camera's errors; they are {', '.join(TERMS)}")
        off: dict[str, Any] = dict.fromkeys(self.without, False)
        return replace(PRESETS[self.noise], **off)
