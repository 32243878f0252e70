"""A person takes over from a learner: who acts when, where the hand goes, and what is kept of it."""

from __future__ import annotations

import json
import runpy
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase

from fb3d_rl.algos.dagger import BUFFER, rows_options
from fb3d_rl.algos.learners import new_learner
from fb3d_rl.algos.options import ImitationOptions
from fb3d_rl.algos.recording import Recording, shared_rows
from fb3d_rl.algos.run import run_training
from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.assets.gripper import HAND_LENGTH
from fb3d_rl.camera.raycast import CameraOptions
from fb3d_rl.camera.views import View
from fb3d_rl.data.demonstrations import DemonstrationBuffer, EpisodeInfo
from fb3d_rl.data.samples import SampleOptions
from fb3d_rl.env.options import EnvOptions
from fb3d_rl.errors import UserError
from fb3d_rl.live.server import start_server
from fb3d_rl.live.shared import SharedSession
from fb3d_rl.live.shared_page import SharedPage
from fb3d_rl.policies.flow_policy import FlowPolicyOptions, expert_policy
from fb3d_rl.policies.hand import hand_axis
from fb3d_rl.policies.interaction import BetaGate, InteractivePolicy, OracleGate
from fb3d_rl.policies.learner import Learner
from fb3d_rl.policies.options import LearnerOptions
from fb3d_rl.rollout.demonstrations import recorded_object, replay
from fb3d_rl.rollout.run import limits_of

CAMERA = CameraOptions(resolution=64)
SAMPLES = SampleOptions(points=300, camera=CAMERA)
ENV = EnvOptions(points=300, camera=CAMERA, horizon=120)
LIMITS = limits_of(ENV)
SMALL = LearnerOptions(points=64, width=16)
ROOT = Path(__file__).parents[2]


def learner(options: LearnerOptions = SMALL) -> Learner:
    """One that has learnt nothing, and so does what the expert would not."""
    made = new_learner(options, LIMITS, 1, 3)
    assert isinstance(made, Learner)
    return made


Open: TypeAlias = Callable[..., SharedSession]
Record: TypeAlias = Callable[..., Recording]


@pytest.fixture
def opened(procedural_objects: dict[str, ArticulatedObject]) -> Iterator[Open]:
    """Opens sessions of the microwave, and closes them."""
    sessions = []

    def make(recorder: Any = None, acting: Any = None, env: EnvOptions = ENV) -> SharedSession:
        obj = procedural_objects["Microwave"]
        sessions.append(SharedSession(obj, SAMPLES, env, FlowPolicyOptions(), acting or learner(), recorder))
        return sessions[-1]

    yield make
    for session in sessions:
        session.close()


class Notes:
    """A recorder that remembers."""

    def __init__(self, options: LearnerOptions = SMALL) -> None:
        self.rows = shared_rows(learner(options), LIMITS)
        self.keys = self.rows.keys()
        self.episodes: list[TensorDictBase] = []

    def require_room(self) -> None:
        pass

    def add(self, frames: TensorDictBase, trial: object) -> None:
        self.episodes.append(frames)


def another_point(session: SharedSession) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A point of the part that moves well, far from the expert's; with a ray from beside the camera to it."""
    moment = session.moment
    assert moment.contact is not None
    points = moment.points[moment.part & (np.linalg.norm(moment.flows["true"], axis=-1) > 0.6)]
    point = points[np.linalg.norm(points - moment.contact.point, axis=-1).argmax()]
    origin = moment.camera[:3, 3] + [0.0, 0.1, 0.2]
    return point, origin, point - origin


def goal_of(session: SharedSession, way: list[float]) -> tuple[np.ndarray, np.ndarray]:
    """A pose off the tip's by ``way``, turned by half a radian about the vertical."""
    return session.moment.tip[:3] + np.array(way), np.array([np.cos(0.25), 0.0, 0.0, np.sin(0.25)])


def steps(session: SharedSession, count: int) -> list[str]:
    """Who made each of the next steps."""
    by = []
    for _ in range(count):
        session.step()
        assert session.trial is not None
        by.append(session.trial.by)
    return by


# ---------------------------------------------------------------------------------------------------------- who acts


