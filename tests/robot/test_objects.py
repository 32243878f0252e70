"""The objects of Table I: as published, of table size, and where they stand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.kinematics.opening import openable_links, opening_range
from fb3d_rl.perception.suction import CupOptions
from fb3d_rl.robot.objects import TABLE_I, Listed, make, on_table, spec_of
from fb3d_rl.robot.workspace import CENTRE, SIZE
from fb3d_rl.scene.posed import Posed

REVOLUTE, PRISMATIC = "revolute", "prismatic"
PUBLISHED = {
    "chest_1": ("Box", REVOLUTE),
    "teapot_1": ("Kettle", PRISMATIC),
    "toilet_1": ("Toilet", REVOLUTE),
    "fridge_1": ("Refrigerator", REVOLUTE),
    "oven_1": ("Oven", REVOLUTE),
    "drawer_1": ("StorageFurniture", PRISMATIC),
    "safe_1": ("Safe", REVOLUTE),
    "microwave_1": ("Microwave", REVOLUTE),
    "minifridge_1": ("Refrigerator", REVOLUTE),
    "jar_1": ("KitchenPot", PRISMATIC),
    "jar_2": ("KitchenPot", PRISMATIC),
    "trash_1": ("TrashCan", REVOLUTE),
    "laptop_1": ("Laptop", REVOLUTE),
    "box_1": ("Box", REVOLUTE),
}
"""The supplement's Table I."""

NAMES = [listed.label for listed in TABLE_I]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> dict[str, ArticulatedObject]:
    folder = tmp_path_factory.mktemp("objects")
    return {listed.label: make(listed, folder) for listed in TABLE_I}


def test_they_are_those_of_the_table() -> None:
    assert {row.label: (row.category, row.joint) for row in TABLE_I} == PUBLISHED and NAMES == [*PUBLISHED]
    assert len({(row.category, row.index) for row in TABLE_I}) == len(TABLE_I)  # no object twice


@pytest.mark.parametrize("listed", TABLE_I, ids=NAMES)
def test_one_part_opens_as_far_as_the_table_says(listed: Listed, made: dict[str, ArticulatedObject]) -> None:
    obj = made[listed.label]
    (link,) = openable_links(obj)
    assert obj.movable == (link,) and obj.category == listed.category and not obj.dropped
    assert obj.joint_of(link).type == listed.joint == PUBLISHED[listed.label][1]
    closed, opened = opening_range(obj)
    assert opened - closed == pytest.approx([listed.opening], abs=1e-6)


@pytest.mark.parametrize("listed", TABLE_I, ids=NAMES)
def test_it_fits_the_workspace_wherever_it_stands(listed: Listed, made: dict[str, ArticulatedObject]) -> None:
    """Closed it stands within the beams, in all poses that are drawn; and it is of table size."""
    posed = Posed(made[listed.label])
    bounds = posed.bounds(posed.closed)
    assert np.linalg.norm(bounds[1] - bounds[0]) == pytest.approx(listed.diagonal, abs=1e-5) and listed.diagonal <= 0.5
    assert bounds[0, 2] == pytest.approx(0.0, abs=1e-6)
    corners = np.array([(bounds[i, 0], bounds[j, 1]) for i in (0, 1) for j in (0, 1)])
    rng = np.random.default_rng(0)
    for _ in range(50):
        x, y, turn = listed.stand.draw(rng)
        cos, sin = np.cos(turn), np.sin(turn)
        there = corners @ np.array([[cos, sin], [-sin, cos]]) + (x, y)
        assert (np.abs(there - CENTRE) < np.array(SIZE) / 2).all()


@pytest.mark.parametrize("listed", TABLE_I, ids=NAMES)
def test_its_masses_are_plausible(listed: Listed, made: dict[str, ArticulatedObject]) -> None:
    """Between .2 and 5 kg in all, as heavy as foam to ceramics, and a part that a cup can lift at its far end."""
    obj = made[listed.label]
    content = on_table(listed, obj, (0.6, 0.0, 0.0))
    assert 0.2 <= sum(content.masses) <= 5.0 and content.masses[content.link] == listed.part
    assert [i for i, mass in enumerate(content.masses) if mass] == [
        i for i, link in enumerate(obj.links) if link.visuals
    ]
    assert 9.81 * listed.part < 0.5 * CupOptions().hold


def test_the_same_bytes_each_time(tmp_path: Path) -> None:
    for folder in ("one", "two"):
        make(TABLE_I[0], tmp_path / folder)
    files = sorted(path.relative_to(tmp_path / "one") for path in (tmp_path / "one").rglob("*") if path.is_file())
    assert len(files) > 5
    for file in files:
        assert (tmp_path / "one" / file).read_bytes() == (tmp_path / "two" / file).read_bytes()


def test_sizes_scale_shapes_and_slides_alike() -> None:
    spec = spec_of(TABLE_I[-1])
    whole = spec.normalised()
    low, high = whole.bounds()
    assert np.linalg.norm(high - low) == pytest.approx(2.0)
    half = whole.normalised(1.0)
    assert half.bounds() == pytest.approx(0.5 * whole.bounds())
