"""What is kept where a person takes over: whole episodes, in the format of a run, in a folder that goes on."""

from __future__ import annotations

import json
import runpy
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias

import pytest
import torch
from tensordict import TensorDict

from fb3d_rl.algos.dagger import BUFFER, rows_options
from fb3d_rl.algos.options import ImitationOptions
from fb3d_rl.algos.recording import Recording, shared_rows
from fb3d_rl.algos.run import run_training
from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.camera.views import View
from fb3d_rl.data.demonstrations import DemonstrationBuffer, EpisodeInfo
from fb3d_rl.env.options import EnvOptions
from fb3d_rl.errors import UserError
from fb3d_rl.live.shared import SharedSession
from fb3d_rl.policies.interaction import BetaGate
from fb3d_rl.policies.options import LearnerOptions
from fb3d_rl.rollout.demonstrations import recorded_object, replay

from .shared import ENV, LIMITS, ROOT, SMALL, Open, goal_of, learner, steps

Record: TypeAlias = Callable[..., Recording]


@pytest.fixture
def record(procedural_objects: dict[str, ArticulatedObject], procedural_root: Path) -> Iterator[Record]:
    """Opens recordings of the microwave."""
    made: list[Recording] = []

    def opens(folder: Path, options: LearnerOptions = SMALL, env: EnvOptions = ENV, fits: int = 3) -> Recording:
        made.append(Recording(folder, shared_rows(learner(options), LIMITS), env, fits, str(procedural_root)))
        made[-1].keep_object(procedural_objects["Microwave"])
        return made[-1]

    yield opens
    for recording in made:
        if recording._lock.is_locked:
            recording.close()


def test_an_episode_is_kept_as_a_runs_buffer_keeps_it(opened: Open, record: Record, tmp_path: Path) -> None:
    session = opened(record(tmp_path / "met"))
    session.step()
    session.drag(*goal_of(session, [0.0, 0.3, 0.1]))
    steps(session, 2)
    session.release()
    steps(session, 2)
    assert not DemonstrationBuffer.open(tmp_path / "met").episodes, "no half of an episode"
    session.reset()
    buffer = DemonstrationBuffer.open(tmp_path / "met")
    [info], frames = buffer.episodes, buffer.frames(0)
    assert (info.object, info.category, info.link) == (session.obj.id, "Microwave", session.link)
    assert (info.steps, info.rows, info.round, info.success) == (5, 5, 3, False)
    options = ImitationOptions(name="dagger", learner=SMALL)
    run = rows_options(options, LIMITS, BetaGate())
    assert [*buffer.keys] and {*buffer.keys} == {*run.kept(), ("learner", "action")}
    assert frames["expert", "acts"].flatten().tolist() == [False, True, True, False, False]
    assert frames["elapsed_steps"].flatten().tolist() == [0, 1, 2, 3, 4]
    for key, value in {"beta": 0.0, "policy_version": 3, "round": 3, "success": False}.items():
        assert (frames["record", key] == value).all()
    assert frames["record", "beta"].dtype == torch.float32 and frames["record", "policy_version"].dtype == torch.int64
    film, exact = replay(buffer, 0, recorded_object(buffer, 0))
    assert exact and film.expert_acts is not None and film.expert_acts.tolist() == [False, True, True, False, False]


def test_a_folder_goes_on_and_what_is_unfinished_is_not_kept(opened: Open, record: Record, tmp_path: Path) -> None:
    folder = tmp_path / "met"
    for episodes, fits in ((1, 3), (3, 4)):
        recording = record(folder, fits=fits)
        session = opened(recording)
        while len(recording._buffer.episodes) < episodes:
            steps(session, 3)
            session.set_joint(0, 0.1)  # as a reset, a change ends the trial
        steps(session, 4)
        session.close()
        recording.close()
    buffer = DemonstrationBuffer.open(folder)
    assert [info.rows for info in buffer.episodes] == [3, 3, 3]
    assert [int(buffer.frames(i)["record", "policy_version"][0]) for i in range(3)] == [3, 4, 4]
    assert not list(tmp_path.glob(".*"))


