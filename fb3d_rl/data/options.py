"""Options of flow samples and of data sets of them."""

from __future__ import annotations

from dataclasses import dataclass

from fb3d_rl.camera.options import CameraOptions
from fb3d_rl.camera.views import ViewRange
from fb3d_rl.errors import UserError
from fb3d_rl.options import option


@dataclass(frozen=True)
class SampleOptions:
    """How flow samples are drawn; ``views`` are the viewpoints and ``camera`` is the optics."""

    points: int = option(1200, "number N of points of a cloud", within="[64, inf)")
    views: ViewRange = ViewRange()
    camera: CameraOptions = CameraOptions()
    closed_share: float = option(
        0.3,
        "share of samples whose target part is exactly closed; the others are uniform over its range",
        within="[0, 1]",
    )
    others_closed: float = option(
        0.7, "probability that each other joint is closed rather than uniform over its range", within="[0, 1]"
    )
    all_parts_share: float = option(
        0.3,
        "share of samples whose target is all movable parts (the reference's target), mask included",
        within="[0, 1]",
    )
    some_parts_share: float = option(
        0.0, "share of samples whose target is a part and a random choice of the other movable ones", within="[0, 1]"
    )
    unmasked_share: float = option(
        0.0,
        "share of samples whose target is all movable parts and whose mask marks every point: it says nothing, as "
        "where there is none",
        within="[0, 1]",
    )

    def __post_init__(self) -> None:
        """Check the shares together.

        Raises:
            UserError: they add up to more than 1.
        """
        together = self.all_parts_share + self.some_parts_share + self.unmasked_share
        if together > 1.0:
            raise UserError(
                f"data.all_parts_share, some_parts_share and unmasked_share add up to {together:g}: give 1 at most"
            )


@dataclass(frozen=True)
class DataOptions(SampleOptions):
    """Flow samples, data sets of them, and the expert's labels."""

    train_samples: int = option(4000, "samples to train flow networks on")
    given_share: float | None = option(
        None,
        "about which share of them shows real or other given objects, where procedural ones are trained on, too; null: "
        "each object is shown equally often",
        within="(0, 1)",
    )
    max_epochs: float | None = option(
        None, "most passes over them, where algo.epochs asks for more; null: no limit", within="(0, inf)"
    )
    dataset: str | None = option(
        None, "the folder samples/ of another run, to train on its samples; null: draw new ones"
    )
    met_by: str | None = option(
        None,
        "an ArtFlowNet (run folder, checkpoint.pt, .safetensors): clouds from rollouts of its policy with the training "
        "objects are training samples, too",
    )
    met_samples: int = option(2000, "number of clouds from these rollouts")
    labels: int = option(24000, "control steps that the expert labels for imitation, in all rounds together")
    eval_samples: int = option(8, "samples of each held-out object on which the flow is measured", within="[1, inf)")
    workers: int | None = option(None, "worker processes that draw samples; null: one per core", within="[0, inf)")
