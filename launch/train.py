"""Train: ``python launch/train.py [algo=artflownet|bc|dagger] [assets=partnet_mobility assets.root=DIR] ...``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from command import main


def task(cfg: Any, out: Path) -> None:
    """Run the configured algorithm; its imports take seconds, so they come after the configuration's checks."""
    from fb3d_rl.algos import artflownet, dagger

    {"artflownet": artflownet.run, "bc": dagger.run, "dagger": dagger.run}[cfg.algo.name](cfg, out)


if __name__ == "__main__":
    main("train", task)