def test_a_trial_of_full_length_is_one_episode(opened: Open, record: Record, tmp_path: Path) -> None:
    env = replace(ENV, horizon=6)
    session = opened(record(tmp_path / "met", env=env), env=env)
    session.step()
    while session.trial is not None and not session.trial.done:
        session.step()
    [info] = DemonstrationBuffer.open(tmp_path / "met").episodes
    assert info.rows == 6
    session.step()
    session.reset()
    assert len(DemonstrationBuffer.open(tmp_path / "met").episodes) == 1


def test_a_full_folder_begins_no_trial(opened: Open, record: Record, tmp_path: Path) -> None:
    env = replace(ENV, horizon=4)
    recording = record(tmp_path / "met", env=env)
    session = opened(recording, env=env)
    recording._buffer.capacity = 6
    steps(session, 4)
    session.reset()
    with pytest.raises(UserError, match="4 of the 6 steps.*choose another folder"):
        session.step()
    assert session.trial is None


def test_a_learner_that_tells_intentions_gets_none_of_a_drag(opened: Open, record: Record, tmp_path: Path) -> None:
    """Where the person drags the hand, no contact point is the label's."""
    options = replace(SMALL, contact=True, phase=True)
    session = opened(record(tmp_path / "met", options), learner(options))
    steps(session, 2)
    session.drag(*goal_of(session, [0.0, 0.3, 0.1]))
    steps(session, 2)
    session.release()
    steps(session, 1)
    session.reset()
    frames = DemonstrationBuffer.open(tmp_path / "met").frames(0)
    select, travel = 0, 1
    assert frames["expert", "phase"].flatten().tolist() == [travel, travel, select, select, travel]


def test_what_is_no_folder_of_these_is_refused(record: Record, tmp_path: Path) -> None:
    def sentence(folder: Path, **more: Any) -> str:
        before = sorted(folder.rglob("*")) if folder.is_dir() else folder.read_bytes()
        with pytest.raises(UserError) as caught:
            record(folder, **more)
        assert before == (sorted(folder.rglob("*")) if folder.is_dir() else folder.read_bytes())
        assert not list(tmp_path.glob(".*")), "nothing is left beside it"
        return str(caught.value)

    (tmp_path / "file").write_text("mine")
    assert "no demonstrations" in sentence(tmp_path / "file")
    with pytest.raises(UserError, match="cannot be written"):
        record(tmp_path / "file" / "met")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "notes.txt").write_text("mine")
    assert "no demonstrations" in sentence(tmp_path / "other")

    rows = TensorDict({"action": torch.zeros(2, 8), ("expert", "action"): torch.zeros(2, 8)}, batch_size=[2])
    of_expert = DemonstrationBuffer.create(tmp_path / "demos", 100, {"env": {}})
    of_expert.extend(rows, EpisodeInfo("1", "Box", 1, (0.0,), View(0.0, 0.0)))
    of_expert.commit()
    assert "lack observation.points" in sentence(tmp_path / "demos")


def test_episodes_of_another_task_or_learner_do_not_mix(opened: Open, record: Record, tmp_path: Path) -> None:
    folder = tmp_path / "met"
    recording = record(folder)
    with pytest.raises(UserError, match="another process"):
        record(folder)
    session = opened(recording)
    steps(session, 2)
    session.reset()
    recording.close()
    with pytest.raises(UserError, match="points=300 in place of 200"):
        record(folder, env=replace(ENV, points=200))
    with pytest.raises(UserError, match="hold 3 earlier steps.*reads 1"):
        record(folder, replace(SMALL, history=1))
    with pytest.raises(UserError, match="hold learner.felt"):
        record(folder, replace(SMALL, history=0))
    with pytest.raises(UserError, match="lack expert.contact_point, expert.standoff, expert.phase"):
        record(folder, replace(SMALL, contact=True))
    record(folder, env=replace(ENV, horizon=50)).close()
    assert len(DemonstrationBuffer.open(folder).episodes) == 1