def test_who_acts_is_kept_step_by_step(opened: Open) -> None:
    notes = Notes()
    session = opened(notes)
    assert steps(session, 3) == ["learner"] * 3
    session.drag(*goal_of(session, [0.0, 0.3, 0.1]))
    assert steps(session, 3) == ["person"] * 3
    session.release()
    assert steps(session, 2) == ["learner"] * 2
    session.pick(*another_point(session)[1:])
    assert steps(session, 3) == ["person"] * 3
    session.release()
    assert steps(session, 2) == ["learner"] * 2 and not notes.episodes
    session.reset()
    [frames] = notes.episodes
    acts = frames["expert", "acts"].flatten()
    assert acts.tolist() == [False] * 3 + [True] * 3 + [False] * 2 + [True] * 3 + [False] * 2
    assert torch.equal(frames["action"][acts], frames["expert", "action"][acts])
    assert torch.equal(frames["action"][~acts], frames["learner", "action"][~acts])
    assert ((frames["learner", "action"] - frames["expert", "action"]).norm(dim=-1) > 0.1).all(), "two opinions"
    fresh = learner()
    for k in range(len(frames)):  # what acts is the learner itself, from what it saw
        step = frames[k : k + 1].clone()
        step["learner", "felt"] = notes.rows.of(frames.clone())["learner", "felt"][k : k + 1]
        torch.testing.assert_close(fresh(step)["action"], frames["learner", "action"][k : k + 1])


def test_the_learners_steps_are_labelled_as_in_training(opened: Open) -> None:
    """The labels are those of the collection's own policy, on the same trial, until the person takes over."""
    notes, never = Notes(), Notes()
    session = opened(notes)
    steps(session, 4)
    session.drag(*goal_of(session, [0.0, 0.3, 0.1]))
    steps(session, 2)
    session.reset()
    policy = InteractivePolicy(expert_policy(LIMITS, FlowPolicyOptions()), learner(), BetaGate(0.0))
    alone = opened(never)
    alone._policy = policy
    steps(alone, 6)
    alone.reset()
    [shared], [trained] = notes.episodes, never.episodes
    for key in ("action", ("expert", "action"), ("observation", "points")):
        assert torch.equal(shared[key][:4], trained[key][:4])
        assert key == ("observation", "points") or not torch.equal(shared[key][4], trained[key][4])


def test_after_a_release_the_expert_labels_from_what_it_sees(opened: Open) -> None:
    """The point that the person picked is no goal of the labels once the learner acts."""
    session = opened()
    steps(session, 1)
    own = session.moment.contact
    wanted, *ray = another_point(session)
    session.pick(*ray)
    steps(session, 2)
    assert own is not None and session.moment.contact is not None
    assert np.linalg.norm(session.moment.contact.point - wanted) < 0.03
    session.release()
    steps(session, 2)
    assert np.linalg.norm(session.moment.contact.point - wanted) > 0.1


def test_an_oracle_still_drives_to_the_part(opened: Open) -> None:
    """algo.oracle's learner acts on held parts; the person takes over from both."""
    acting = InteractivePolicy(expert_policy(LIMITS), learner(), OracleGate())
    session = opened(acting=acting)
    assert steps(session, 2) == ["expert"] * 2
    session.drag(*goal_of(session, [0.0, 0.3, 0.1]))
    assert steps(session, 2) == ["person"] * 2
    session.release()
    while session.trial is not None and not session.trial.attached:
        assert steps(session, 1) == ["expert"]
    assert steps(session, 2) == ["learner"] * 2


# ---------------------------------------------------------------------------------------------- where the hand goes


def test_a_dragged_hand_goes_to_the_handle_within_the_limits(opened: Open) -> None:
    notes = Notes()
    session = opened(notes)
    steps(session, 2)
    position, wxyz = goal_of(session, [-0.2, 0.5, 0.3])
    session.drag(position, 3.0 * wxyz)  # of any length
    way, turn = [], []
    for _ in range(30):
        way.append(float(np.linalg.norm(session.moment.tip[:3] - position)))
        axis = hand_axis(torch.from_numpy(session.moment.tip)), hand_axis(torch.tensor([0.0, 0, 0, *wxyz]).float())
        turn.append(float(torch.dot(*axis).clamp(-1, 1).arccos()))
        session.step()
    assert max(np.diff(way[2:])) < 1e-3 and way[-1] < 0.01 and turn[0] > 0.2 and turn[-1] < 0.05
    session.reset()
    [frames] = notes.episodes
    assert frames["action"].abs().max() <= 1.0
    moved = frames["observation", "qpos"][2:].diff(dim=0).abs() / LIMITS.period
    assert moved[:, :3].max() <= 1.02 * LIMITS.linear and moved[:, 3:6].max() <= 1.02 * LIMITS.angular
    speed = notes.rows.of(frames)["expert", "twist"][2:, :3].norm(dim=-1)
    assert speed.max() <= 1.0 + 1e-5 and speed[0] > 0.95, "as fast as it can"


