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
    """A network that is trained on flow samples."""

    epochs: float = option(
        1.5,
        "passes over the training samples; steps = epochs * data.train_samples / batch_size",
        within="(0, inf)",
    )
    seed: int | None = option(
        None,
        "of the first weights, the order of the samples and their augmentation; null: the run's, which objects and "
        "samples have in any case",
    )
    start_from: str | None = option(
        None, "weights to start from: a run folder, checkpoint.pt or .safetensors; null: random weights"
    )
    backbone: Literal["pointnet2", "delayed"] = option(
        "pointnet2", "the paper's network, or one that is several times as fast"
    )
    network: str | None = option(
        None, "of algo=artflownet: package.module:Class, a CloudNetwork of your own in place of ArtFlowNet"
    )
    neighbors: int = option(64, "largest number of points in a ball of PointNet++", within="[1, inf)")
    part_mask_input: bool = option(True, "whether the mask of the part to open is an input of the network")
    hypotheses: int = option(
        1,
        "flows that ArtFlowNet proposes for each cloud, each with a probability, as sight alone does not tell which "
        "way a closed lid or a lever goes; 1 is the paper's network",
        within="[1, inf)",
    )


@dataclass(frozen=True)
class BetaOptions:
    """The expert's share of a round's steps; in the first round it is 1."""

    schedule: Schedule = option("exponential", "how the share falls; first: 1 in the first round, then 0")
    value: float = option(0.5, "the share of schedule=constant", within="[0, 1]")
    rounds: int = option(4, "the round in which schedule=linear reaches 0")
    base: float = option(0.7, "the share of round n is base^n with schedule=exponential", within="[0, 1]")
    mixing: Literal["step", "episode"] = option(
        "episode", "whether who acts is drawn for every step or once for an episode"
    )


@dataclass(frozen=True)
class SamplingOptions:
    """Which labels a round learns from, and how often."""

    rows: Literal["all", "recent", "successes"] = option(
        "all", "all labels, those of the last rounds, or those of episodes that ended with success"
    )
    rounds: int = option(2, "the last rounds of rows=recent, with the present one", within="[1, inf)")
    expert: float = option(1.0, "weight of labels of steps in which the expert acted", within="[0, inf)")
    learner: float = option(1.0, "weight of labels of steps in which the learner acted", within="[0, inf)")


@dataclass(frozen=True)
class ImitationOptions(OptimizerOptions, AlgoOptions):
    """Behaviour cloning and DAgger."""

    rounds: int = option(8, "number of rounds; each collects labels and fits the learner", within="[1, inf)")
    epochs: float = option(
        20.0,
        "draws of each label in all rounds together; steps = epochs * data.labels / batch_size, shared by the rounds",
        within="(0, inf)",
    )
    beta: BetaOptions = group(BetaOptions)
    gate: GateOptions = group(GateOptions)
    sampling: SamplingOptions = group(SamplingOptions)
    oracle: bool = option(False, "the expert drives to the contact point; the learner acts while suction holds a part")
    members: int = option(1, "number of learners; several are an ensemble", within="[1, inf)")
    learner: LearnerOptions = group(LearnerOptions)
    flow_checkpoint: str | None = option(
        None, "an ArtFlowNet's run folder or checkpoint.pt, with learner.flow=artflownet"
    )
    demonstrations: str | None = option(
        None, "demonstrations to start from: a buffer that launch/demos.py recorded, imported or filtered"
    )
    overlap: bool = option(
        False,
        "collect the next round during the fit of this one, on all cores but one, with the weights from before the fit",
    )
    validate_trials: int = option(
        0, "trials with validation objects after each round, for the learning curve", within="[0, inf)"
    )
    loss: Literal["l1", "l2", "smooth_l1"] = option("l1", "loss of a deterministic head; the others have their own")
    kl_weight: float = option(10.0, "of head=act: weight of its latent's divergence from a normal", within="[0, inf)")
    auxiliary: float = option(
        0.1, "weight of the loss of what learner.contact and learner.phase tell", within="[0, inf)"
    )
    turn: float = option(15.0, "inputs are rotated about z by a random angle of at most this", "degrees", "[0, inf)")
    mirror: bool = option(True, "mirror inputs with probability 1/2")
