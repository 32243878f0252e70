"""The 14 objects of the supplement's Table I at table size, made by the procedural families, and where they stand.

They stand in for what the authors bought: same names, categories and kinds of joint, our shapes, sizes and weights.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.assets.partnet_mobility import load_object
from fb3d_rl.kinematics.opening import opening_range
from fb3d_rl.procedural import sample
from fb3d_rl.procedural.spec import ObjectSpec, write_object
from fb3d_rl.robot.simulated import TableObject

SEED = 15
"""Of the objects. Objects to train on have even seeds (:func:`fb3d_rl.assets.catalog.procedural_catalog`)."""

FRICTION = {"revolute": 0.05, "prismatic": 0.05}
"""Of the joints, as coefficients of PhysX."""

DAMPING = {"revolute": 0.1, "prismatic": 5.0}
"""Of the joints, Nm s/rad and N s/m: as of a hinge that does not fall shut at once, and of a drawer on its rails."""


@dataclass(frozen=True)
class Stand:
    """Where an object may stand: ranges of x and y of its middle (m), and of the turn of its front (degrees).

    At turn 0 the front faces the robot, at about -45 the camera.
    """

    x: tuple[float, float]
    y: tuple[float, float]
    turn: tuple[float, float]

    def draw(self, rng: np.random.Generator) -> tuple[float, float, float]:
        """x, y (m) and turn (rad), uniformly."""
        x, y, turn = (float(rng.uniform(*ends)) for ends in (self.x, self.y, self.turn))
        return x, y, float(np.radians(turn))


LID = Stand((0.50, 0.65), (-0.10, 0.10), (-85.0, -55.0))
"""An arm before the object cannot follow a lid to behind it: these are hinged at the robot's right."""

DOOR = Stand((0.60, 0.75), (-0.12, 0.08), (-75.0, -45.0))
"""Hinged on its right, at the robot's side."""

FRONT = Stand((0.65, 0.75), (-0.10, 0.05), (-55.0, -25.0))
"""A drawer, which comes straight out."""

ROUND = Stand((0.50, 0.70), (-0.15, 0.15), (-80.0, 0.0))
"""A lid that is lifted off."""


@dataclass(frozen=True)
class Listed:
    """A row of Table I, and what stands in for it.

    Attributes:
        label: the paper's name.
        category: PartNet-Mobility's; the table says Storage, Kitchen Pot and Trash Can.
        joint: of the part to open.
        index: of the family's object with :data:`SEED`, which has one part.
        diagonal: of the closed object's bounding box, m.
        opening: range of the joint, rad or m.
        body: mass of the body, kg.
        part: mass of the part that opens, kg.
        stand: where it stands.
    """

    label: str
    category: str
    joint: Literal["revolute", "prismatic"]
    index: int
    diagonal: float
    opening: float
    body: float
    part: float
    stand: Stand


TABLE_I = (
    Listed("chest_1", "Box", "revolute", 0, 0.40, 1.3, 1.5, 0.4, LID),
    Listed("teapot_1", "Kettle", "prismatic", 8, 0.32, 0.10, 0.6, 0.15, ROUND),
    Listed("toilet_1", "Toilet", "revolute", 0, 0.45, 1.3, 2.0, 0.3, LID),
    Listed("fridge_1", "Refrigerator", "revolute", 2, 0.42, 1.3, 3.0, 0.8, DOOR),
    Listed("oven_1", "Oven", "revolute", 117, 0.42, 1.3, 3.0, 0.6, DOOR),
    Listed("drawer_1", "StorageFurniture", "prismatic", 775, 0.42, 0.10, 2.5, 0.8, FRONT),
    Listed("safe_1", "Safe", "revolute", 2, 0.36, 1.3, 3.5, 1.0, DOOR),
    Listed("microwave_1", "Microwave", "revolute", 15, 0.42, 1.3, 3.0, 0.5, DOOR),
    Listed("minifridge_1", "Refrigerator", "revolute", 45, 0.36, 1.3, 2.0, 0.6, DOOR),
    Listed("jar_1", "KitchenPot", "prismatic", 0, 0.30, 0.10, 0.8, 0.3, ROUND),
    Listed("jar_2", "KitchenPot", "prismatic", 4, 0.30, 0.10, 0.8, 0.25, ROUND),
    Listed("trash_1", "TrashCan", "revolute", 1, 0.40, 1.2, 0.6, 0.15, LID),
    Listed("laptop_1", "Laptop", "revolute", 25, 0.42, 1.3, 1.2, 0.5, LID),
    Listed("box_1", "Box", "revolute", 2, 0.36, 1.3, 0.4, 0.1, LID),
)
"""In the order of Table I."""


def spec_of(listed: Listed) -> ObjectSpec:
    """The shapes and the joint of an object, at its size."""
    spec = sample(listed.category, SEED, listed.index).normalised(listed.diagonal)
    return replace(spec, parts=tuple(replace(part, upper=listed.opening) for part in spec.parts))


def make(listed: Listed, out: Path) -> ArticulatedObject:
    """Write the object as out/<label>/ in PartNet-Mobility's layout, always the same bytes, and read it.

    The folder appears complete or not at all; one that is there already is read as it is.
    """
    folder = out / listed.label
    if not folder.is_dir():
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".partial-", dir=out) as partial:
            made = Path(partial) / listed.label
            made.mkdir()
            write_object(spec_of(listed), made, listed.label)
            made.rename(folder)
    return load_object(folder)


def on_table(listed: Listed, obj: ArticulatedObject, place: tuple[float, float, float]) -> TableObject:
    """The object of :func:`make`, closed, at x, y (m) and a turn (rad) on the table."""
    (link,) = obj.movable
    masses = [listed.part if i == link else listed.body if other.visuals else 0.0 for i, other in enumerate(obj.links)]
    start = opening_range(obj)[0].tolist()
    return TableObject(obj, link, start, place, masses, FRICTION[listed.joint], DAMPING[listed.joint])