def test_a_handle_that_moves_is_followed(opened: Open) -> None:
    session = opened()
    steps(session, 2)
    for way in ([0.0, 0.4, 0.0], [0.0, -0.4, 0.2]):
        goal = goal_of(session, way)
        session.drag(*goal)
        steps(session, 12)
        assert np.linalg.norm(session.moment.tip[:3] - goal[0]) < 0.05


def test_a_hand_that_is_dragged_below_the_ground_is_not_turned_into_it(opened: Open) -> None:
    session = opened()
    steps(session, 1)
    upright = np.array([np.cos(-0.7), 0.0, np.sin(-0.7), 0.0])  # the hand's far end below its tip
    assert float(hand_axis(torch.tensor([0.0, 0, 0, *upright]))[2]) < -0.98
    session.drag(np.array([*session.moment.tip[:2], 0.1]), upright)
    steps(session, 25)
    tip = torch.from_numpy(session.moment.tip)
    assert float(tip[2] + HAND_LENGTH * hand_axis(tip)[2]) > 0.05


def test_a_picked_point_is_gone_to_and_held(opened: Open) -> None:
    notes = Notes()
    session = opened(notes)
    steps(session, 2)
    wanted, *ray = another_point(session)
    session.pick(*ray)
    while session.trial is not None and not session.trial.attached and not session.trial.done:
        steps(session, 1)
    assert session.trial is not None and session.trial.attached and session.trial.by == "person"
    assert np.linalg.norm(session.moment.tip[:3] - wanted) < 0.06
    while not session.trial.done:
        steps(session, 1)
    assert session.trial.success and session.person.in_charge is False
    [frames] = notes.episodes
    assert frames["expert", "acts"].flatten().tolist() == [False] * 2 + [True] * (len(frames) - 2)
    assert len(frames) == session.trial.steps and bool(frames["next", "success"][-1])


def test_a_point_can_be_picked_before_the_trial(opened: Open) -> None:
    session = opened()
    wanted, *ray = another_point(session)
    session.pick(*ray)
    assert steps(session, 1) == ["person"]
    assert session.moment.contact is not None and np.linalg.norm(session.moment.contact.point - wanted) < 0.03
    session.reset()
    assert steps(session, 1) == ["learner"], "a new trial is the learner's"


def test_without_a_trial_nothing_is_dragged(opened: Open) -> None:
    session = opened()
    with pytest.raises(UserError, match="no trial runs"):
        session.drag(*goal_of(session, [0.0, 0.1, 0.0]))
    session.release()
    assert not session.person.in_charge


# ---------------------------------------------------------------------------------------------------------- the page


@pytest.fixture
def server() -> Iterator[Any]:
    pytest.importorskip("viser", reason="viser is not installed; install it to run this test")
    made = start_server(18300, "test")
    yield made
    made.stop()


def test_the_page_hands_over_and_back(server: Any, opened: Open) -> None:
    session = opened()
    page = SharedPage(server, session)
    assert not page._handle.visible and page._release.disabled and "Play or Step" in page._who.content

    def ask(button: str) -> None:
        page._request(object(), lambda: page._act(button))
        page.attend(0.0)

    for _ in range(2):
        ask("Step")
        assert page._handle.visible and "**learner** acts" in page._who.content
        np.testing.assert_allclose(page._handle.position, session.moment.tip[:3], atol=1e-6)

    goal = session.moment.tip[:3] + np.array([0.0, 0.3, 0.1])
    page._handle.position = goal
    page._dragged()
    assert not session.person.in_charge, "nothing happens in the thread that drags"
    page.attend(0.0)
    for _ in range(12):
        ask("Step")
    assert "hand follows" in page._who.content and not page._release.disabled
    assert session.trial is not None and session.trial.by == "person"
    np.testing.assert_allclose(page._handle.position, goal, atol=1e-6)
    assert np.linalg.norm(session.moment.tip[:3] - goal) < 0.02

    page._request("release", session.release)
    ask("Step")
    assert session.trial.by == "learner" and page._release.disabled
    np.testing.assert_allclose(page._handle.position, session.moment.tip[:3], atol=1e-6)
    page._request("pick", lambda: session.pick(*another_point(session)[1:]))
    ask("Step")
    assert session.trial.by == "person" and "your point" in page._who.content
    ask("Reset")
    assert not page._handle.visible and page._release.disabled


# --------------------------------------------------------------------------------------------------- what is recorded


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
