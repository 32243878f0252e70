"""Train or evaluate the registry's entry that the configuration names: launch/train.py and launch/evaluate.py."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from tensordict.nn import TensorDictModuleBase
from torch import nn

from fb3d_rl.algos import setup
from fb3d_rl.algos.algorithm import Acting
from fb3d_rl.evaluation.evaluate import evaluate
from fb3d_rl.evaluation.options import PROTOCOLS
from fb3d_rl.policies.flow_policy import expert_policy
from fb3d_rl.policies.plugin import Plugin
from fb3d_rl.registry import REGISTRY, behind
from fb3d_rl.rollout.rows import TrialRow

if TYPE_CHECKING:
    from fb3d_rl.config import EvaluateConfig, TrainConfig


def run_training(cfg: TrainConfig, out: Path) -> list[TrialRow]:
    """See :meth:`fb3d_rl.algos.algorithm.Algorithm.train`; a task of ManiSkill gives none of these rows."""
    if cfg.env.task is not None:
        from fb3d_rl.algos.task import train_on_task

        train_on_task(cfg, out)
        return []
    rows: list[TrialRow] = behind(REGISTRY[cfg.algo.name].algorithm).train(cfg, out)
    return rows


def acting(name: str, checkpoint: str | None, target: str | None = None, points: int = 1200) -> Acting:
    """The policy of that name; a trained one is loaded from its checkpoint.

    Args:
        name: of the registry.
        checkpoint: of one that is trained.
        target: of one from outside, see :mod:`fb3d_rl.policies.plugin` ...
        points: ... which is tried with a cloud of so many.

    Raises:
        UserError: the checkpoint is missing or of another algorithm.
    """
    entry = REGISTRY[name]
    if entry.outside:
        return Acting(name, partial(behind(entry.act), target=target, points=points))
    if not entry.trained:
        return Acting(name, behind(entry.act))
    loaded: Acting = behind(entry.algorithm).load(checkpoint)
    return loaded


def run_evaluation(cfg: EvaluateConfig, out: Path) -> list[TrialRow]:
    """Evaluate the configured policy, and the expert if evaluation.expert says so.

    Returns:
        One row for each scheduled trial and policy.
    """
    if own := PROTOCOLS[cfg.evaluation.protocol]:
        rows: list[TrialRow] = behind(own)(cfg, out)
        return rows
    setup.choose_device(cfg.device)  # a missing device is an error before anything is read
    cfg, policies, facts, network = policies_of(cfg)
    protocol = setup.protocol(cfg, cfg.resume)
    objects = setup.load(setup.eval_entries(cfg.assets, out, cfg.seed))
    return evaluate(out, objects, policies, protocol, facts, network)


class Compared(NamedTuple):
    """Policies that are evaluated on the same trials, by name, with the settled configuration and facts about both."""

    cfg: EvaluateConfig
    policies: dict[str, TensorDictModuleBase]
    facts: dict[str, Any]
    network: nn.Module | None


def policies_of(cfg: EvaluateConfig) -> Compared:
    """The configured policy, and the expert if evaluation.expert says so."""
    chosen = acting(cfg.policy.name, cfg.checkpoint, cfg.policy.target, cfg.data.points)
    cfg = setup.settled(cfg, chosen.part_mask_input)
    limits, speeds = setup.velocity_limits(cfg), setup.flow_policy_options(cfg)
    policies: dict[str, TensorDictModuleBase] = {}
    if cfg.evaluation.expert:
        policies["expert"] = expert_policy(limits, speeds)
    made, facts = chosen.policy(limits, speeds), setup.facts(cfg)
    name = chosen.name
    if isinstance(made, Plugin):
        facts["policy_target"] = made.target
        if made.truths:
            name += "_privileged"
            facts["privileged_inputs"] = made.truths
    policies[name] = made
    return Compared(cfg, policies, facts, chosen.network)
