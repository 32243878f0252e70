"""Rows and tables of trials in UMPNet's world: FlowBot3D's supplement, Tables II and III, with our rows beside them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import as_completed
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict.nn import TensorDictModuleBase

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.assets.cache import content_digest
from fb3d_rl.assets.splits import TEST_CATEGORIES, TRAIN_CATEGORIES
from fb3d_rl.camera.embree import use_one_thread
from fb3d_rl.children import withheld, worker_pool
from fb3d_rl.env.umpnet.options import UmpnetOptions
from fb3d_rl.env.umpnet.scenes import Placed, Scene, place
from fb3d_rl.errors import UserError
from fb3d_rl.evaluation.evaluate import progress_bars, refuse_other
from fb3d_rl.evaluation.tables import DISTANCE, SUCCESS, Metric, measure
from fb3d_rl.files import write_text
from fb3d_rl.policies.digest import policy_digest
from fb3d_rl.policies.flow_policy import FlowPolicy
from fb3d_rl.policies.pulling import flow_of
from fb3d_rl.rollout.film import Film
from fb3d_rl.rollout.rows import CRASHED, NEVER_TOUCHED, STUCK, TIMED_OUT, WRONG_WAY, TrialRow, policies, write_trials
from fb3d_rl.rollout.run import mask_of
from fb3d_rl.rollout.umpnet import SUCCESS as NEAR
from fb3d_rl.rollout.umpnet import Episode, run_episodes
from fb3d_rl.rollout.umpnet_film import film_scene
from fb3d_rl.rollout.videos import write_films
from fb3d_rl.training.run_log import read_rows

PAGE = "umpnet.md"
"""File of the run folder with the tables."""

DETAILS = "umpnet.jsonl"
"""File of the run folder with a line for each row of rows.csv: what that has no columns for."""

LEGEND = (
    "n is scenes / objects. In brackets 95 % intervals (an object is the unit). Success: normalized distance below .1 "
    "at the end, where UMPNet's rule takes what is near the goal (.1 rad or .05 m, at most a 3.5th of the range) for "
    "there. By our own rule the distance is what it is where the trial ended."
)
"""What the page says of its numbers."""

PUBLISHED = {"UMPNet": (0.73, 0.75), "FlowBot3D": (0.81, 0.70)}
"""Success by class on new instances of the training categories and on test categories (supplement, Table III)."""


@dataclass(frozen=True)
class Detail:
    """What UMPNet's world adds to a row of rows.csv: the scene, its joint's way, and both rules of success.

    Attributes:
        row: the columns of the row.
        scene: of the scenes' table.
        opens: the goal is more open than the start; false in exploration.
        values: positions (rad or m of the object) of the joint at the start and after each pull.
        goal: its goal.
        reached: UMPNet's rule took the goal for reached; in exploration the end of the range.
        own_distance: the normalized distance without that rule.
        novelty: share of novel states, in exploration.
    """

    row: TrialRow
    scene: str
    opens: bool = False
    values: tuple[float, ...] = ()
    goal: float = 0.0
    reached: bool = False
    own_distance: float = 1.0
    novelty: float = 0.0

    @classmethod
    def read(cls, line: Mapping[str, Any]) -> Detail:
        """The inverse of ``dataclasses.asdict`` through JSON."""
        return cls(**{**line, "row": TrialRow(**line["row"]), "values": tuple(line["values"])})


@dataclass(frozen=True)
class Setting:
    """How the scenes are run.

    Attributes:
        options: the world's.
        points: of a cloud.
        seed: of each scene.
        workers: processes; 0 for this one alone.
        learn: policies whose predicted flow is corrected by what pulls bring.
    """

    options: UmpnetOptions
    points: int
    seed: int
    workers: int = 0
    learn: frozenset[str] = frozenset()

    def key(self, scene: Scene, obj: ArticulatedObject) -> str:
        """What a trial is, as :func:`fb3d_rl.rollout.trials.trial_key` gives it for others."""
        options = asdict(self.options) | {"batch": 0}
        whole = [repr(scene), content_digest(obj), options, self.points, self.seed, []]
        return hashlib.sha256(json.dumps(whole).encode()).hexdigest()[:16]

    def digest(self, name: str, policy: TensorDictModuleBase) -> str:
        """Identifies the policy of that name, and whether it learns."""
        digest = policy_digest(policy)
        return hashlib.sha256(f"{digest} learns".encode()).hexdigest()[:16] if name in self.learn else digest


Job = tuple[int, Scene, ArticulatedObject, str]
"""Number of the trial, scene, object and the object's split."""


