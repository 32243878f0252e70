"""The evaluation stage of the robot's trials: run them with every policy, and write the files that hold the results."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from tensordict.nn import TensorDictModuleBase

from fb3d_rl.evaluation.evaluate import progress_bars, refuse_other
from fb3d_rl.evaluation.robot_tables import stage_table, trial_table, write_tables
from fb3d_rl.evaluation.tables import print_tables, summary
from fb3d_rl.files import write_text
from fb3d_rl.robot.arm import named_arm
from fb3d_rl.robot.options import RobotOptions
from fb3d_rl.robot.policy_flow import asking
from fb3d_rl.robot.rows import FILE, RobotRow, read_robot, write_robot
from fb3d_rl.robot.trials import RobotTrial, Session, blank_rows, run_trial, run_trials, schedule, session_of
from fb3d_rl.rollout.rows import film_name, write_trials


def evaluate_robot(
    out: Path,
    policies: Mapping[str, TensorDictModuleBase],
    options: RobotOptions,
    seed: int,
    limit: int | None,
    workers: int,
    resume: bool,
    facts: Mapping[str, Any],
    videos: int = 0,
) -> list[RobotRow]:
    """Run the robot's trials with every policy.

    Writes robot.csv as they come; then rows.csv, the same in the columns of other trials, summary.json, and the tables
    of the supplement, robot_tables.md and robot_tables.csv; and videos/, films of some trials.

    Args:
        out: the run folder.
        policies: name -> policy.
        options: of the trials.
        seed: base seed.
        limit: at most so many trials with each policy, None for all.
        workers: processes.
        resume: keep the rows that are there.
        facts: entries for summary.json.
        videos: of so many objects the first trial is filmed with every policy.

    Returns:
        One row for each trial and policy.

    Raises:
        UserError: there is no such arm, no robot can follow a policy, or the rows to resume from are of other trials
            or policies.
    """
    named_arm(options.arm)  # a file that holds none ends here, and so does a policy that no robot can follow
    for policy in policies.values():
        asking(policy, np.zeros_like, 1.0)
    session, trials = session_of(options, seed), schedule(options, seed, limit)
    blanks = {name: blank_rows(name, policy, trials, session, options) for name, policy in policies.items()}
    done = _rows_before(out / FILE, blanks) if resume else {}
    with progress_bars() as bar:
        for name, policy in policies.items():
            left = {i: trial for i, trial in enumerate(trials) if (name, i) not in done}
            task = bar.add_task(f"robot: {name}", total=len(trials), completed=len(trials) - len(left))
            for row in run_trials(policy, left, blanks[name], session, options, out / "objects", workers):
                done[name, row.trial] = row
                write_robot(out / FILE, _ordered(done, policies))
                bar.advance(task)
    rows = _ordered(done, policies)
    as_trials = [row.as_trial() for row in rows]
    write_trials(out / "rows.csv", as_trials)
    numbers = summary(as_trials, [], facts)
    numbers["robot"] = {"calibration_deg": session.degrees, "calibration_mm": session.millimetres}
    write_text(out / "summary.json", json.dumps(numbers, indent=1) + "\n")
    if rows:
        write_tables(out, rows)
        print_tables([*(trial_table(rows, name) for name in policies), stage_table(rows)], Console())
    _film(out, rows, policies, trials, session, options, videos)
    return rows


def _film(
    out: Path,
    rows: Sequence[RobotRow],
    policies: Mapping[str, TensorDictModuleBase],
    trials: Sequence[RobotTrial],
    session: Session,
    options: RobotOptions,
    count: int,
) -> None:
    """Run the first trials of ``count`` objects again, filmed; those that crashed or have their films are left out."""
    objects = list(dict.fromkeys(trial.listed.label for trial in trials))[:count]
    folder = out / "videos"
    named = [(row, folder / film_name(row.as_trial())) for row in rows if row.repeat == 0 and row.object in objects]
    wanted = [(row, path) for row, path in named if row.status == "ok" and not Path(f"{path}.png").is_file()]
    if not wanted:
        return
    folder.mkdir(exist_ok=True)
    with progress_bars() as bar:
        for row, path in bar.track(wanted, description="videos"):
            run_trial(trials[row.trial], session, options, policies[row.policy], row, out / "objects", path)


def _ordered(done: Mapping[tuple[str, int], RobotRow], policies: Mapping[str, Any]) -> list[RobotRow]:
    return [done[key] for name in policies for key in sorted(key for key in done if key[0] == name)]


def _rows_before(path: Path, blanks: Mapping[str, Sequence[RobotRow]]) -> dict[tuple[str, int], RobotRow]:
    """The rows of an earlier run by policy and trial.

    Raises:
        UserError: one is of another trial or policy than is scheduled.
    """
    rows = read_robot(path) if path.is_file() else []
    for row in rows:
        scheduled = blanks.get(row.policy, ())
        blank = scheduled[row.trial] if row.trial < len(scheduled) else None
        expected = (None, None) if blank is None else (blank.key, blank.policy_digest)
        refuse_other(path, row, *expected)
    return {(row.policy, row.trial): row for row in rows}
