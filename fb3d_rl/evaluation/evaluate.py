"""The evaluation stage of every command: scheduled trials, flow metrics, and the files that hold them."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from tensordict.nn import TensorDictModuleBase
from torch import nn

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.assets.catalog import LOST_GEOMETRY, lost_geometry
from fb3d_rl.data.samples import SampleOptions
from fb3d_rl.drawing.picture import write_picture
from fb3d_rl.env.options import EnvOptions
from fb3d_rl.errors import UserError
from fb3d_rl.evaluation.flow import flow_rows, held_out_samples, measure_flow
from fb3d_rl.evaluation.tables import DECISION, show, summary
from fb3d_rl.files import replacing, write_text
from fb3d_rl.flow.metrics import flow_metrics
from fb3d_rl.policies.digest import policy_digest
from fb3d_rl.robot.rows import RobotRow
from fb3d_rl.rollout.collectors import CollectorOptions
from fb3d_rl.rollout.rows import FlowRow, TrialRow, read_trials, write_flow, write_trials
from fb3d_rl.rollout.run import run_trials
from fb3d_rl.rollout.trials import Scheduled, ScheduleOptions, schedule, trial_key
from fb3d_rl.rollout.videos import film_trials
from fb3d_rl.training.run_log import read_rows


@dataclass(frozen=True)
class Protocol:
    """What is evaluated, and how often.

    Attributes:
        samples: clouds, views and camera of trials and flow samples.
        env: the task's constants.
        collector: where trials run.
        trials: at most this many trials, None for all, 0 for none.
        samples_per_object: flow samples of each object and target.
        clouds: clouds kept for the report.
        videos: trials filmed with every policy, 0 for none.
        seed: base seed of trials and samples.
        schedule: starts, goals and repetitions of the trials.
        decision_seconds: time limit of a decision, s; None for none.
        resume: keep the run folder's rows, which have to be of the same trials and policies.
        device: where the flow network is measured. Policies decide on the CPU, in the workers, so that trials do not
            depend on it.
    """

    samples: SampleOptions
    env: EnvOptions
    collector: CollectorOptions
    trials: int | None
    samples_per_object: int
    clouds: int
    videos: int
    seed: int
    schedule: ScheduleOptions = ScheduleOptions()
    decision_seconds: float | None = None
    resume: bool = False
    device: torch.device = torch.device("cpu")


def evaluate(
    out: Path,
    objects: Sequence[tuple[ArticulatedObject, str]],
    policies: Mapping[str, TensorDictModuleBase],
    protocol: Protocol,
    facts: Mapping[str, Any],
    net: nn.Module | None = None,
) -> list[TrialRow]:
    """Run the trials with every policy, measure the flow network, and write the results below ``out``.

    Writes rows.csv and summary.json, with ``net`` also flow_rows.csv, flow_rows_all_parts.csv, clouds.npz
    and flow.png, with ``protocol.videos`` also videos/, and prints the table.

    Args:
        out: the run folder.
        objects: the objects with their splits.
        policies: name -> policy.
        protocol: what is evaluated.
        facts: entries for summary.json (seed, command, git revision ...).
        net: the flow network to measure, on ``protocol.device``, as a copy.

    Returns:
        One row for each scheduled trial and policy.

    Raises:
        UserError: the rows to resume from are of other trials or policies.
    """
    numbers: dict[str, Any] = dict(facts)
    lost = facts.get(LOST_GEOMETRY, {}) | lost_geometry(obj for obj, _ in objects)
    if lost:
        numbers[LOST_GEOMETRY] = lost
    measured: list[FlowRow] = []
    if net is not None:
        measured, extra = _measure_flow(out, net, objects, protocol)
        numbers |= extra
        write_flow(out / "flow_rows.csv", measured)
    scheduled: list[Scheduled] = []
    if protocol.trials != 0:
        scheduled, numbers["n_hidden_parts"] = schedule(
            objects, protocol.samples, protocol.seed, protocol.trials, protocol.schedule
        )
    used = {item.trial.object for item in scheduled}
    shown = [obj for obj, _ in objects if obj.id in used]
    rows, milliseconds = _run_policies(out, policies, shown, scheduled, protocol)
    numbers = summary(rows, measured, numbers | milliseconds)
    write_text(out / "summary.json", json.dumps(numbers, indent=1) + "\n")
    show(numbers, Console())
    if net is not None and protocol.clouds:
        write_picture(out)
    if rows and protocol.videos:
        with progress_bars() as bar:
            task = bar.add_task("videos", total=None)
            film_trials(
                out / "videos", rows, protocol.videos, policies, shown, scheduled, protocol.env,
                lambda done, total: bar.update(task, completed=done, total=total),
            )  # fmt: skip
    return rows


def _run_policies(
    out: Path,
    policies: Mapping[str, TensorDictModuleBase],
    objects: Sequence[ArticulatedObject],
    scheduled: Sequence[Scheduled],
    protocol: Protocol,
) -> tuple[list[TrialRow], dict[str, float]]:
    """The rows of every policy, which rows.csv keeps as they come, and the summary's entries on decision times."""
    named = {obj.id: obj for obj in objects}
    keys = [trial_key(named[item.trial.object], item.trial, protocol.env.suction.hold) for item in scheduled]
    earlier = _rows_before(out / "rows.csv", policies, keys) if protocol.resume and scheduled else {}
    times = DecisionTimes(out, [row for done in earlier.values() for row in done.values()])
    rows: list[TrialRow] = []
    milliseconds: dict[str, float] = {}
    with progress_bars() as bar:
        for name, policy in policies.items() if scheduled else ():
            done = earlier.get(name, {})
            task = bar.add_task(f"trials: {name}", total=len(scheduled), completed=len(done))
            keep = partial(_keep, out / "rows.csv", rows, done, partial(bar.advance, task))
            _run(name, policy, objects, scheduled, protocol, done, keep, times)
            rows += [done[number] for number in sorted(done)]
            median = times.median(name)
            if median is not None:
                milliseconds[f"{name}/{DECISION.key}"] = 1000 * median
    return rows, milliseconds


