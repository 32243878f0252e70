"""A live page of an object: ``python launch/view.py [checkpoint=PATH|pretrained] [object=ID|CATEGORY|DIR] ...``."""

from __future__ import annotations

from fb3d_rl import interrupt

if __name__ == "__main__":
    interrupt.expect()

import tempfile
from pathlib import Path
from typing import Any

from command import main


def task(cfg: Any, out: Path) -> None:
    """Serve the page until Ctrl-C; the imports take seconds, so they come after the configuration's checks."""
    from fb3d_rl.algos import setup
    from fb3d_rl.algos.weights import load_network
    from fb3d_rl.live.page import require_viser, serve
    from fb3d_rl.live.session import Session

    require_viser()
    device = setup.choose_device(cfg.device)
    net = load_network(cfg.checkpoint).to(device) if cfg.checkpoint else None
    cfg = setup.settled(cfg, net.part_mask_input if net else None)
    with tempfile.TemporaryDirectory() as folder:
        obj = setup.one_object(cfg, Path(folder))
    session = Session(
        obj,
        setup.sample_options(cfg),
        setup.env_options(cfg),
        setup.flow_policy_options(cfg),
        net,
        flow="true" if cfg.policy.name == "expert" else None,
        device=device,
        seed=cfg.seed,
    )
    serve(session, cfg.port)


if __name__ == "__main__":
    interrupt.run(lambda: main("view", task, keeps=False))
