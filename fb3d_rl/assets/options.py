"""Options of which objects are trained on and evaluated on."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

from fb3d_rl.errors import UserError
from fb3d_rl.options import option

UNITS = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "inch": 0.0254}
"""Metres in each unit of length that a file may be in."""


@dataclass(frozen=True)
class AssetsOptions:
    """Which objects; ``split`` and ``eval_split`` are a word or a list of words, ``root`` a path or a list of paths."""

    source: Literal["procedural", "partnet_mobility", "files"] = option(
        "procedural", "made on the fly, PartNet-Mobility folders read below root, or files of other makers"
    )
    root: Any = option(
        None,
        "folder that holds <id>/mobility.urdf or <Category>/<id>/mobility.urdf, or maniskill for its asset folder; "
        "files: a file, a folder of them, or a list of paths",
    )
    split: Any = option(
        "all",
        "what to train on (train) or evaluate on (evaluate): all, train_train, train_test, test, a category, an "
        "object's id, a file of such words (.txt, .json), or a list of them",
    )
    eval_split: Any = option("train_test", "what train evaluates on, likewise")
    split_file: str | None = option(
        None, "a file in UMPNet's format; null: split-full.json of the root, else UMPNet's own split"
    )
    categories: list[str] = option(
        ["StorageFurniture", "Microwave", "KitchenPot"],
        "families of procedural objects; all, train or test stand for UMPNet's, mechanisms for kinds of motion on any "
        "body; with partnet_mobility those besides",
    )
    unseen_categories: list[str] = option(
        [], "families of procedural objects that are only evaluated on, as the split test"
    )
    train_count: int = option(40, "procedural training objects of each category")
    eval_count: int = option(
        6,
        "procedural held-out objects of each category; beside real ones they are the splits procedural_train_test and "
        "procedural_test",
    )
    validation_share: float = option(
        0.1,
        "share of the training objects of each category that is not trained on, but validated on while training: what "
        "is chosen then, such as best.safetensors, is chosen by these",
        within="[0, 1)",
    )
    packages: list[str] = option([], "files: folders that package://NAME/... may mean, besides the object's own")
    body: str | None = option(
        None, "files: the body of an MJCF that is taken, with all that it carries", null="all bodies of the file"
    )
    scale: Any = option(
        "auto",
        "files: their unit, m, mm, cm, inch or the metres in one; auto recognises what is larger than 20 m by its size",
    )
    up: Literal["z", "y"] = option("z", "files: which axis points up")
    front: Literal["auto", "-x", "+x", "-y", "+y"] = option(
        "auto", "files: where the front faces once z is up; auto is where the parts open to"
    )
    category: str | None = option(
        None, "files: the category of all of them", null="that of meta.json or of a folder's name, else unknown"
    )

    @property
    def paths(self) -> list[str]:
        """The paths that ``root`` names."""
        return [str(path) for path in (self.root if isinstance(self.root, list) else [self.root]) if path]

    @property
    def metres(self) -> float | Literal["auto"]:
        """``scale``, checked.

        Raises:
            UserError: it is neither auto nor a unit nor a positive number.
        """
        try:
            factor = math.nan if self.scale == "auto" else float(UNITS.get(self.scale, self.scale))
        except (TypeError, ValueError):
            factor = 0.0
        if math.isnan(factor) and self.scale == "auto":
            return "auto"
        if not 0.0 < factor < math.inf:
            raise UserError(
                f"assets.scale={self.scale} is no scale; give auto, {', '.join(UNITS)} or the metres in a unit of the "
                "files, such as 0.001"
            )
        return factor
