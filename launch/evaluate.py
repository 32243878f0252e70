"""Evaluate: ``python launch/evaluate.py policy=NAME [checkpoint=PATH] [assets=...] ...``, NAME as in conf/policy."""

from __future__ import annotations

from fb3d_rl import interrupt

if __name__ == "__main__":
    interrupt.expect()

from pathlib import Path
from typing import Any

from command import main, report


def task(cfg: Any, out: Path) -> None:
    """Evaluate the configured policy; the imports take seconds, so they come after the configuration's checks."""
    from fb3d_rl.algos.run import run_evaluation

    run_evaluation(cfg, out)
    report(out)


if __name__ == "__main__":
    interrupt.run(lambda: main("evaluate", task))
