"""Procedural articulated objects, written as PartNet-Mobility folders.

No third party's licence applies to them, so they are what the project trains on by default and what its tests use.
A family is a function from a random generator to an `ObjectSpec`; to add one, write the function and enter it
in `FAMILIES`. Beside UMPNet's 21 categories there are families of mechanisms on bodies of any kind, `MECHANISMS`, in
which geometry and not the category tells the motion, and groups of objects that look alike and move differently,
`LOOKALIKES`.
"""

from __future__ import annotations

import shutil
import tempfile
import zlib
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from fb3d_rl.errors import UserError
from fb3d_rl.procedural import (
    appliances,
    bodies,
    caps,
    controls,
    folding,
    frames,
    furniture,
    handheld,
    lidded,
    lookalikes,
    sliding,
    turning,
)
from fb3d_rl.procedural.spec import ObjectSpec, Part, write_object

__all__ = ["FAMILIES", "LOOKALIKES", "MECHANISMS", "ObjectSpec", "Part", "generate", "object_id", "sample"]

MECHANISMS: dict[str, Callable[[np.random.Generator], ObjectSpec]] = {
    "PushButton": controls.push_button,
    "Lever": controls.lever,
    "Slider": controls.slider,
    "Knob": controls.knob,
    "ControlPanel": controls.control_panel,
    "PullCap": caps.pull_cap,
    "TwistCap": caps.twist_cap,
    "PumpCap": caps.pump_cap,
    "FlipCap": caps.flip_cap,
    "FoldingBlade": folding.folding_blade,
    "FoldingLeg": folding.folding_leg,
    "Swivel": turning.swivel,
    "Wheel": turning.wheel,
    "TelescopicHandle": sliding.telescopic_handle,
    "Tray": sliding.tray,
}
"""Kinds of motion on bodies of any kind, size and orientation."""

LOOKALIKES: dict[str, tuple[Callable[[np.random.Generator], ObjectSpec], ...]] = {
    "AmbiguousDoor": tuple(partial(lookalikes.ambiguous_door, variant=k) for k in range(lookalikes.VARIANTS))
}
"""Families in groups: so many objects with successive indices look alike, and each moves in its own way."""

FAMILIES: dict[str, Callable[[np.random.Generator], ObjectSpec]] = {
    "StorageFurniture": furniture.storage_furniture,
    "Table": furniture.table,
    "Refrigerator": appliances.refrigerator,
    "Microwave": appliances.microwave,
    "Safe": appliances.safe,
    "Oven": appliances.oven,
    "Dishwasher": appliances.dishwasher,
    "WashingMachine": frames.washing_machine,
    "Door": frames.door,
    "Window": frames.window,
    "KitchenPot": lidded.kitchen_pot,
    "TrashCan": lidded.trash_can,
    "Box": lidded.storage_box,
    "Bucket": lidded.bucket,
    "Laptop": lidded.laptop,
    "FoldingChair": handheld.folding_chair,
    "Kettle": handheld.kettle,
    "Phone": handheld.phone,
    "Stapler": handheld.stapler,
    "Switch": handheld.switch,
    "Toilet": handheld.toilet,
    **MECHANISMS,
    **{name: variants[0] for name, variants in LOOKALIKES.items()},
}
"""All families: UMPNet's 21 categories, mechanisms and look-alikes."""

SKEWED = 0.15
"""Share of objects whose axes do not run along the coordinate axes."""

SKEW = 0.02
"""By how much at most, rad: a degree, as the most tilted joint among 175 of real objects."""


def object_id(category: str, seed: int, index: int) -> str:
    """The id, and folder name, of one procedural object."""
    return f"proc-{category}-{seed}-{index:04d}"


def sample(category: str, seed: int, index: int) -> ObjectSpec:
    """One object of a family, from a generator of its own: it depends on nothing but the three arguments.

    Of look-alikes, those of a group share the generator: the group is their index // the group's size.

    Raises:
        UserError: If the category has no family or the seed is negative.
    """
    check([category], 1, seed)
    makers = LOOKALIKES.get(category, (FAMILIES[category],))
    group, variant = divmod(index, len(makers))
    rng = np.random.default_rng([seed, zlib.crc32(category.encode()), group])
    spec = makers[variant](rng)
    if rng.random() < SKEWED:
        spec = bodies.yaw(rng.uniform(-SKEW, SKEW)).spec(spec)
    return spec.normalised()


def check(categories: Sequence[str], count: int, seed: int) -> None:
    """Refuse what cannot be generated before anything is written.

    Raises:
        UserError: A category has no family, the count is below 1 or the seed is negative.
    """
    unknown = [name for name in categories if name not in FAMILIES]
    if unknown or not categories:
        wrong = f"No procedural family for category {unknown[0]!r}" if unknown else "No category was named"
        raise UserError(f"{wrong}: choose among {', '.join(FAMILIES)}.")
    if count < 1:
        raise UserError(f"The number of procedural objects per category is {count}: give a number of at least 1.")
    if seed < 0:
        raise UserError(f"The seed of procedural objects is {seed}: give a number of at least 0.")


def generate(
    out: Path, categories: Sequence[str], count: int, seed: int, progress: Callable[[], None] = lambda: None
) -> list[str]:
    """Write `count` objects of each category as out/<id>/ in PartNet-Mobility's layout.

    The same arguments give the same bytes. An object's folder appears complete or not at all; one that is
    already there is replaced.

    Args:
        out: Folder of object folders; made if it is not there.
        categories: Keys of `FAMILIES`; see `fb3d_rl.assets.catalog.expand` for words that name many.
        count: Objects per category.
        seed: Seed of the whole set, at least 0.
        progress: Called after each object.

    Returns:
        The ids, by category, then index.

    Raises:
        UserError: If a category has no family, the count is below 1 or the seed is negative.
    """
    check(categories, count, seed)
    out.mkdir(parents=True, exist_ok=True)
    ids = []
    for category in categories:
        for index in range(count):
            name = object_id(category, seed, index)
            spec = sample(category, seed, index)
            with tempfile.TemporaryDirectory(prefix=".partial-", dir=out) as partial:
                folder = Path(partial) / name
                folder.mkdir()
                write_object(spec, folder, name)
                if (out / name).exists():
                    shutil.rmtree(out / name)
                folder.rename(out / name)
            ids.append(name)
            progress()
    return ids
