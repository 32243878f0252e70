"""The robot's trials (supplement, IV and VI): which there are, and one of them from the empty cell to its row."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from tensordict.nn import TensorDictModuleBase

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.children import withheld, worker_pool
from fb3d_rl.policies.digest import policy_digest
from fb3d_rl.robot.arm import named_arm
from fb3d_rl.robot.attempt import OPEN, STAGES, AttemptOptions
from fb3d_rl.robot.calibration import calibrated, pose_error
from fb3d_rl.robot.calibration_session import simulate
from fb3d_rl.robot.episode import attempt
from fb3d_rl.robot.film import Filmed
from fb3d_rl.robot.marker import Marker
from fb3d_rl.robot.objects import SEED, TABLE_I, Listed, make, on_table
from fb3d_rl.robot.options import RobotOptions
from fb3d_rl.robot.policy_flow import asking
from fb3d_rl.robot.rows import RobotRow
from fb3d_rl.robot.simulated import CellOptions, SimulatedCell
from fb3d_rl.rollout.run import mask_of
from fb3d_rl.seeds import derived

Array = NDArray[np.float64]

ENOUGH = 0.02
"""A pull ends when less than this is left: the distance that is measured is not that of the first success."""

SEEN = 4800
"""Points of an attempt's cloud: policies see fewer, which these smooth."""

SLANT = 25.0
"""Largest angle between the flow and the surface's normal at the contact, degrees: a cup that comes along the flow
seals up to there."""

MARGIN = 0.008
"""By how much farther out than the lip there has to be surface, m: by so much calibration and camera may be off."""

LEARNER_LOOKS = 0.25
"""Time between two answers of a learner in a pull, s: it steers by itself, while a flow tells how to go on."""


@dataclass(frozen=True)
class Session:
    """What stays the same in all trials of a run: the camera's bias, and one calibration.

    Attributes:
        seed: of the session.
        error: T_true_believed [4, 4] of the camera, as rows.
        degrees: by which its orientation is off.
        millimetres: by which its position is off.
    """

    seed: int
    error: tuple[tuple[float, ...], ...]
    degrees: float
    millimetres: float


@dataclass(frozen=True)
class RobotTrial:
    """One trial: which object, where it stands (x, y in m and turn in rad), and the seed of all else."""

    listed: Listed
    repeat: int
    place: tuple[float, float, float]
    seed: int


def session_of(options: RobotOptions, seed: int) -> Session:
    """The session of a run: its calibration is off as the options say, or as a simulated one turns out."""
    own = derived(seed, "robot", "session") % 2**31
    if options.calibration_deg is None:
        result = calibrated(simulate(30, own, Marker()), Marker())
        assert result.truth is not None
        error = np.linalg.inv(result.truth.camera) @ result.found.camera
    else:
        rng = np.random.default_rng(own)
        axis, way = (vector / np.linalg.norm(vector) for vector in rng.standard_normal((2, 3)))
        error = np.eye(4)
        error[:3, :3] = Rotation.from_rotvec(np.radians(options.calibration_deg) * axis).as_matrix()
        error[:3, 3] = options.calibration_mm / 1000 * way
    degrees, metres = pose_error(error, np.eye(4))
    return Session(own, tuple(map(tuple, error.tolist())), degrees, 1000 * metres)


def schedule(options: RobotOptions, seed: int, limit: int | None = None) -> list[RobotTrial]:
    """The trials, in the order of Table I; each depends on seed, object and repetition alone.

    Args:
        options: how many there are of each object.
        seed: of the run.
        limit: at most so many, taken from the objects in turn.
    """
    trials = []
    for repeat in range(options.trials):
        for listed in TABLE_I:
            own = derived(seed, "robot", listed.label, repeat) % 2**31
            trials.append(RobotTrial(listed, repeat, listed.stand.draw(np.random.default_rng(own)), own))
    return sorted(trials[:limit], key=lambda trial: TABLE_I.index(trial.listed))


def key_of(trial: RobotTrial, session: Session, options: RobotOptions) -> str:
    """What a trial is, as a digest (16 hexadecimal digits): two rows with the same key ran the same trial."""
    whole = [SEED, asdict(trial), asdict(session), asdict(options)]
    return hashlib.sha256(json.dumps(whole).encode()).hexdigest()[:16]


def attempt_options(options: RobotOptions, learner: bool = False) -> AttemptOptions:
    """How attempts are made."""
    defaults = AttemptOptions()
    return replace(
        defaults,
        place=replace(defaults.place, rim=options.rim, margin=MARGIN, slant=SLANT if options.rim else 90.0),
        points=SEEN,
        grips=options.grips,
        pictures=options.pictures,
        deviations=defaults.deviations if options.outliers else np.inf,
        look_every=LEARNER_LOOKS if learner else defaults.look_every,
    )


def cell_of(trial: RobotTrial, obj: ArticulatedObject, session: Session, options: RobotOptions) -> SimulatedCell:
    """The cell with the trial's object in it."""
    defaults = CellOptions()
    felt = (defaults.force_bias, defaults.force_noise) if options.force_noise else (0.0, 0.0)
    cell = CellOptions(
        noise=options.depth_noise(),
        suction="seal" if options.seal else "perfect",
        force_bias=felt[0],
        force_noise=felt[1],
    )
    content, error = on_table(trial.listed, obj, trial.place), np.array(session.error)
    return SimulatedCell(named_arm(options.arm), content, cell, session.seed, trial.seed, error)


