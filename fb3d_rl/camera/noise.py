"""Errors of a real depth camera, on depth images that a simulator has rendered.

Each term is switched by its own option and draws from a stream of its own, so that switching one does not change the
draws of the others. What depends on the scene (edges, incidence) is taken from the image before any error.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter
from scipy.special import ndtr

from fb3d_rl.camera.noise_options import AZURE_KINECT, EXACT, PRESETS, STEREO, TERMS, DepthNoiseOptions
from fb3d_rl.seeds import derived

__all__ = [
    "AZURE_KINECT", "EXACT", "PRESETS", "STEREO", "TERMS", "DepthNoiseOptions", "Measured", "incidence", "measured"
]  # fmt: skip

Image = NDArray[np.float64]


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
