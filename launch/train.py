"""Train: ``python launch/train.py [algo=NAME] [assets=partnet_mobility assets.root=DIR] ...``, NAME as in conf/algo.

ArtFlowNet, BC and DAgger by several processes or GPUs: ``torchrun --nproc-per-node=N launch/train.py algo=NAME ...``.
"""

from __future__ import annotations

from fb3d_rl import interrupt

if __name__ == "__main__":
    interrupt.expect()

from pathlib import Path
from typing import Any

from command import main, report


def task(cfg: Any, out: Path) -> None:
    """Run the configured algorithm; its imports take seconds, so they come after the configuration's checks."""
    from fb3d_rl.algos.run import run_training
    from fb3d_rl.errors import UserError
    from fb3d_rl.registry import REGISTRY
    from fb3d_rl.training.processes import joined, rank_and_count, started

    if started() > 1 and (cfg.env.task is not None or not REGISTRY[cfg.algo.name].joint_fit):
        what = f"algo={cfg.algo.name}" if cfg.env.task is None else f"env.task={cfg.env.task}"
        raise UserError(f"{what} is trained by one process: start it without torchrun")
    with joined(out, fresh=not cfg.resume) as shared:
        run_training(cfg, shared)
        if rank_and_count()[0] == 0 and cfg.env.task is None:
            report(shared)


if __name__ == "__main__":
    interrupt.run(lambda: main("train", task))