@lru_cache(maxsize=len(TABLE_I))
def _object(listed: Listed, folder: Path) -> ArticulatedObject:
    return make(listed, folder)


def run_trial(
    trial: RobotTrial,
    session: Session,
    options: RobotOptions,
    policy: TensorDictModuleBase,
    blank: RobotRow,
    folder: Path,
    film: Path | None = None,
) -> RobotRow:
    """Run a trial.

    Args:
        trial: it.
        session: of all trials.
        options: of them.
        policy: what is asked for the flow (:func:`~fb3d_rl.robot.policy_flow.asking`).
        blank: the trial's row, with nothing achieved.
        folder: of the objects.
        film: where a film (.mp4) and a filmstrip (.png) of it are written, without their suffixes.
    """
    began = time.process_time()
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # as sums are split in every worker; not steady_floats, with which SciPy's trees crash
    try:
        cell = cell_of(trial, _object(trial.listed, folder), session, options)
        o = attempt_options(options)
        predictor, puller = asking(policy, cell.flow, o.pull_speed)
        o = attempt_options(options, puller is not None)
        filmed = None if film is None else Filmed(cell, f"{trial.listed.label} · {blank.policy}")
        made = attempt(
            filmed or cell, cell.arm, cell.believed, predictor, o, trial.seed, puller,
            lambda: cell.distance() < ENOUGH, None if filmed is None else filmed.say,
        )  # fmt: skip
        distance, seconds, wall = cell.distance(), cell.joints().time, time.process_time() - began
    finally:
        torch.set_num_threads(threads)
    if filmed is not None and film is not None:
        filmed.write(film.with_name(film.name + ".mp4"))
        filmed.write_filmstrip(film.with_name(film.name + ".png"))
    passed: dict[str, Any] = {stage: bool(getattr(made, stage)) for stage in STAGES}
    passed["opened"] = made.moved and distance < OPEN
    off = float(np.linalg.norm(made.felt - made.contact))
    return replace(
        blank,
        **passed,
        reason="" if made.reason is None or passed["opened"] else made.reason.value,
        sentence=made.sentence,
        cup=" ".join(cell.cup.torn or (() if made.sealed or cell.cup.seal is None else cell.cup.seal.failed)),
        distance=distance if made.sealed else 1.0,
        way=made.way,
        off=off if np.isfinite(off) else -1.0,
        force=float(np.linalg.norm(made.forces, axis=1).max(initial=0.0)),
        seconds=seconds,
        grips=made.grips,
        wall=wall,
    )


def blank_rows(
    name: str, policy: TensorDictModuleBase, trials: Sequence[RobotTrial], session: Session, options: RobotOptions
) -> list[RobotRow]:
    """The rows of trials in which nothing was achieved."""
    digest, mask = policy_digest(policy), mask_of(policy)
    return [
        RobotRow(
            i, name, trial.listed.label, trial.listed.category, trial.listed.joint, trial.repeat, trial.seed,
            *trial.place[:2], float(np.degrees(trial.place[2])), session.degrees, session.millimetres,
            key=key_of(trial, session, options), policy_digest=digest, mask=mask,
        )
        for i, trial in enumerate(trials)
    ]  # fmt: skip


def run_trials(
    policy: TensorDictModuleBase,
    trials: Mapping[int, RobotTrial],
    blanks: Sequence[RobotRow],
    session: Session,
    options: RobotOptions,
    folder: Path,
    workers: int,
) -> Iterator[RobotRow]:
    """Run trials, by their place in the schedule; their rows as they come.

    A trial that crashes, or takes its process with it, becomes a row with status "error" and costs no other trial.

    Args:
        policy: see :func:`run_trial`.
        trials: those to run.
        blanks: of the whole schedule.
        session: of all trials.
        options: of them.
        folder: of the objects, which are made there.
        workers: processes; 1 for this one.
    """
    for listed in dict.fromkeys(trial.listed for trial in trials.values()):
        make(listed, folder)  # before several processes would

    def work(number: int) -> tuple[Any, ...]:
        return trials[number], session, options, policy, blanks[number], folder

    if workers == 1:
        for number in trials:
            yield _outcome(blanks[number], lambda number=number: run_trial(*work(number)))  # type: ignore[misc]
        return
    left = iter(trials)
    with ExitStack() as stack:
        # A pool for each worker: one that dies takes its pool along, and only the trial that it ran.
        busy: dict[Future[RobotRow], tuple[int, Any]] = {}

        def start(pool: Any) -> None:
            number = next(left, None)
            if number is not None:
                with withheld():
                    busy[pool.submit(run_trial, *work(number))] = number, pool

        for _ in range(min(workers, len(trials))):
            start(stack.enter_context(worker_pool(1)))
        while busy:
            for future in wait(busy, return_when=FIRST_COMPLETED).done:
                number, pool = busy.pop(future)
                died = isinstance(future.exception(), BrokenProcessPool)
                start(stack.enter_context(worker_pool(1)) if died else pool)
                yield _outcome(blanks[number], future.result)


def _outcome(blank: RobotRow, result: Callable[[], RobotRow]) -> RobotRow:
    """The row, or what ended the trial."""
    try:
        return result()
    except Exception as error:  # noqa: BLE001, whatever it is, it is this trial's
        return replace(blank, status="error", error=f"{type(error).__name__}: {error}", reason="crashed")