def evaluate_scenes(
    out: Path,
    jobs: Sequence[Job],
    named: Mapping[str, TensorDictModuleBase],
    setting: Setting,
    resume: bool = False,
) -> list[Detail]:
    """Run every scene with every policy; rows.csv and :data:`DETAILS` of the run folder hold what is done so far.

    Raises:
        UserError: a policy follows no flow, PyBullet is missing, or the rows to resume from are of other trials.
    """
    before = _before(out / DETAILS, jobs, named, setting) if resume else []
    rows: list[Detail] = []
    with progress_bars() as bar:
        for name, policy in named.items():
            done = {detail.row.trial: detail for detail in before if detail.row.policy == name}
            left = [job for job in jobs if job[0] not in done]
            # Scenes of one object lie together, so that its pictures are taken from one hierarchy.
            chunks = [left[i : i + setting.options.batch] for i in range(0, len(left), setting.options.batch)]
            task = bar.add_task(f"scenes: {name}", total=len(jobs), completed=len(done))
            for found in _run(name, policy, chunks, setting):
                done |= {detail.row.trial: detail for detail in found}
                _write(out, [*rows, *(done[number] for number in sorted(done))])
                bar.advance(task, len(found))
            rows += [done[number] for number in sorted(done)]
    return rows


def film_scenes(
    folder: Path, rows: Sequence[TrialRow], count: int, jobs: Sequence[Job],
    named: Mapping[str, TensorDictModuleBase], setting: Setting,
) -> None:  # fmt: skip
    """Write films of ``count`` scenes with every policy below a folder."""
    scheduled = {job[0]: job for job in jobs}

    def again(row: TrialRow) -> Film:
        _, scene, obj, _ = scheduled[row.trial]
        name, policy = row.policy, named[row.policy]
        return film_scene(
            name, place(scene, obj), flow_of(policy, name), setting.options, setting.points, setting.seed,
            isinstance(policy, FlowPolicy), name in setting.learn, NEAR,
        )  # fmt: skip

    with progress_bars() as bar:
        task = bar.add_task("videos", total=None)
        write_films(folder, rows, count, again, lambda done, total: bar.update(task, completed=done, total=total))


def _write(out: Path, details: Sequence[Detail]) -> None:
    write_text(out / DETAILS, "".join(json.dumps(asdict(detail)) + "\n" for detail in details))
    write_trials(out / "rows.csv", [detail.row for detail in details])


def read_details(path: Path) -> list[Detail]:
    """The lines of a run folder's :data:`DETAILS`.

    Raises:
        UserError: the file is missing or broken.
    """
    try:
        return [Detail.read(line) for line in read_rows(path)]
    except (OSError, TypeError, KeyError, ValueError, AttributeError) as error:
        raise UserError(f"{path} holds no trials in UMPNet's world ({error})") from error


def _before(
    path: Path, jobs: Sequence[Job], named: Mapping[str, TensorDictModuleBase], setting: Setting
) -> list[Detail]:
    if not path.is_file():
        return []
    keys = {job[0]: setting.key(job[1], job[2]) for job in jobs}
    digests = {name: setting.digest(name, policy) for name, policy in named.items()}
    found = read_details(path)
    for row in (detail.row for detail in found):
        refuse_other(path, row, keys.get(row.trial), digests.get(row.policy))
    return found


