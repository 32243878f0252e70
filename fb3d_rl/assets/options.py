"""Options of which objects are trained on and evaluated on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from fb3d_rl.options import option


@dataclass(frozen=True)
class AssetsOptions:
    """Which objects; ``split`` and ``eval_split`` are a word or a list of words."""

    source: Literal["procedural", "partnet_mobility"] = option(
        "procedural", "made on the fly, or PartNet-Mobility folders read below root"
    )
    root: str | None = option(
        None, "folder that holds <id>/mobility.urdf or <Category>/<id>/mobility.urdf, or maniskill for its asset folder"
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
