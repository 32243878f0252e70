"""Where the hand of an imitation run is at the end of the trials in which it never held the part, and what the expert
would do there: ``PYTHONPATH=. python tests/examples/lost_contact.py RUN``.
"""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path

import torch
from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from omegaconf import OmegaConf

from fb3d_rl.algos import setup
from fb3d_rl.algos.dagger import ALGORITHM
from fb3d_rl.config import configured, schemas
from fb3d_rl.policies.flow_policy import expert_policy
from fb3d_rl.policies.interaction import BetaGate, InteractivePolicy
from fb3d_rl.rollout.collectors import CollectorOptions, Workers
from fb3d_rl.rollout.run import create_env, state_of
from fb3d_rl.rollout.trials import schedule

LAST = 50
"""Steps (2.5 s) at the end of a trial that are looked at."""

KEYS = [
    *(("observation", key) for key in ("tool_pose", "valid", "part_mask")), "action", ("expert", "action"),
    ("next", "policy", "contact_point"), ("next", "contact"),
]  # fmt: skip


def config_of(run):
    """The configuration that a run was started with."""
    for (group, name), node in schemas("train").items():
        ConfigStore.instance().store(group=group, name=name, node=node)
    saved = OmegaConf.load(run / "config.yaml")
    with initialize_config_dir(str(Path(__file__).resolve().parents[2] / "conf"), version_base="1.3"):
        raw = compose("train", [f"algo={saved.algo.name}"])
    return configured(OmegaConf.to_object(OmegaConf.merge(raw, saved)))


def ended(frames):
    """Numbers of a trial's frames [T]."""
    tip, action, label = frames["observation", "tool_pose"][-LAST:, :3], frames["action"], frames["expert", "action"]
    goal = frames["next", "policy", "contact_point"][-LAST:]
    shown = frames["observation", "valid"] & frames["observation", "part_mask"]
    own, expert = action[-LAST:, :3], label[-LAST:, :3]
    return {
        "way to the expert's contact point, m": (tip[-1] - goal[-1]).norm(),
        "the tip's mean distance from its mean place, m": (tip - tip.mean(0)).norm(dim=-1).mean(),
        "speed, share of the largest": own.norm(dim=-1).mean(),
        "the expert's": expert.norm(dim=-1).mean(),
        "cosine between the two": torch.nn.functional.cosine_similarity(own, expert, dim=-1).mean(),
        "changes of the expert's point by more than 5 cm": (goal.diff(dim=0).norm(dim=-1) > 0.05).sum(),
        "of 256 points those on the part": shown[0, :256].sum(),
    }


def main(run):
    cfg = config_of(run)
    protocol, entries = setup.protocol(cfg), setup.train_entries(cfg.assets, run, cfg.seed)
    tested, limits, options = setup.load(entries.held_out), setup.velocity_limits(cfg), setup.flow_policy_options(cfg)
    trials, _ = schedule(tested, protocol.samples, cfg.seed, protocol.trials, protocol.schedule)
    policy = InteractivePolicy(
        expert_policy(limits, options), ALGORITHM.load(run).policy(limits, options), BetaGate(0.0)
    )
    create = partial(create_env, tuple(obj for obj, _ in tested), protocol.env, state_of(policy))
    rows = {True: [], False: []}
    with Workers(create, policy, CollectorOptions(backend="direct", workers=1), protocol.env.horizon) as workers:
        for episode in workers.run([item.trial for item in trials], KEYS):
            if episode.frames is not None:
                rows[bool(episode.frames["next", "contact"].any())].append(ended(episode.frames))
    print(f"{len(rows[False])} trials without hold, {len(rows[True])} with; medians over them")
    for key in rows[False][0] if rows[False] else ():
        medians = [torch.stack([row[key] for row in rows[held]]).double().median() for held in (False, True)]
        print(f"  {key}: {medians[0]:.2f}, {medians[1]:.2f}")


if __name__ == "__main__":
    torch.set_num_threads(1)
    main(Path(sys.argv[1]))
