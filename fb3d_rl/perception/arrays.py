"""Clouds and masks as sensors, files and other software hold them, as tensors of ours."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from fb3d_rl.errors import UserError

OUTLYING = 1000.0
"""A point counts as missing that is this many times as far from the cloud's median as the median point."""

_NARROW = (torch.float32, torch.float16, torch.bfloat16, torch.int8, torch.uint8, torch.int16)
"""What float32 holds without rounding."""

_SAMPLE = 10_000
"""Points that tell where a cloud is and how large."""

_CELLS = 256
"""Cells along each side of a cloud whose points share their nearest neighbour."""


def as_points(points: Any) -> Tensor:
    """A cloud of numbers of any kind as a tensor [N, 3], float64 where float32 would round it, on its own device.

    Args:
        points: [N, 3] numbers: an array of any byte order, strides and precision, a tensor, nested lists; or a
            structured array [N] with the fields x, y and z.

    Raises:
        UserError: it is something else.
    """
    if isinstance(points, Tensor):
        cloud = points.detach()
        plain = cloud.layout == torch.strided and not cloud.is_complex() and not cloud.dtype == torch.bool
        if not plain or cloud.ndim != 2 or cloud.shape[1] != 3:
            raise UserError(f"The cloud is {cloud.dtype} {list(cloud.shape)}: give floats [N, 3].")
        return cloud.to(torch.float32 if cloud.dtype in _NARROW else torch.float64)
    array = _array(points, "The cloud")
    if array.dtype.names is not None:
        if not {"x", "y", "z"} <= {*array.dtype.names} or array.ndim != 1:
            raise UserError(f"The cloud has the fields {', '.join(array.dtype.names)}: give x, y and z, [N] each.")
        array = np.stack([_numbers(array[axis], "The cloud") for axis in "xyz"], axis=-1)
    if array.ndim != 2 or array.shape[1] != 3:
        raise UserError(f"The cloud is {array.dtype} {list(array.shape)}: give floats [N, 3].")
    return torch.from_numpy(_numbers(array, "The cloud"))


def _array(values: Any, what: str) -> NDArray[Any]:
    """Any array or list; of a masked array what is masked is NaN."""
    try:
        if isinstance(values, np.ma.MaskedArray) and values.dtype.names is None:
            return np.ma.filled(values.astype(np.float64), np.nan)
        return np.asarray(values)
    except (ValueError, TypeError) as error:  # lists of different lengths
        raise UserError(f"{what} is no array of numbers: {error}.") from error


def _numbers(array: NDArray[Any], what: str) -> NDArray[Any]:
    """A copy in native byte order, without gaps: float32 where that holds the numbers, else float64."""
    if array.dtype.kind not in "fiu":
        raise UserError(f"{what} is {array.dtype} {list(array.shape)}: numbers are needed.")
    wide = np.result_type(array.dtype.newbyteorder("="), np.float32)
    with np.errstate(over="ignore"):
        return np.array(array, dtype=np.float32 if wide == np.float32 else np.float64, order="C")


def as_mask(mask: Any, count: int, name: str = "mask") -> Tensor:
    """Which of ``count`` points are on the part, [count] bool, from a mask as others write it.

    Args:
        mask: [count] of one of four kinds. bool. Whole numbers of which one other than 0 occurs, such as 0 and 1: that
            one marks the part. Whole numbers with negative ones for "on no part", as ids are: the one that is not
            negative marks the part. Scores from 0 to 1: the part has more than one half; NaN is not on it.
        count: the number of points.
        name: of the mask in messages.

    Raises:
        UserError: its shape is another, it has several ids, or it is nothing of these.
    """
    values = mask.detach().cpu() if isinstance(mask, Tensor) else _array(mask, f"The {name}")
    if isinstance(values, Tensor):
        values = (values.float() if values.dtype == torch.bfloat16 else values).numpy()
    if values.ndim == 2 and values.shape[1] == 1:
        values = values[:, 0]
    if values.shape != (count,):
        raise UserError(f"The {name} is {list(values.shape)} for {count} points: give [N] bool.")
    if values.dtype.kind == "b":
        return torch.from_numpy(np.array(values, dtype=np.bool_))
    numbers = _numbers(values, f"The {name}")
    known = numbers[np.isfinite(numbers)]
    if not len(known):
        return torch.zeros(count, dtype=torch.bool)
    if (known == np.round(known)).all():
        # Ids that use -1 for "none" may use 0 for a part.
        on = numbers >= 0 if known.min() < 0 else numbers > 0
        ids = np.unique(numbers[on & np.isfinite(numbers)])
        if len(ids) > 1:
            some = ", ".join(f"{one:g}" for one in ids[:5]) + (", ..." if len(ids) > 5 else "")
            raise UserError(f"The {name} has the ids {some}: say which part is meant, such as {name} == {ids[0]:g}.")
        return torch.from_numpy(on)
    if known.min() < 0 or known.max() > 1:
        raise UserError(
            f"The {name} has numbers from {known.min():g} to {known.max():g}: give bool, ids, or scores from 0 to 1."
        )
    return torch.from_numpy(numbers > 0.5)


