from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from fb3d_rl.errors import UserError
from fb3d_rl.perception.arrays import as_mask, as_points, near_origin

POINTS = np.random.default_rng(0).uniform(-0.5, 0.5, (40, 3)).round(3).astype(np.float32)
MASK = POINTS[:, 0] > 0


def _fields() -> np.ndarray[Any, Any]:
    cloud = np.zeros(len(POINTS), dtype=[("rgb", "u4"), ("z", "f4"), ("x", ">f8"), ("y", "f2")])
    for k, axis in enumerate("xyz"):
        cloud[axis] = POINTS[:, k]
    return cloud


def _locked() -> np.ndarray[Any, Any]:
    cloud = POINTS.copy()
    cloud.flags.writeable = False
    return cloud


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("cloud", "digits"),
    [
        pytest.param(POINTS[::-1].copy()[::-1], 7, id="negative strides"),
        pytest.param(POINTS[:, ::-1].copy()[:, ::-1], 7, id="axes turned round"),
        pytest.param(POINTS.astype(">f4"), 7, id="big-endian"),
        pytest.param(POINTS.astype(np.longdouble), 7, id="long double"),
        pytest.param(POINTS.astype(np.float16), 3, id="half precision"),
        pytest.param(_fields(), 3, id="fields"),
        pytest.param(POINTS.tolist(), 7, id="lists"),
        pytest.param(_locked(), 7, id="read-only"),
        pytest.param(np.ma.masked_array(POINTS), 7, id="masked array"),
        pytest.param(np.asfortranarray(POINTS), 7, id="by columns"),
        pytest.param(torch.from_numpy(POINTS).bfloat16(), 2, id="bfloat16"),
        pytest.param(torch.from_numpy(POINTS.copy()).double().requires_grad_(), 7, id="tensor with a gradient"),
    ],
)
def test_every_kind_of_numbers_is_the_same_cloud(cloud: Any, digits: int) -> None:
    found = as_points(cloud)
    assert found.dtype in (torch.float32, torch.float64) and found.is_contiguous() and not found.requires_grad
    np.testing.assert_allclose(found, POINTS, atol=10.0**-digits)


def test_whole_numbers_and_what_is_masked() -> None:
    assert as_points(np.array([[1, 2, 3]], dtype=">i2")).tolist() == [[1, 2, 3]]
    assert as_points(np.array([[2**31 + 1, 2, 3]])).tolist() == [[2**31 + 1, 2, 3]], "float32 would round it"
    hidden = np.ma.masked_array(POINTS, mask=np.arange(len(POINTS))[:, None] * [1, 1, 1] == 3)
    assert as_points(hidden).isnan().all(1).nonzero().flatten().tolist() == [3]


@pytest.mark.parametrize(
    ("cloud", "word"),
    [
        (np.zeros(4), r"\[4\]"), (np.zeros((2, 3, 3)), r"\[2, 3, 3\]"), (np.zeros((4, 2)), r"\[4, 2\]"),
        ([[1, 2, 3], [1, 2]], "array"), ([["a", "b", "c"]], "numbers"), (None, "cloud"),
        (np.zeros((4, 3), complex), "complex"), (np.zeros((4, 3), bool), "bool"),
        (torch.zeros(4, 3, dtype=torch.bool), "bool"), (_fields()[["x", "y"]], "x, y"),
        (torch.zeros(4, 3).to_sparse(), "cloud"), ({"points": 1}, "cloud"), ("cloud.ply", "cloud"),
    ],
)  # fmt: skip
def test_what_is_no_cloud_is_named(cloud: Any, word: str) -> None:
    with pytest.raises(UserError, match=word):
        as_points(cloud)


@pytest.mark.parametrize("big", [np.inf, np.nan, 1e5, 1e30, np.finfo(np.float32).max, -1e30])
def test_the_mark_of_a_missing_point_is_missing(big: float) -> None:
    marked = POINTS.copy()
    marked[5] = big
    marked[7, 2] = big
    cloud, _ = near_origin(as_points(marked))
    assert cloud.isnan().any(1).nonzero().flatten().tolist() == [5, 7]
    keep = np.setdiff1d(np.arange(len(POINTS)), [5, 7])
    np.testing.assert_array_equal(cloud[keep], POINTS[keep])


def test_a_distant_cloud_is_moved_to_the_origin() -> None:
    where = np.array([3e6, -5e6, 100.0])
    cloud, origin = near_origin(as_points(POINTS.astype(np.float64) + where))
    np.testing.assert_allclose(cloud.double() + origin, POINTS + where, atol=1e-6)
    assert near_origin(as_points(POINTS + 500))[1].tolist() == [0, 0, 0]


def test_a_cloud_of_one_place_is_named() -> None:
    with pytest.raises(UserError, match="same"):
        near_origin(torch.zeros(5, 3))
    assert near_origin(torch.ones(1, 3))[0].tolist() == [[1, 1, 1]]
    assert near_origin(torch.full((3, 3), torch.nan))[0].isnan().all()


@pytest.mark.parametrize(
    "mask",
    [
        pytest.param(MASK, id="bool"),
        pytest.param(MASK.astype(np.uint8) * 255, id="0 and 255"),
        pytest.param(np.where(MASK, 3, -1), id="ids, -1 for none"),
        pytest.param(np.where(MASK, 0, -1), id="the id 0, -1 for none"),
        pytest.param(np.where(MASK, 2.0, -1.0).astype(">f4"), id="ids as CloudCompare writes them"),
        pytest.param(np.where(MASK, 0.9, 0.1), id="scores"),
        pytest.param(np.where(MASK, 0.9, np.nan), id="scores, NaN for none"),
        pytest.param(torch.from_numpy(np.where(MASK, 0.9, 0.2)).bfloat16(), id="tensor"),
        pytest.param(MASK[:, None], id="column"),
        pytest.param(MASK.tolist(), id="list"),
        pytest.param(MASK[::-1].copy()[::-1], id="negative strides"),
    ],
)
def test_every_kind_of_mask_is_the_same_mask(mask: Any) -> None:
    assert as_mask(mask, len(MASK)).tolist() == MASK.tolist()


@pytest.mark.parametrize(
    ("mask", "word"),
    [
        ([0, 1, 2, 1], "1, 2"), ([-1, 0, 1, 1], "0, 1"), ([-0.5, 0.2, 3.0, 1.0], "-0.5 to 3"), ([True] * 3, "for 4"),
        (["a"] * 4, "numbers"), (None, "mask"),
    ],
)  # fmt: skip
def test_what_is_no_mask_is_named(mask: Any, word: str) -> None:
    with pytest.raises(UserError, match=word):
        as_mask(mask, 4)
