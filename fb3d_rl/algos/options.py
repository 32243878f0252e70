"""Options of the algorithms: the keys of ``algo``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from fb3d_rl.options import group, option
from fb3d_rl.policies.options import GateOptions, LearnerOptions
from fb3d_rl.training.options import FlowFitOptions, OptimizerOptions
from fb3d_rl.training.schedules import Schedule


@dataclass(frozen=True)
class AlgoOptions:
    """What is trained (``algo=NAME``)."""

    name: str = option("artflownet", "the algorithm; conf/algo/ has variants of each")


@dataclass(frozen=True)
class FlowNetworkOptions(FlowFitOptions, AlgoOptions):
    """A network that flow samples train, and how."""

    epochs: float = option(
        1.5,
        "how often each training sample is drawn; times data.train_samples / batch_size it is the steps",
        within="(0, inf)",
    )
    start_from: str | None = option(None, "the weights to start from, a checkpoint.pt or .safetensors; null draws them")
    backbone: Literal["pointnet2", "delayed"] = option("pointnet2", "the paper's, or one that is several times as fast")
    neighbors: int = option(64, "points kept in a ball", within="[1, inf)")
    part_mask_input: bool = option(True, "whether the network sees which points are on the part to open")
    hypotheses: int = option(
        1,
        "flows that ArtFlowNet proposes for each cloud, each with a probability: sight alone does not tell which way a "
        "closed lid or a lever goes; 1 is the paper's",
        within="[1, inf)",
    )


@dataclass(frozen=True)
class BetaOptions:
    """The expert's share of a round's steps; in the first round it is 1."""

    schedule: Schedule = option("exponential", "first is 1, then 0")
    value: float = option(0.5, "of constant", within="[0, 1]")
    rounds: int = option(4, "linear reaches 0 in this one")
    base: float = option(0.7, "of exponential", within="[0, 1]")
    mixing: Literal["step", "episode"] = option("episode", "who acts is drawn for every step or once for an episode")


@dataclass(frozen=True)
class ImitationOptions(OptimizerOptions, AlgoOptions):
    """Behaviour cloning and DAgger."""

    rounds: int = option(8, "how often is collected and fitted", within="[1, inf)")
    epochs: float = option(
        20.0,
        "draws per label in all rounds; times data.labels / batch_size it is the steps, which the rounds share",
        within="(0, inf)",
    )
    beta: BetaOptions = group(BetaOptions)
    gate: GateOptions = group(GateOptions)
    oracle: bool = option(False, "the expert drives to the contact point, the learner acts on held parts alone")
    members: int = option(1, "learners of an ensemble", within="[1, inf)")
    learner: LearnerOptions = group(LearnerOptions)
    flow_checkpoint: str | None = option(None, "an ArtFlowNet's checkpoint.pt, for learner.flow=artflownet")
    demonstrations: str | None = option(
        None, "a buffer that launch/demos.py recorded, imported or filtered, to start from"
    )
    overlap: bool = option(
        False,
        "collect each next round on all cores but one while the last one is fitted, with the weights from before",
    )
    validate_trials: int = option(
        0, "trials with validation objects after each round, for the learning curve", within="[0, inf)"
    )
    loss: Literal["l1", "l2", "smooth_l1"] = option("l1", "of a deterministic head; the Gaussian's is its likelihood")
    turn: float = option(15.0, "situations are turned about z by up to so much, at random", "degrees", "[0, inf)")
    mirror: bool = option(True, "every other situation is mirrored, at random")
