"""Which errors of a real depth camera are simulated, and how large they are.

The default is the Azure Kinect's time-of-flight camera in its narrow mode without binning. Its maker promises a random
error of at most 17 mm and a systematic one below 11 mm + 0.1 % of the distance, on surfaces that reflect 15 to 95 %
(Microsoft, "Azure Kinect DK hardware specifications"); Toelgyessy et al., "Evaluation of the Azure Kinect", Sensors 21
(2021) 413, confirm both up to 3.5 m, and describe pixels that fly at edges and the failures on dark and glossy
surfaces. Pixels that mix foreground and background, or return too little light, are invalid, with depth 0 (Microsoft,
"Azure Kinect DK depth camera"). How often that happens nobody has published: those shares are estimates.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from fb3d_rl.options import check, option

TERMS = ("lateral", "bias", "axial", "flying", "holes", "grazing", "dark", "rounding", "limits")
"""The switches, in the order in which the errors arise."""


@dataclass(frozen=True)
class DepthNoiseOptions:
    """Errors of a depth camera; the defaults are an Azure Kinect's."""

    lateral: bool = option(True, "whether a pixel may see what a neighbour looks at")
    lateral_pixels: float = option(0.5, "standard deviation of that, in either direction", "pixels", "[0, inf)")
    bias: bool = option(True, "whether all depth is off by an offset and a share that stay the same for a session")
    bias_offset: float = option(0.005, "largest offset", "m", "[0, inf)")
    bias_share: float = option(0.001, "largest share of the depth", within="[0, 1)")
    axial: bool = option(True, "whether depth has Gaussian noise, of another size at every pixel")
    axial_sigma: tuple[float, float, float] = option(
        (0.0008, 0.0, 0.0007),
        "standard deviation on a surface that faces the camera, a + b z + c z^2 of the depth z; elsewhere it is "
        "divided by the cosine of the incidence, .2 at least",
        "m, 1, 1/m",
    )
    axial_edge: float = option(0.0, "what it has more at edges", "m", "[0, inf)")
    flying: bool = option(True, "whether pixels at an edge may lie between foreground and background")
    flying_share: float = option(0.3, "share of the pixels at edges that do", within="[0, 1]")
    holes: bool = option(True, "whether pixels at an edge may be invalid")
    holes_share: float = option(0.3, "share of the pixels at edges that are", within="[0, 1]")
    edge: float = option(
        0.02, "depth by which one of its eight neighbours is off a pixel's plane at an edge", "m", "(0, inf)"
    )
    grazing: bool = option(True, "whether surfaces that are seen at a grazing angle are invalid")
    grazing_cosine: float = option(0.2, "cosine of the incidence below which they are", within="[0, 1]")
    dark: bool = option(True, "whether some bodies are dark or glossy, and have patches of invalid pixels")
    dark_bodies: float = option(0.1, "share of the bodies that are", within="[0, 1]")
    dark_share: float = option(0.5, "share of their pixels that is invalid", within="[0, 1]")
    dark_patch: float = option(2.0, "radius of a patch", "pixels", "[0, inf)")
    rounding: bool = option(True, "whether depth is in whole units")
    unit: float = option(0.001, "the unit", "m", "(0, inf)")
    limits: bool = option(True, "whether what is too near or too far is invalid")
    near: float = option(0.5, "the nearest depth", "m", "[0, inf)")
    far: float = option(3.86, "the farthest depth", "m", "(0, inf)")

    def __post_init__(self) -> None:
        check(self)


AZURE_KINECT = DepthNoiseOptions()

STEREO = DepthNoiseOptions(
    lateral_pixels=1.0,
    bias_offset=0.001,
    bias_share=0.005,
    axial_sigma=(0.00163, 0.00073, 0.00395),
    axial_edge=0.041,
    flying=False,
    grazing_cosine=0.1,
    near=0.3,
    far=3.0,
)
"""An active stereo camera, such as a RealSense D435, whose random error grows with the square of the depth: by Intel's
rule z^2 * subpixel / (focal length * baseline) = 3.6 mm/m^2 for a subpixel of .08, 447 pixels and 50 mm."""

_OFF: dict[str, Any] = dict.fromkeys(TERMS, False)

EXACT = replace(AZURE_KINECT, **_OFF)
"""No error at all: for switching on single terms with ``dataclasses.replace``."""

PRESETS = {"azure_kinect": AZURE_KINECT, "stereo": STEREO, "exact": EXACT}