def progress_bars() -> Progress:
    """Progress bars with a description, counts and the remaining time."""
    return Progress(TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())


def _rows_before(
    path: Path, policies: Mapping[str, TensorDictModuleBase], keys: Sequence[str]
) -> dict[str, dict[int, TrialRow]]:
    """The trials that each policy has run already, by their numbers: rows of the same trial and the same policy.

    Raises:
        UserError: a row is of another trial than is scheduled under its number, or of another policy.
    """
    rows: dict[str, dict[int, TrialRow]] = {name: {} for name in policies}
    digests = {name: policy_digest(policy) for name, policy in policies.items()}
    for row in read_trials(path) if path.is_file() else []:
        key = keys[row.trial] if row.trial < len(keys) else None
        refuse_other(path, row, key, digests.get(row.policy))
        rows[row.policy][row.trial] = row
    return rows


def refuse_other(path: Path, row: TrialRow | RobotRow, key: str | None, digest: str | None) -> None:
    """Refuse a row of an earlier run that is of another trial or of another policy.

    Args:
        path: of the rows, for the message.
        row: the row.
        key: of the trial that is scheduled under its number; None if none is.
        digest: of the policy of its name; None if there is none.

    Raises:
        UserError: it is of others.
    """
    of_row = f"{row.policy} with {row.category} {row.object}"
    remedy = "evaluate in another folder: hydra.run.dir=DIR"
    if row.key != key:
        raise UserError(f"{path} holds trial {row.trial}, {of_row}, which is not the one that is scheduled; {remedy}")
    if row.policy_digest != digest:
        raise UserError(
            f"{path} holds a trial of {of_row}, run by other weights or options than this evaluation has; {remedy}"
        )


class DecisionTimes:
    """Wall times of the decisions of each trial; not in the rows, since they differ between two runs.

    Args:
        out: the run folder.
        rows: rows whose times are kept from an earlier run.
    """

    FILE = "decision_times.jsonl"

    def __init__(self, out: Path, rows: Sequence[TrialRow] = ()) -> None:
        self._path = out / self.FILE
        known = {(row.policy, row.trial) for row in rows}
        lines = read_rows(self._path) if known and self._path.is_file() else []
        kept = [line for line in lines if (line["policy"], line["trial"]) in known]
        self._times: dict[str, list[float]] = {}
        for line in kept:
            self._times.setdefault(line["policy"], []).extend(line["seconds"])
        if kept or self._path.is_file():
            write_text(self._path, "".join(json.dumps(line) + "\n" for line in kept))

    def add(self, policy: str, trial: int, seconds: Sequence[float]) -> None:
        """Add the times [T] (s) of a trial."""
        rounded = [round(value, 6) for value in seconds]
        line = {"policy": policy, "trial": trial, "seconds": rounded}
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")
        self._times.setdefault(policy, []).extend(rounded)

    def median(self, policy: str) -> float | None:
        """Median (s) over the decisions of all trials of a policy; None without any."""
        times = self._times.get(policy)
        return float(np.median(times)) if times else None


