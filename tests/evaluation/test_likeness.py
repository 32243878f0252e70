"""Whether procedural objects are like real ones: what is measured of them, and what tells two kinds apart."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fb3d_rl import procedural
from fb3d_rl.assets.partnet_mobility import load_object
from fb3d_rl.data.options import SampleOptions
from fb3d_rl.evaluation.likeness import FEATURES, FEWEST, compare, describe, of_folder

OPTIONS = replace(SampleOptions(), points=400)


def test_what_an_object_is_like(tmp_path: Path) -> None:
    [pot, laptop] = procedural.generate(tmp_path, ("KitchenPot", "Laptop"), 1, seed=0)
    lid, screen = (
        dict(zip(FEATURES, describe(load_object(tmp_path / name), OPTIONS), strict=True)) for name in (pot, laptop)
    )
    assert lid["flow up or down"] == pytest.approx(1) and lid["mean flow of the part"] == pytest.approx(1)
    assert lid["way of the joint"] > 0 == lid["range of the joint, rad"]
    assert screen["range of the joint, rad"] > 1.5 and screen["way of the joint"] == 0
    assert 0.3 < screen["mean flow of the part"] < 0.8, "a hinge: the flow grows with the distance from it"
    assert lid["part: height"] > 0.6 and lid["parts that open"] == screen["parts that open"] == 1
    for numbers in (lid, screen):
        assert numbers["part: longest extent"] >= numbers["part: middle extent"] >= numbers["part: shortest extent"]
    assert np.array_equal(describe(load_object(tmp_path / pot), OPTIONS), [*lid.values()]), "always alike"
    category, nothing = of_folder(tmp_path)
    assert category == "" and np.isnan(nothing).all()


def test_what_tells_two_kinds_apart() -> None:
    rng = np.random.default_rng(0)

    def kind(count: int, shift: float = 0.0) -> list[np.ndarray]:
        rows = rng.normal(size=(count, len(FEATURES)))
        rows[:, 5] += shift
        return list(rows)

    unlike, like = compare({"Box": kind(30), "Oven": kind(30)}, {"Box": kind(30), "Oven": kind(30, shift=6.0)})
    assert (unlike.category, like.category) == ("Oven", "Box") and unlike.counts == (30, 30)
    assert unlike.told > 0.95 and unlike.telling(1) == [5] and unlike.apart[5] > 0.99
    assert unlike.means[5][1] - unlike.means[5][0] == pytest.approx(6.0, abs=1.0)
    assert 0.3 < like.told < 0.7 and max(like.apart) < 0.8
    few = kind(FEWEST - 1) + [np.full(len(FEATURES), np.nan)]
    assert compare({"Box": few}, {"Box": kind(30)}) == [], "too few that can be used"