def test_a_made_object_is_kept_beside_the_folder(
    opened: Open, procedural_objects: dict[str, ArticulatedObject], tmp_path: Path
) -> None:
    obj = procedural_objects["Microwave"]
    rows = shared_rows(learner(), LIMITS)
    with Recording(tmp_path / "none", rows, ENV, 1, None) as recording:
        recording.keep_object(obj)
    assert not [*tmp_path.iterdir()], "without an episode nothing is left"
    with Recording(tmp_path / "met", rows, ENV, 1, None) as recording:
        recording.keep_object(obj)
        session = opened(recording)
        steps(session, 2)
        session.reset()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["met", "met_objects"]
    assert recorded_object(DemonstrationBuffer.open(tmp_path / "met"), 0).id == obj.id


SMALL_RUN = [
    "experiment=smoke", "algo=dagger", "algo.rounds=2", "algo.beta.schedule=first", "data.labels=90", "algo.epochs=0.7",
    "algo.batch_size=8", "algo.learner.encoder=pointnet", "algo.learner.width=8", "algo.learner.points=64",
    "assets.categories=[Microwave]", "data.points=256", "camera.resolution=48", "evaluation.trials=0",
    "collector=direct", "env.horizon=40",
]  # fmt: skip
VIEW = [
    "policy=dagger", "object=Microwave", "data.points=256", "camera.resolution=48", "env.horizon=40",
]  # fmt: skip


@pytest.mark.slow
def test_from_a_run_to_the_page_and_back(
    config: Any, launch: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run's learner acts, a person takes over twice, and a further run and launch/demos.py read what was kept."""
    run, folder, again = tmp_path / "run", tmp_path / "met", tmp_path / "again"
    for out in (run, again):
        out.mkdir()
    run_training(config("train", SMALL_RUN), run)

    def visit(session: SharedSession, port: int, page: object) -> None:
        steps(session, 3)
        session.drag(*goal_of(session, [0.0, 0.3, 0.1]))
        steps(session, 3)
        session.release()
        while session.trial is not None and not session.trial.done:
            session.step()
        session.close()

    monkeypatch.setattr("fb3d_rl.live.page.serve", visit)
    monkeypatch.syspath_prepend(str(ROOT / "launch"))
    view = runpy.run_path(str(ROOT / "launch" / "view.py"))
    for _ in range(2):
        view["watch_learner"](config("view", [*VIEW, f"checkpoint={run}", f"record={folder}"]))
    kept, own = DemonstrationBuffer.open(folder), DemonstrationBuffer.open(run / BUFFER)
    assert len(kept.episodes) == 2 and kept.keys.pop(("learner", "action"))[1] == torch.float32
    assert {key: kept.keys[key] for key in own.keys} == own.keys
    assert kept.frames(0)["expert", "acts"].flatten()[:7].tolist() == [False] * 3 + [True] * 3 + [False]
    assert kept.frames(0)["record", "policy_version"].unique().tolist() == [2]

    result = launch("demos.py", "list", str(folder), "--episode", "0", cwd=tmp_path)
    assert result.returncode == 0 and "LLLEEEL" in result.stdout
    result = launch("demos.py", "show", str(folder), "--episode", "1", "--out", "strip.png", cwd=tmp_path)
    assert result.returncode == 0 and "did not repeat" not in result.stdout and (tmp_path / "strip.png").is_file()
    exported = launch("demos.py", "export", str(folder), "out.h5", cwd=tmp_path)
    assert exported.returncode == 0

    run_training(config("train", [*SMALL_RUN, f"algo.demonstrations={folder}"]), again)
    learnt = DemonstrationBuffer.open(again / BUFFER)
    for k in range(2):
        assert torch.equal(learnt.frames(k)["expert", "twist"], kept.frames(k)["expert", "twist"])
        assert torch.equal(learnt.frames(k)["record", "policy_version"], kept.frames(k)["record", "policy_version"])
    assert len(learnt) == len(kept) + 90
    summary = json.loads((again / "summary.json").read_text())
    assert summary["labels"] == 90
