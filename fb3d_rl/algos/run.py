"""Train or evaluate the registry's entry that the configuration names: launch/train.py and launch/evaluate.py."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from fb3d_rl.algos import setup
from fb3d_rl.algos.algorithm import Acting
from fb3d_rl.evaluation.evaluate import evaluate
from fb3d_rl.policies.flow_policy import expert_policy
from fb3d_rl.registry import REGISTRY, behind
from fb3d_rl.rollout.rows import TrialRow

if TYPE_CHECKING:
    from fb3d_rl.config import EvaluateConfig, TrainConfig


def run_training(cfg: TrainConfig, out: Path) -> list[TrialRow]:
    """See :meth:`fb3d_rl.algos.algorithm.Algorithm.train`."""
    rows: list[TrialRow] = behind(REGISTRY[cfg.algo.name].algorithm).train(cfg, out)
    return rows


def acting(name: str, checkpoint: str | None) -> Acting:
    """The policy of that name; a trained one is loaded from its checkpoint.

    Raises:
        UserError: the checkpoint is missing or of another algorithm.
    """
    entry = REGISTRY[name]
    if not entry.trained:
        return Acting(name, behind(entry.act))
    loaded: Acting = behind(entry.algorithm).load(checkpoint)
    return loaded


def run_evaluation(cfg: EvaluateConfig, out: Path) -> list[TrialRow]:
    """Evaluate the configured policy, and the expert if evaluation.expert says so.

    Returns:
        One row for each scheduled trial and policy.
    """
    setup.choose_device(cfg.device)  # a missing device is an error before anything is read
    chosen = acting(cfg.policy.name, cfg.checkpoint)
    cfg = setup.settled(cfg, chosen.part_mask_input)
    protocol = setup.protocol(cfg, cfg.resume)
    limits, speeds = setup.velocity_limits(cfg), setup.flow_policy_options(cfg)
    policies = {"expert": expert_policy(limits, speeds)} if cfg.evaluation.expert else {}
    policies[chosen.name] = chosen.policy(limits, speeds)
    objects = setup.load(setup.eval_entries(cfg.assets, out, cfg.seed))
    return evaluate(out, objects, policies, protocol, setup.facts(cfg), chosen.network)