def _run(
    name: str, policy: TensorDictModuleBase, chunks: Sequence[Sequence[Job]], setting: Setting
) -> Iterator[list[Detail]]:
    work: Callable[[Sequence[Job]], list[Detail]] = partial(run_chunk, name, policy, setting)
    if not setting.workers:
        yield from map(work, chunks)
        return
    with worker_pool(setting.workers, _one_thread) as pool:
        with withheld():
            futures = [pool.submit(work, chunk) for chunk in chunks]
        for future in as_completed(futures):
            yield future.result()


def _one_thread() -> None:
    torch.set_num_threads(1)
    use_one_thread()


def run_chunk(name: str, policy: TensorDictModuleBase, setting: Setting, jobs: Sequence[Job]) -> list[Detail]:
    """Run some scenes side by side; if that crashes, each alone, so that those at fault are failures and no others."""
    flow = flow_of(policy, name)
    common: dict[str, Any] = {"policy": name, "mask": mask_of(policy), "policy_digest": setting.digest(name, policy)}
    try:
        placed = [place(scene, obj) for _, scene, obj, _ in jobs]
        expert, learn = isinstance(policy, FlowPolicy), name in setting.learn
        episodes = run_episodes(placed, flow, setting.options, setting.points, setting.seed, expert, learn)
    except UserError:
        raise
    except Exception as error:  # noqa: BLE001, a policy of others may raise anything
        if len(jobs) > 1:
            return [detail for job in jobs for detail in run_chunk(name, policy, setting, [job])]
        number, scene, obj, split = jobs[0]
        row = TrialRow(
            trial=number, object=obj.id, category=obj.category, split=split, link="", semantic="", joint_type="",
            seed=setting.seed, key=setting.key(scene, obj), status="error", error=f"{type(error).__name__}: {error}",
            failure=CRASHED, **common,
        )  # fmt: skip
        return [Detail(row, scene.name)]
    return [
        _detail(episode, number, split, setting, common)
        for episode, (number, _, _, split) in zip(episodes, jobs, strict=True)
    ]


def _detail(episode: Episode, number: int, split: str, setting: Setting, common: Mapping[str, Any]) -> Detail:
    placed = episode.placed
    scene, obj = placed.scene, placed.posed.obj
    explores = placed.joint < 0
    link = episode.link if explores else placed.link
    distance = 1.0 - episode.novelty if explores else episode.distance
    success = episode.reached if explores else distance < NEAR
    part = obj.links[link] if link >= 0 else None
    row = TrialRow(
        trial=number, object=obj.id, category=scene.category, split=split, link="" if part is None else part.name,
        semantic="" if part is None else part.semantic, joint_type="" if link < 0 else obj.joint_of(link).type,
        seed=setting.seed, steps=max(len(episode.values) - 1, 0), contact=episode.right, success=success,
        normalized_distance=distance, attach_step=0 if episode.right else -1, held_opened=success,
        failure="" if success else _failure(episode, placed), key=setting.key(scene, obj), **common,
    )  # fmt: skip
    goal = 0.0 if episode.joint < 0 else float(placed.goal[episode.joint])
    return Detail(
        row, scene.name, not explores and placed.towards_open, tuple(episode.values), goal, episode.reached,
        episode.own_distance, episode.novelty,
    )  # fmt: skip


def _failure(episode: Episode, placed: Placed) -> str:
    if not episode.right:
        return NEVER_TOUCHED
    if episode.own_distance > 1.01:
        return WRONG_WAY
    way = abs(episode.values[0] - placed.goal[episode.joint])
    return STUCK if len(episode.values) < 2 or abs(episode.values[-1] - episode.values[-2]) < 0.01 * way else TIMED_OUT


