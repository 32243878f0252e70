"""A live page of an object: ``python launch/view.py [checkpoint=PATH|pretrained] [object=ID|CATEGORY|DIR] ...``.

With ``policy=dagger checkpoint=RUN [record=FOLDER]`` the learner acts, and a person may take over.
"""

from __future__ import annotations

from fb3d_rl import interrupt

if __name__ == "__main__":
    interrupt.expect()

import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from command import main


def task(cfg: Any, out: Path) -> None:
    """Serve the page until Ctrl-C; the imports take seconds, so they come after the configuration's checks."""
    from fb3d_rl.config import LEARNERS
    from fb3d_rl.live.page import require_viser

    require_viser()
    (watch_learner if cfg.policy.name in LEARNERS else show_flow)(cfg)


def show_flow(cfg: Any) -> None:
    """The page of an object, its flow and the flow policy."""
    from fb3d_rl.algos import setup
    from fb3d_rl.algos.weights import load_network
    from fb3d_rl.live.page import serve
    from fb3d_rl.live.session import Session

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


def watch_learner(cfg: Any) -> None:
    """The page on which a learner acts and a person takes over, which is recorded if the configuration says where."""
    from fb3d_rl.algos import setup
    from fb3d_rl.algos.recording import Recording, shared_rows
    from fb3d_rl.algos.run import acting
    from fb3d_rl.env.torchrl_env import require_simulator
    from fb3d_rl.live.page import serve
    from fb3d_rl.live.shared import SharedSession
    from fb3d_rl.live.shared_page import SharedPage

    require_simulator("choose policy=artflownet, whose page does without")
    chosen = acting(cfg.policy.name, cfg.checkpoint)
    cfg = setup.settled(cfg, chosen.part_mask_input)
    env, limits, speeds = setup.env_options(cfg), setup.velocity_limits(cfg), setup.flow_policy_options(cfg)
    learner = chosen.policy(limits, speeds)
    with ExitStack() as stack:
        recording = None
        if cfg.record is not None:
            rows, root = shared_rows(learner, limits), setup.object_root(cfg)
            recording = stack.enter_context(Recording(cfg.record, rows, env, chosen.fits, root))
        with tempfile.TemporaryDirectory() as folder:
            obj = setup.one_object(cfg, Path(folder))
            if recording is not None:
                recording.keep_object(obj)
        session = SharedSession(obj, setup.sample_options(cfg), env, speeds, learner, recording, cfg.seed)
        serve(session, cfg.port, page=SharedPage)


if __name__ == "__main__":
    interrupt.run(lambda: main("view", task, keeps=False))
