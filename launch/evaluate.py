"""Evaluate: ``python launch/evaluate.py policy=NAME [checkpoint=PATH] [assets=...] ...``, NAME as in conf/policy."""

from __future__ import annotations

from fb3d_rl import interrupt

if __name__ == "__main__":
    interrupt.expect()

from pathlib import Path
from typing import Any

from command import main, report
from hydra.core.hydra_config import HydraConfig

from fb3d_rl.errors import UserError


def task(cfg: Any, out: Path) -> None:
    """Evaluate the configured policy; the imports take seconds, so they come after the configuration's checks."""
    given = [word.partition("=")[0].lstrip("+") for word in HydraConfig.get().overrides.task]
    if "assets.eval_split" in given:  # it would be left unread, and other objects measured than those it names
        raise UserError("assets.eval_split is what train evaluates on; name the objects to evaluate with assets.split")
    from fb3d_rl.algos.run import run_evaluation

    run_evaluation(cfg, out)
    report(out)


if __name__ == "__main__":
    interrupt.run(lambda: main("evaluate", task))