def page(details: Sequence[Detail], setting: Setting, said: Iterable[str], command: str) -> str:
    """The tables of a run as Markdown."""
    options = setting.options
    lines = ["# In UMPNet's world", "", f"`{command}`", ""]
    lines += [f"{options.task} scenes, {options.backend} backend, mask: {options.mask}. {LEGEND}", ""]
    lines += [f"- {sentence}" for sentence in said]
    if options.task == "exploration":
        return "\n".join([*lines, *_table(details, "Share of novel states", DISTANCE, lambda d: d.row, True)]) + "\n"
    lines += _table(details, "Table III: success", SUCCESS, lambda d: d.row)
    lines += ["", "Published, by class (train categories, test categories): " + "; ".join(
        f"{name} {train:.2f}, {test:.2f}" for name, (train, test) in PUBLISHED.items()
    ) + ". The columns of single categories are icons in the published table."]  # fmt: skip
    lines += _table([d for d in details if d.opens], "Success, goals that are more open than the start", SUCCESS, _row)
    lines += _table([d for d in details if not d.opens], "Success, goals that are more closed", SUCCESS, _row)
    lines += _table(details, "Success by our own rule", SUCCESS, _own)
    lines += _table(details, "Table II: normalized distance", DISTANCE, _row)
    return "\n".join(lines) + "\n"


def _row(detail: Detail) -> TrialRow:
    return detail.row


def _own(detail: Detail) -> TrialRow:
    """The row by our own rule: success is being there, not being near."""
    values = asdict(detail.row) | {"success": detail.own_distance < NEAR and detail.row.status == "ok"}
    return TrialRow(**values)


def _table(
    details: Sequence[Detail], title: str, metric: Metric, row_of: Callable[[Detail], TrialRow], inverse: bool = False
) -> Iterator[str]:
    """A metric by category, a column for each policy; ``inverse``: 1 minus it."""
    rows = [row_of(detail) for detail in details]
    names = policies(rows)
    yield from ("", f"## {title}", "", "| | n | " + " | ".join(names) + " |", "|" + " --- |" * (2 + len(names)))
    kinds = {"train categories": TRAIN_CATEGORIES, "test categories": TEST_CATEGORIES}
    for kind, categories in kinds.items():
        groups = {name: [name] for name in categories} | {f"**{kind}, class mean**": list(categories)}
        for label, held in groups.items():
            of_group = [row for row in rows if row.category in held]
            if not of_group:
                continue
            cells = [
                _cell([row for row in of_group if row.policy == name], metric, len(held) > 1, inverse) for name in names
            ]
            first = [row for row in of_group if row.policy == names[0]]
            n = f"{len(first)} / {len({(row.category, row.object) for row in first})}"
            yield f"| {label} | {n} | " + " | ".join(cells) + " |"
        cells = [
            _over_scenes([row for row in rows if row.policy == name], categories, metric, inverse) for name in names
        ]
        if any(cells):
            yield f"| {kind}, categories' means over scenes | | " + " | ".join(cells) + " |"


def _over_scenes(rows: Sequence[TrialRow], categories: Sequence[str], metric: Metric, inverse: bool) -> str:
    """The class mean where all scenes of a category weigh the same, as UMPNet's script has it."""
    groups = [[row for row in rows if row.category == name] for name in categories]
    found = [
        np.mean([row.success if metric is SUCCESS else row.normalized_distance for row in group])
        for group in groups
        if group
    ]
    mean = float(np.mean(found)) if found else None
    return "" if mean is None else f"{1 - mean if inverse else mean:.2f}"


def _cell(rows: Sequence[TrialRow], metric: Metric, classes: bool, inverse: bool) -> str:
    found = measure(rows, metric)
    mean, interval = (found.class_, found.class_ci95) if classes else (found.instance, found.instance_ci95)
    if mean is None:
        return "–"
    ends = (mean, *(interval or ()))
    shown = [f"{1 - x if inverse else x:.2f}" for x in ends]
    return shown[0] + (f" ({min(shown[1:])}–{max(shown[1:])})" if interval else "")