def near_origin(cloud: Tensor) -> tuple[Tensor, Tensor]:
    """A cloud in float32, with NaN for each point that is missing, and what was subtracted from it first.

    Missing is what is not finite, and what lies :data:`OUTLYING` times as far away as the rest, as the marks do that
    some sensors set for missing points. A cloud that is a kilometre or more from the origin, such as one in map
    coordinates, is moved there, because float32 would round it.

    Args:
        cloud: [N, 3] of :func:`as_points`.

    Returns:
        The cloud [N, 3], which may share the memory of the given one, and the origin [3] in the cloud's precision, 0
        unless it was moved.

    Raises:
        UserError: there are several points, and all are the same.
    """
    origin = cloud.new_zeros(3)
    rows = places(finite(cloud))
    if not len(rows):
        return torch.full_like(cloud, torch.nan, dtype=torch.float32), origin
    sample = cloud[rows[:: max(1, len(rows) // _SAMPLE)]]
    middle = sample.median(0).values
    spread = float((sample - middle).abs().amax(1).median())
    if spread == 0 and len(rows) > 1 and bool((cloud[rows] == middle).all()):
        raise UserError(f"All {len(rows)} points of the cloud are the same, {middle.tolist()}: nothing is to be seen.")
    limit = OUTLYING * spread if spread > 0 else 1e6
    here = torch.ones(len(cloud), dtype=torch.bool, device=cloud.device)
    for axis in range(3):  # one after the other, since there may be ten million points; NaN is not near
        here &= (cloud[:, axis] - middle[axis]).abs_() <= limit
    if float(middle.abs().max()) > 1000.0:
        cloud, origin = cloud - middle, middle
    return cloud.float() if bool(here.all()) else cloud.float().masked_fill(~here[:, None], torch.nan), origin


def finite(cloud: Tensor) -> Tensor:
    """Which points [N] bool of a cloud [N, 3] are finite, by their sums: a third of the time of looking at each number.
    A point whose sum overflows counts as not finite.
    """
    return cloud.sum(1).isfinite()


def places(chosen: Tensor) -> Tensor:
    """The places [n] int64 of the chosen among [N] bool."""
    if bool(chosen.all()):
        return torch.arange(len(chosen), device=chosen.device)
    return chosen.nonzero().flatten()


def draw(count: int, most: int) -> Tensor:
    """The places [n] int64 of at most so many of ``count`` points, drawn at random, always alike; all, in their order,
    if they are no more.
    """
    if count <= most:
        return torch.arange(count)
    return torch.randperm(count, generator=torch.Generator().manual_seed(0))[:most]


def nearest(points: Tensor, kept: Tensor, marked: Tensor, kept_marked: Tensor) -> Tensor:
    """For each point the index of about the nearest of the kept points that is marked alike, if there is one.

    About: the points of a small cell share the one that is nearest to its middle, so that ten million take a second.

    Args:
        points: [N, 3] f32, finite.
        kept: [K, 3] f32.
        marked: [N] bool.
        kept_marked: [K] bool.

    Returns:
        [N] int64, on the CPU.
    """
    points, kept, marked, kept_marked = (x.cpu() for x in (points, kept, marked, kept_marked))
    low = points.amin(0)
    size = ((points.amax(0) - low).amax() / _CELLS).clamp_min(1e-9)
    code = marked.int()
    for axis in range(3):  # in place and one axis after the other, since there may be ten million points
        place = (points[:, axis] - low[axis]).div_(size).int().clamp_max_(_CELLS - 1)
        code += place.mul_(2 * _CELLS**axis)
    filled = torch.zeros(2 * _CELLS**3, dtype=torch.bool)
    filled[code] = True
    cells = filled.nonzero().flatten()
    axes = torch.stack([cells // 2 // _CELLS**axis % _CELLS for axis in range(3)], 1)
    middle = low + (axes + 0.5) * size
    found = torch.zeros(len(filled), dtype=torch.int32)  # of half the size, which is read all over
    for side in (False, True):
        among = (kept_marked == side).nonzero().flatten()
        among = among if len(among) else torch.arange(len(kept))
        mine = cells % 2 == int(side)
        _, index = cKDTree(kept[among]).query(middle[mine], workers=-1)
        found[cells[mine]] = among[torch.from_numpy(np.asarray(index))].int()
    return found[code].long()
