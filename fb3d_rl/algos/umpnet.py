"""protocol=umpnet of launch/evaluate.py: the configured policy in UMPNet's world."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from fb3d_rl.algos import setup
from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.drawing.video import require_encoder
from fb3d_rl.env.umpnet.scenes import read_scenes, sorted_out, stand_in
from fb3d_rl.errors import UserError
from fb3d_rl.evaluation.tables import show, summary
from fb3d_rl.evaluation.umpnet import PAGE, Job, Setting, evaluate_scenes, film_scenes, page
from fb3d_rl.files import write_text
from fb3d_rl.rollout.rows import TrialRow

if TYPE_CHECKING:
    from fb3d_rl.config import EvaluateConfig
    from fb3d_rl.env.umpnet.options import UmpnetOptions


def run(cfg: EvaluateConfig, out: Path) -> list[TrialRow]:
    """Run the scenes with the configured policy, and with the expert if evaluation.expert says so.

    Writes rows.csv, umpnet.jsonl, summary.json, umpnet.md and films below ``out``.

    Raises:
        UserError: no scene has one of the objects, the policy follows no flow, or PyBullet is missing.
    """
    from fb3d_rl.algos.run import policies_of  # imports this module's caller

    learns = cfg.policy.flow.learn
    # What a policy of the simulated task learns by touch is of no use here: episodes have a rule of their own.
    plain = replace(cfg, policy=replace(cfg.policy, flow=replace(cfg.policy.flow, learn=False)))
    cfg, named, facts, network = policies_of(plain)
    if cfg.evaluation.videos:
        require_encoder()
    objects = setup.load(setup.eval_entries(cfg.assets, out, cfg.seed))
    jobs, said = scheduled(objects, cfg.umpnet, cfg.assets.source == "procedural", cfg.evaluation.trials)
    collector = setup.collector_options(cfg)
    workers = 0 if collector.backend == "direct" else collector.workers
    learn = frozenset([*named][-1:] if learns and network is not None else ())
    setting = Setting(cfg.umpnet, cfg.data.points, cfg.seed, workers, learn)
    details = evaluate_scenes(out, jobs, named, setting, cfg.resume)
    rows = [detail.row for detail in details]
    about = {"task": cfg.umpnet.task, "backend": cfg.umpnet.backend, "mask": cfg.umpnet.mask, "left_out": said}
    numbers = summary(rows, [], facts | {"umpnet": about})
    write_text(out / "summary.json", json.dumps(numbers, indent=1) + "\n")
    write_text(out / PAGE, page(details, setting, said, facts["command"]))
    show(numbers, Console())
    print(*said, f"the tables are in {out / PAGE}", sep="\n")
    if cfg.evaluation.videos:
        film_scenes(out / "videos", rows, cfg.evaluation.videos, jobs, named, setting)
    return rows


def scheduled(
    objects: Sequence[tuple[ArticulatedObject, str]], options: UmpnetOptions, procedural: bool, limit: int | None
) -> tuple[list[Job], list[str]]:
    """The scenes with their objects, and what is to be said about scenes that are left out.

    Args:
        objects: objects with their splits.
        options: of UMPNet's world.
        procedural: objects stand in for those of the scenes, of the same category in turn.
        limit: at most this many scenes, of the categories in turn; None for all.

    Raises:
        UserError: none is left.
    """
    scenes = read_scenes(options.task)
    if procedural:
        by_category: dict[str, list[ArticulatedObject]] = {}
        for obj, _ in objects:
            by_category.setdefault(obj.category, []).append(obj)
        missing = sorted({scene.category for scene in scenes} - set(by_category))
        scenes = [
            stand_in(scene, by_category[scene.category][scene.number % len(by_category[scene.category])])
            for scene in scenes
            if scene.category in by_category
        ]
        said = ["procedural objects stand in for UMPNet's: results are no comparison with published numbers"]
        said += [f"no procedural object of {', '.join(missing)}"] if missing else []
        if not scenes:
            raise UserError("assets.categories has none of UMPNet's categories; give assets=procedural_all")
    else:
        scenes, left = sorted_out(scenes, [obj.id for obj, _ in objects])
        said = left.sentences()
    if limit is not None:
        scenes = sorted(scenes, key=lambda scene: scene.number)[:limit]
    scenes = sorted(scenes, key=lambda scene: (scene.category, scene.object, scene.number))
    known = {obj.id: (obj, split) for obj, split in objects}
    return [(number, scene, *known[scene.object]) for number, scene in enumerate(scenes)], said
