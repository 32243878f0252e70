"""Errors of a real depth camera, on depth images that a simulator has rendered.

Each term is switched by its own option and draws from a stream of its own, so that switching one does not change the
draws of the others. What depends on the scene (edges, incidence) is taken from the image before any error.

The default is the Azure Kinect's time-of-flight camera in its narrow mode without binning. Its maker promises a random
error of at most 17 mm and a systematic one below 11 mm + 0.1 % of the distance, on surfaces that reflect 15 to 95 %
(Microsoft, "Azure Kinect DK hardware specifications"); Toelgyessy et al., "Evaluation of the Azure Kinect", Sensors 21
(2021) 413, confirm both up to 3.5 m, and describe pixels that fly at edges and the failures on dark and glossy
surfaces. Pixels that mix foreground and background, or return too little light, are invalid, with depth 0 (Microsoft,
"Azure Kinect DK depth camera"). How often that happens nobody has published: those shares are estimates.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter
from scipy.special import ndtr

from fb3d_rl.options import check, option
from fb3d_rl.seeds import derived

Image = NDArray[np.float64]

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


class Measured(NamedTuple):
    """What a camera measured.

    Attributes:
        depth: [H, W] m, 0 where nothing was measured, in the dtype that was given.
        source: [H, W] int64, the pixel (row * W + column) whose surface a pixel shows; -1 where it shows none or a
            mixture of two.
    """

    depth: NDArray[np.floating]
    source: NDArray[np.int64]


def measured(
    depth: NDArray[np.floating],
    columns: Image,
    rows: Image,
    options: DepthNoiseOptions,
    seed: int,
    frame: int = 0,
    bodies: NDArray[np.int64] | None = None,
) -> Measured:
    """A depth image with a camera's errors.

    Args:
        depth: [H, W] m along the camera's axis, 0 where there is nothing.
        columns: x / z of the pixels' columns [W], :attr:`fb3d_rl.camera.options.CameraOptions.ticks`.
        rows: y / z of the pixels' rows [H].
        options: the errors; :data:`AZURE_KINECT`, :data:`STEREO` or others.
        seed: of the session: the bias and which bodies are dark follow from it alone.
        frame: number of the image in the session; all else follows from seed and frame.
        bodies: [H, W] the body at each pixel, -1 for none; without it nothing is dark.
    """
    streams = {name: np.random.default_rng(derived(seed, name, frame)) for name in TERMS}
    truth = np.asarray(depth, dtype=np.float64)
    cosine, edge, near, far = _scene(truth, columns, rows, options.edge)
    source = np.arange(truth.size).reshape(truth.shape)
    if options.lateral:
        source = _shifted(truth.shape, options.lateral_pixels, streams["lateral"])
    seen, cosine, near, far = (image.ravel()[source] for image in (truth, cosine, near, far))
    edge, z = edge.ravel()[source], seen
    if options.bias:
        offset, share = np.random.default_rng(derived(seed, "bias")).uniform(-1.0, 1.0, 2)
        z = z + offset * options.bias_offset + share * options.bias_share * seen
    if options.axial:
        a, b, c = options.axial_sigma
        sigma = (a + b * seen + c * seen**2) / np.maximum(cosine, 0.2) + options.axial_edge * edge
        z = z + sigma * streams["axial"].standard_normal(z.shape)
    mixed = np.zeros(z.shape, dtype=bool)
    if options.flying:
        chosen, share = streams["flying"].random((2, *z.shape))
        mixed = edge & (chosen < options.flying_share) & (far - near > options.edge)
        z = np.where(mixed, share * near + (1.0 - share) * far, z)
    invalid = seen <= 0
    if options.holes:
        invalid |= edge & (streams["holes"].random(z.shape) < options.holes_share)
    if options.grazing:
        invalid |= cosine < options.grazing_cosine
    if options.dark and bodies is not None:
        invalid |= _dark(bodies.ravel()[source], options, seed) & (
            _patchy(z.shape, options.dark_patch, streams["dark"]) < options.dark_share
        )
    if options.rounding:
        z = np.round(z / options.unit) * options.unit
    if options.limits:
        invalid |= (z < options.near) | (z > options.far)
    invalid |= z <= 0
    return Measured(np.where(invalid, 0.0, z).astype(depth.dtype), np.where(invalid | mixed, -1, source))


def incidence(depth: Image, columns: Image, rows: Image) -> Image:
    """Cosine [H, W] of the angle between a pixel's ray and the normal of the surface there; 0 where there is none.

    On a plane 1 / z is linear in x / z and y / z, so that its slopes tell the normal without an error.

    Args:
        depth: [H, W] m, 0 where there is nothing.
        columns: x / z of the pixels' columns [W].
        rows: y / z of the pixels' rows [H].
    """
    inverse = _inverse(depth)
    return _cosine(inverse, *_slopes(inverse, columns, rows), columns, rows)


def _inverse(depth: Image) -> Image:
    return np.divide(1.0, depth, out=np.zeros_like(depth), where=depth > 0)


def _slopes(inverse: Image, columns: Image, rows: Image) -> tuple[Image, Image]:
    """Slopes of 1 / z along x / z and y / z: of the differences to both sides the smaller, so that none crosses an
    edge.
    """

    def smaller(steps: Image, axis: int) -> Image:
        one, other = ([(0, 0), (0, 0)] for _ in range(2))
        one[axis], other[axis] = (1, 0), (0, 1)
        before, after = (np.pad(steps, widths, constant_values=np.inf) for widths in (one, other))
        return np.where(np.abs(before) < np.abs(after), before, after)

    across = smaller(np.diff(inverse, axis=1) / np.diff(columns), 1)
    down = smaller(np.diff(inverse, axis=0) / np.diff(rows)[:, None], 0)
    return across, down


def _cosine(inverse: Image, across: Image, down: Image, columns: Image, rows: Image) -> Image:
    x, y = columns[None], rows[:, None]
    normal = np.sqrt(across**2 + down**2 + (inverse - x * across - y * down) ** 2)
    cosine = inverse / np.maximum(normal * np.sqrt(x**2 + y**2 + 1.0), 1e-12)
    return np.where(inverse > 0, cosine, 0.0)


def _scene(depth: Image, columns: Image, rows: Image, step: float) -> tuple[Image, NDArray[np.bool_], Image, Image]:
    """Cosine of the incidence, whether a pixel is at an edge, the nearest and farthest depth of 3 x 3, all [H, W]."""
    inverse = _inverse(depth)
    across, down = _slopes(inverse, columns, rows)
    edge = np.zeros(depth.shape, dtype=bool)
    height, width = depth.shape
    for i, j in itertools.product((-1, 0, 1), repeat=2):
        here = slice(max(0, -i), height - max(0, i)), slice(max(0, -j), width - max(0, j))
        there = slice(max(0, i), height - max(0, -i)), slice(max(0, j), width - max(0, -j))
        x = columns[there[1]] - columns[here[1]]
        y = (rows[there[0]] - rows[here[0]])[:, None]
        plane = 1.0 / np.maximum(inverse[here] + x * across[here] + y * down[here], 1e-9)
        edge[here] |= (np.abs(depth[there] - plane) > step) | (depth[there] <= 0)
    edge &= depth > 0
    near = minimum_filter(np.where(depth > 0, depth, np.inf), 3, mode="nearest")
    far = maximum_filter(depth, 3, mode="nearest")
    return _cosine(inverse, across, down, columns, rows), edge, near, far


def _shifted(shape: tuple[int, ...], pixels: float, rng: np.random.Generator) -> NDArray[np.int64]:
    """The pixel [H, W] that each pixel sees instead of itself."""
    height, width = shape
    down, right = np.rint(pixels * rng.standard_normal((2, height, width))).astype(np.int64)
    row = (np.arange(height)[:, None] + down).clip(0, height - 1)
    column = (np.arange(width) + right).clip(0, width - 1)
    return np.asarray(row * width + column)


def _dark(bodies: NDArray[np.int64], options: DepthNoiseOptions, seed: int) -> NDArray[np.bool_]:
    """Which pixels show a body that is dark in this session."""
    draws = np.random.default_rng(derived(seed, "dark")).random(int(bodies.max(initial=0)) + 1)
    return np.asarray((bodies >= 0) & (draws[bodies.clip(0)] < options.dark_bodies))


def _patchy(shape: tuple[int, ...], radius: float, rng: np.random.Generator) -> Image:
    """Numbers uniform in [0, 1], alike within patches."""
    field = gaussian_filter(rng.standard_normal(shape), radius, mode="wrap")
    return np.asarray(ndtr(field / max(float(field.std()), 1e-12)))
