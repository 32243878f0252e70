"""A policy server for robots: ``python launch/serve.py [checkpoint=PATH|pretrained] [policy=NAME] [port=8000] ...``."""

from __future__ import annotations

from fb3d_rl import interrupt

if __name__ == "__main__":
    interrupt.expect()

from pathlib import Path
from typing import Any

from command import main


def task(cfg: Any, out: Path) -> None:
    """Serve until Ctrl-C; the imports take seconds, so they come after the configuration's checks."""
    from fb3d_rl.serve.protocol import require_messages

    require_messages()
    from fb3d_rl.algos import setup
    from fb3d_rl.algos.run import acting
    from fb3d_rl.models.artflownet import ArtFlowNet
    from fb3d_rl.registry import REGISTRY
    from fb3d_rl.serve.episode import Served
    from fb3d_rl.serve.server import Door, serve

    device = setup.choose_device(cfg.device)
    checkpoint = cfg.checkpoint if REGISTRY[cfg.policy.name].trained else None
    chosen = acting(cfg.policy.name, checkpoint, cfg.policy.target, cfg.data.points)
    cfg = setup.settled(cfg, chosen.part_mask_input)
    limits, options = setup.velocity_limits(cfg), setup.flow_policy_options(cfg)
    network = chosen.network.to(device) if isinstance(chosen.network, ArtFlowNet) else None
    served = Served(
        chosen.name,
        checkpoint or "",
        lambda: chosen.policy(limits, options),
        network,
        limits,
        options,
        cfg.data.points,
    )
    serve(served, Door(cfg.host, cfg.port, cfg.token, cfg.megabytes, cfg.clients))


if __name__ == "__main__":
    interrupt.run(lambda: main("serve", task, keeps=False))
