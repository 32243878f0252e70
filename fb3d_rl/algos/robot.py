"""protocol=robot of launch/evaluate.py: the configured policy before a robot arm in the simulated cell."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from fb3d_rl.algos import setup
from fb3d_rl.drawing.video import require_encoder
from fb3d_rl.env.torchrl_env import require_simulator
from fb3d_rl.evaluation.robot import evaluate_robot
from fb3d_rl.rollout.rows import TrialRow

if TYPE_CHECKING:
    from fb3d_rl.config import EvaluateConfig


def run(cfg: EvaluateConfig, out: Path) -> list[TrialRow]:
    """Run the robot's trials (:func:`fb3d_rl.evaluation.robot.evaluate_robot`).

    Raises:
        UserError: the simulator or, for videos, ffmpeg is missing, a robot cannot follow the policy, or the rows to
            resume from are of other trials.
    """
    from fb3d_rl.algos.run import policies_of  # imports this module's caller

    require_simulator()
    if cfg.evaluation.videos:
        require_encoder()
    made = policies_of(cfg)
    count = 1 if cfg.collector.backend == "direct" else setup.collector_options(made.cfg).workers
    rows = evaluate_robot(
        out, made.policies, cfg.robot, cfg.seed, cfg.evaluation.trials, count, cfg.resume, made.facts,
        cfg.evaluation.videos,
    )  # fmt: skip
    return [row.as_trial() for row in rows]