def _run(
    name: str,
    policy: TensorDictModuleBase,
    objects: Sequence[ArticulatedObject],
    scheduled: Sequence[Scheduled],
    protocol: Protocol,
    done: Mapping[int, TrialRow],
    keep: Callable[[TrialRow], None],
    times: DecisionTimes,
) -> None:
    """Run the trials that are not done; each row goes to ``keep``, the wall times of its decisions to ``times``."""
    left = [number for number in range(len(scheduled)) if number not in done]
    run_trials(
        name, policy, objects, [scheduled[number] for number in left], protocol.env,
        lambda row: keep(replace(row, trial=left[row.trial])), protocol.collector, protocol.decision_seconds,
        lambda number, seconds: times.add(name, left[number], seconds),
    )  # fmt: skip


def _keep(
    path: Path, before: Sequence[TrialRow], done: dict[int, TrialRow], advance: Callable[[], None], row: TrialRow
) -> None:
    """Add a row to those of its policy, and write all rows."""
    done[row.trial] = row
    write_trials(path, [*before, *(done[number] for number in sorted(done))])
    advance()


def _measure_flow(
    out: Path,
    net: nn.Module,
    objects: Sequence[tuple[ArticulatedObject, str]],
    protocol: Protocol,
) -> tuple[list[FlowRow], dict[str, Any]]:
    """Rows of the target "part"; the numbers of the target "all" for summary.json; clouds for the report."""
    measured: list[FlowRow] = []
    extra: dict[str, Any] = {}
    net = copy.deepcopy(net).to(protocol.device)  # the policies' network stays on the CPU
    sets = held_out_samples(objects, protocol.samples, protocol.samples_per_object, protocol.seed)
    for target, (samples, about) in sets.items():
        predicted, numbers = measure_flow(net, samples, protocol.device)
        rows = flow_rows(numbers, about)
        if target == "part":
            measured = rows
            if protocol.clouds:
                _keep_clouds(out / "clouds.npz", samples, predicted, about, protocol.clouds)
            continue
        write_flow(out / "flow_rows_all_parts.csv", rows)
        everything = summary([], rows)
        extra["flow_all_parts"] = {key: value for key, value in everything.items() if key.startswith(("flow/", "by_"))}
    return measured, extra


def _keep_clouds(path: Path, samples: Any, predicted: torch.Tensor, about: Sequence[Any], count: int) -> None:
    """Save ``count`` clouds for the report, of as many categories as possible."""
    by_category: dict[str, list[int]] = {}
    for i, (obj, _, _) in enumerate(about):
        by_category.setdefault(obj.category, []).append(i)
    order: list[int] = []
    for turn in range(max(map(len, by_category.values()))):
        # A stride that is coprime to usual numbers of samples per object passes through all objects.
        order += [rows[(turn * 11) % len(rows)] for rows in by_category.values() if turn < len(rows)]
    chosen = list(dict.fromkeys(order))[:count]
    cosine = flow_metrics(predicted, samples["privileged", "flow"], samples["observation", "valid"])["cosine"]
    titles = [
        f"{about[i][0].category} {about[i][0].id}, {about[i][0].links[about[i][0].index(about[i][2])].semantic}, "
        f"cosine {cosine[i]:.3f}"
        for i in chosen
    ]
    kept = samples[torch.tensor(chosen)]
    with replacing(path) as beside:
        np.savez_compressed(
            beside,
            points=kept["observation", "points"].numpy(),
            valid=kept["observation", "valid"].numpy(),
            part_mask=kept["observation", "part_mask"].numpy(),
            flow_true=kept["privileged", "flow"].numpy(),
            flow_predicted=predicted[torch.tensor(chosen)].numpy(),
            title=np.array(titles),
        )
