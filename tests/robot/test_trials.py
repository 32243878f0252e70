"""The robot's trials: their schedule and session, what policies are shown, and that a crash costs its trial only."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential

from fb3d_rl.errors import UserError
from fb3d_rl.evaluation.robot import evaluate_robot
from fb3d_rl.perception.depth import Intrinsics
from fb3d_rl.policies.baselines import random_policy
from fb3d_rl.policies.flow_policy import FlowPolicy, expert_policy
from fb3d_rl.policies.hand import VelocityLimits, hand_axis
from fb3d_rl.policies.interaction import InteractivePolicy, OracleGate
from fb3d_rl.policies.learner import Learner
from fb3d_rl.policies.options import FlowPolicyOptions, LearnerOptions
from fb3d_rl.robot import film, trials
from fb3d_rl.robot.attempt import Observation
from fb3d_rl.robot.objects import TABLE_I
from fb3d_rl.robot.options import RobotOptions
from fb3d_rl.robot.policy_flow import Frame, PolicyFlow, asking, observed
from fb3d_rl.robot.rows import RobotRow
from fb3d_rl.robot.seeing import smoothed, still_depth
from fb3d_rl.robot.trials import RobotTrial, blank_rows, key_of, run_trials, schedule, session_of

Array = NDArray[np.float64]
LIMITS = VelocityLimits(0.5, 1.0)
OPTIONS = RobotOptions()
IDEAL = RobotOptions(noise="exact", calibration_deg=0.0, calibration_mm=0.0, seal=False, force_noise=False)


def test_every_object_has_its_trials_and_a_pose_of_its_own_in_each() -> None:
    found = schedule(OPTIONS, 0)
    assert len(found) == 70 and [t.listed for t in found[::5]] == list(TABLE_I)
    assert len({t.place for t in found}) == 70 and len({t.seed for t in found}) == 70
    for trial in found:
        x, y, turn = trial.place
        stand = trial.listed.stand
        assert stand.x[0] <= x <= stand.x[1] and stand.y[0] <= y <= stand.y[1]
        assert stand.turn[0] <= np.degrees(turn) <= stand.turn[1]


def test_a_trial_does_not_depend_on_how_many_there_are() -> None:
    whole, few = schedule(OPTIONS, 3), schedule(OPTIONS, 3, 20)
    assert len(few) == 20 and set(few) <= set(whole)
    assert len({t.listed.label for t in few}) == 14  # of each object one, then of the first ones another
    assert not set(schedule(OPTIONS, 4)) & set(whole)


def test_the_calibration_is_off_by_what_the_options_say() -> None:
    session = session_of(replace(OPTIONS, calibration_deg=0.5, calibration_mm=5.0), 1)
    error = np.array(session.error)
    turn = Rotation.from_matrix(error[:3, :3]).magnitude()
    assert np.degrees(turn) == pytest.approx(0.5) and np.linalg.norm(error[:3, 3]) == pytest.approx(0.005)
    assert (session.degrees, session.millimetres) == (pytest.approx(0.5), pytest.approx(5.0))
    assert session_of(OPTIONS, 1).seed == session.seed != session_of(OPTIONS, 2).seed
    exact = session_of(IDEAL, 1)
    assert np.array_equal(np.array(exact.error), np.eye(4)) and exact.degrees == exact.millimetres == 0.0


@pytest.mark.slow
def test_a_simulated_calibration_is_off_by_little_but_not_by_nothing() -> None:
    session = session_of(replace(OPTIONS, calibration_deg=None), 0)
    assert 0.0 < session.degrees < 0.2 and 0.0 < session.millimetres < 5.0


def test_a_key_tells_trials_sessions_and_options_apart() -> None:
    one, two = schedule(OPTIONS, 0)[:2]
    session = session_of(OPTIONS, 0)
    keys = [
        key_of(one, session, OPTIONS),
        key_of(two, session, OPTIONS),
        key_of(one, session_of(OPTIONS, 1), OPTIONS),
        key_of(one, session, replace(OPTIONS, rim=False)),
        key_of(one, session, replace(OPTIONS, without=["flying"])),
    ]
    assert len(set(keys)) == 5 and keys[0] == key_of(one, session, OPTIONS)


def test_noise_terms_are_left_out_by_name() -> None:
    noise = replace(OPTIONS, without=["flying", "dark"]).depth_noise()
    assert not noise.flying and not noise.dark and noise.axial
    with pytest.raises(UserError, match="robot.without=spots is no term"):
        replace(OPTIONS, without=["spots"]).depth_noise()


# ------------------------------------------------------------------------------------------------ what policies see


def box(turn: float, at: tuple[float, float], holding: bool = False) -> tuple[Observation, Array]:
    """Front (-x before it is turned, rad), top and left side of a box on the table, seen from 45 degrees left of -x;
    and its front's normal.
    """
    u, v = (grid.ravel() for grid in np.meshgrid(np.linspace(0, 1, 14), np.linspace(0, 1, 14)))
    size = np.array([0.2, 0.3, 0.25])
    front, top = np.stack([0 * u, u, v], 1), np.stack([u, v, 0 * u + 1], 1)
    points = (np.concatenate([front, top]) - (0.5, 0.5, 0.0)) * size
    rotation = Rotation.from_euler("z", turn).as_matrix()
    points = points @ rotation.T + (*at, -0.015)
    camera = np.array([at[0] - 0.6, at[1] + 0.6, 0.9])
    tip = np.eye(4)
    tip[:3, :3], tip[:3, 3] = Rotation.from_euler("xyz", (2.0, 0.3, 0.7)).as_matrix(), (0.4, 0.1, 0.3)
    seen = Observation(points.astype(np.float32), camera, tip, np.zeros(7), -0.015, holding, np.array([3.0, 0.0, 4.0]))
    return seen, -rotation[:, 0]


@pytest.mark.parametrize("turn", [-10.0, -20.0, -45.0, -70.0, -83.0])
def test_an_object_is_shown_upright_in_front_of_the_policy_and_of_its_size(turn: float) -> None:
    seen, normal = box(np.radians(turn), (0.7, 0.1))
    frame = Frame.of(seen)
    shown = frame.shown(seen.points).double().numpy()
    assert frame.turn @ normal == pytest.approx([-1.0, 0.0, 0.0], abs=0.03)  # found to a degree
    assert np.linalg.norm(np.ptp(shown, axis=0)) == pytest.approx(2.2, abs=0.05)
    assert shown[:, 2].min() == pytest.approx(0.0, abs=1e-4)
    assert 0.5 * (shown.min(0) + shown.max(0))[:2] == pytest.approx([0.0, 0.0], abs=1e-4)


def test_what_a_policy_is_shown_is_the_same_scene() -> None:
    """Points, camera, tip and flow by one motion and enlargement; the hand's axis is that of the arm's tip."""
    seen, _ = box(-0.8, (0.7, 0.1))
    frame = Frame.of(seen)
    flow = np.zeros((len(seen.points), 3))
    flow[:50] = (0.0, 0.6, 0.8)
    data = observed(seen, frame, flow)
    obs = data["observation"]
    apart = np.linalg.norm(seen.points[3] - seen.camera)
    assert float((obs["points"][0, 3] - obs["camera_position"][0]).norm()) == pytest.approx(frame.scale * apart, 1e-4)
    assert hand_axis(obs["tool_pose"])[0].numpy() @ frame.turn == pytest.approx(-seen.tip[:3, 2], abs=1e-6)
    assert obs["part_mask"].sum() == 50 and float(obs["contact_force"]) == pytest.approx(5.0)
    assert data["privileged", "flow"][0, 0].numpy() @ frame.turn == pytest.approx([0.0, 0.6, 0.8], abs=1e-6)


def outwards(points: torch.Tensor) -> torch.Tensor:
    """A network that says: to the front, -x, and less so higher up."""
    flow = torch.zeros_like(points)
    flow[..., 0] = -1.0 / (1.0 + points[..., 2])
    return flow


def predicting(mask: str = "none") -> TensorDictSequential:
    module = TensorDictModule(outwards, in_keys=[("observation", "points")], out_keys=[("prediction", "flow")])
    return TensorDictSequential(
        module, FlowPolicy(("prediction", "flow"), LIMITS, replace(FlowPolicyOptions(), mask=mask))
    )


def test_a_policys_flow_comes_back_in_the_robots_frame() -> None:
    seen, normal = box(-0.8, (0.7, 0.1))
    flow = PolicyFlow.of_policy(predicting(), lambda points: np.ones((len(points), 3)))(seen)
    cosine = flow @ normal / np.linalg.norm(flow, axis=1)
    assert cosine == pytest.approx(np.ones(len(flow)), abs=1e-3)
    assert np.linalg.norm(flow[0]) > np.linalg.norm(flow[-1])  # higher points move less


def test_the_next_answer_is_given_once_a_pull_has_refuted_the_first() -> None:
    """Outwards all of it; then, of what is left, the more probable: upwards."""
    seen, normal = box(-0.8, (0.7, 0.1))

    def answers(points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        up, down = (torch.tensor([0.0, 0.0, sign]).expand_as(points) for sign in (0.8, -1.0))
        scores = torch.tensor([0.3, 0.5, 0.2]).log()[None, :, None].expand(len(points), 3, points.shape[1])
        return up, torch.stack([up, outwards(points), down], 1), scores

    keys = [("prediction", name) for name in ("flow", "flows", "log_probabilities")]
    asked = PolicyFlow(TensorDictModule(answers, in_keys=[("observation", "points")], out_keys=keys))
    contact = seen.points[0].astype(np.float64)
    first = asked(seen)
    assert first @ normal / np.linalg.norm(first, axis=1) == pytest.approx(np.ones(len(first)), abs=1e-3)
    asked.refute(contact, np.array([0.0, 0.0, -1.0]))  # says nothing of the other two
    assert np.array_equal(asked(seen), first)
    asked.refute(contact, normal)
    assert asked(seen)[:, 2] == pytest.approx(np.full(len(first), 0.8), abs=1e-3)


def test_while_it_holds_the_object_is_shown_as_it_was_first_seen() -> None:
    """Seen anew, the box of the second look would be turned by half a right angle and enlarged otherwise."""
    asked = PolicyFlow.of_policy(predicting(), lambda points: np.ones((len(points), 3)))
    first, normal = box(-0.3, (0.7, 0.1))
    asked(first)
    second, _ = box(-0.9, (0.7, 0.1), holding=True)
    flow = asked(second)
    assert flow @ normal / np.linalg.norm(flow, axis=1) == pytest.approx(np.ones(len(flow)), abs=1e-3)
    flow = asked(replace(second, holding=False))
    assert (flow @ normal / np.linalg.norm(flow, axis=1) < 0.9).all()


def test_a_policy_with_the_mask_moves_the_part_alone() -> None:
    seen, _ = box(-0.8, (0.7, 0.1))
    truth = np.zeros((len(seen.points), 3))
    truth[:30, 2] = 1.0
    flow = PolicyFlow.of_policy(predicting("target"), lambda points: truth)(seen)
    assert flow[:30].any(1).all() and not flow[30:].any()


def test_smoothing_brings_points_back_to_their_plane_and_leaves_exact_ones() -> None:
    seen, normal = box(-0.8, (0.7, 0.1))
    exact = seen.points.astype(np.float64)
    inner = np.abs(exact[:196] - exact[:196].mean(0)).max(1) < 0.08  # of the front, away from the edge to the top
    noisy = exact + 0.003 * np.random.default_rng(0).normal(size=exact.shape)
    before, after = ((cloud - exact) @ normal for cloud in (noisy, smoothed(noisy.astype(np.float32))))
    assert np.std(after[:196][inner]) < 0.5 * np.std(before[:196][inner])
    assert smoothed(seen.points)[:196][inner] == pytest.approx(exact[:196][inner], abs=1e-5)


def test_a_single_point_with_another_flow_is_outvoted() -> None:
    """A network that has one point move the other way, and most."""

    def odd(points: torch.Tensor) -> torch.Tensor:
        flow = outwards(points)
        flow[:, 17] = torch.tensor([9.0, 0.0, 0.0])
        return flow

    module = TensorDictModule(odd, in_keys=[("observation", "points")], out_keys=[("prediction", "flow")])
    policy = TensorDictSequential(module, FlowPolicy(("prediction", "flow"), LIMITS))
    seen, normal = box(-0.8, (0.7, 0.1))
    flow = PolicyFlow.of_policy(policy, lambda points: np.ones((len(points), 3)))(seen)
    assert (flow @ normal > 0).all() and np.linalg.norm(flow, axis=1).max() < 1.01


def test_a_learner_pulls_as_it_would_in_its_own_task(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is shown a hand that it knows how to move; its twist comes back in the robot's frame, at the robot's speed."""
    seen, normal = box(-0.8, (0.7, 0.1), holding=True)
    learner = Learner(LearnerOptions(), LIMITS, torch.Generator().manual_seed(0))
    twist = torch.tensor([[[-1.0, 0.0, 0.0, 0.0, 0.0, 0.4]]])  # to where the box's front faces, and a turn about z
    felt: list[torch.Tensor] = []

    def planned(inputs: TensorDict, *_: object) -> tuple[torch.Tensor, None]:
        felt.append(inputs["felt"])
        return twist.expand(1, learner.options.chunk, 6), None

    monkeypatch.setattr(learner, "planned", planned)
    policy = InteractivePolicy(expert_policy(LIMITS), learner, OracleGate())
    truth = np.zeros((len(seen.points), 3))
    truth[:50] = normal
    see, pull = asking(policy, lambda points: truth, 0.05)
    assert np.array_equal(see(seen), truth) and pull is not None
    answer = pull(seen)
    assert answer[:3] == pytest.approx(0.05 * normal, abs=2e-3)
    turn = LIMITS.angular / LIMITS.linear * Frame.of(seen).scale * 0.05 * 0.4
    assert np.linalg.norm(answer[3:]) <= turn + 1e-6  # about z, what turns the hand: not its spin
    pull(seen)
    still, moving = (hand[0, 0, 3:6].double() for hand in felt)
    assert still.abs().max() == 0 and moving.numpy() == pytest.approx([-1.0, 0.0, 0.0], abs=1e-5)


def test_the_expert_is_the_truth_and_a_policy_without_flow_is_refused() -> None:
    seen, _ = box(-0.8, (0.7, 0.1))
    truth = np.random.default_rng(0).normal(size=(len(seen.points), 3))
    assert np.array_equal(PolicyFlow.of_policy(expert_policy(LIMITS), lambda points: truth)(seen), truth)
    with pytest.raises(UserError, match="policies of a flow"):
        PolicyFlow.of_policy(random_policy(LIMITS), lambda points: truth)


def test_what_no_robot_can_follow_is_refused_before_any_trial(tmp_path: Path) -> None:
    both = {"expert": expert_policy(LIMITS), "random": random_policy(LIMITS)}
    with pytest.raises(UserError, match="policies of a flow"):
        evaluate_robot(tmp_path, both, OPTIONS, 0, None, 1, False, {})
    with pytest.raises(UserError, match="the arm ur5 is unknown"):
        evaluate_robot(tmp_path, {"expert": both["expert"]}, replace(OPTIONS, arm="ur5"), 0, None, 1, False, {})
    assert not list(tmp_path.iterdir())


def test_the_median_of_several_pictures_has_less_noise_and_no_points_that_fly() -> None:
    rng, lens = np.random.default_rng(0), Intrinsics(500.0, 500.0, 32.0, 24.0)
    shots = []
    for _ in range(9):
        depth = (1.0 + 0.006 * rng.standard_normal((48, 64))).astype(np.float32)
        depth[rng.random(depth.shape) < 0.1] = 0.0  # holes now and then
        depth[:, :4] = np.where(rng.random((48, 4)) < 0.2, 0.7, 0.0)  # seldom measured, and wrong
        shots.append((depth, lens))
    depth, kept = still_depth(shots)
    assert kept is lens and (depth[:, :4] == 0).mean() > 0.95 and (depth[:, 4:] > 0).mean() > 0.99
    assert depth[:, 4:][depth[:, 4:] > 0].std() < 0.006 / 2
    assert still_depth(shots[:1])[0] is shots[0][0]


# -------------------------------------------------------------------------------------------------------- crashes


def crashing(trial: RobotTrial, *_: object) -> RobotRow:
    """In place of a trial: the second raises, the third ends its process."""
    blank = _[3]
    assert isinstance(blank, RobotRow)
    if blank.trial == 1:
        raise ValueError("broken")
    if blank.trial == 2:
        os._exit(3)
    return replace(blank, opened=True, sealed=True, distance=0.0)


@pytest.mark.parametrize("workers", [1, 2])
def test_a_crash_costs_its_trial_only(workers: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    found, session, policy = schedule(OPTIONS, 0, 5), session_of(OPTIONS, 0), expert_policy(LIMITS)
    blanks = blank_rows("expert", policy, found, session, OPTIONS)
    wanted = {i: trial for i, trial in enumerate(found) if workers > 1 or i != 2}  # 2 would end the test itself
    monkeypatch.setattr(trials, "run_trial", crashing)
    rows = {row.trial: row for row in run_trials(policy, wanted, blanks, session, OPTIONS, tmp_path, workers)}
    assert sorted(rows) == sorted(wanted)
    assert rows[1].status == "error" and "broken" in rows[1].error and not rows[1].opened
    if workers > 1:
        assert rows[2].status == "error" and "terminated" in rows[2].error
    assert all(rows[i].opened and rows[i].status == "ok" for i in (0, 3, 4))
    assert rows[1].as_trial().failure == "crashed" and rows[1].as_trial().normalized_distance == 1.0


@pytest.mark.slow
def test_the_expert_lifts_a_lid_and_again_when_it_is_filmed(tmp_path: Path) -> None:
    pytest.importorskip("sapien")
    (trial,) = (t for t in schedule(replace(IDEAL, trials=1), 0) if t.listed.label == "jar_1")
    session, policy = session_of(IDEAL, 0), expert_policy(LIMITS)
    blanks = blank_rows("expert", policy, [trial], session, IDEAL)
    first = next(run_trials(policy, {0: trial}, blanks, session, IDEAL, tmp_path, 1))
    second = trials.run_trial(trial, session, IDEAL, policy, blanks[0], tmp_path, tmp_path / "film")
    assert first.opened and first.sealed and first.distance < 0.1 and first.reason == "" and first.grips == 1
    assert replace(first, wall=0.0) == replace(second, wall=0.0)
    frames, seconds = imageio_ffmpeg.count_frames_and_secs(str(tmp_path / "film.mp4"))
    assert frames / seconds == pytest.approx(film.RATE, abs=0.5)
    assert first.seconds - 0.5 < seconds - film.HOLD < first.seconds + 0.5  # in the robot's own time
    with Image.open(tmp_path / "film.png") as strip:
        pixels = np.asarray(strip).astype(int).reshape(-1, 3)
    red, green, blue = pixels.T  # of the cup before it holds, and while it does
    assert (red > 2 * np.maximum(green, blue)).sum() > 50
    assert (green > 2 * red).sum() > 50


@pytest.mark.slow
def test_as_many_objects_are_filmed_as_is_asked(tmp_path: Path) -> None:
    pytest.importorskip("sapien")
    few = replace(IDEAL, trials=1)
    arguments = (tmp_path, {"expert": expert_policy(LIMITS)}, few, 0, 2, 1)
    rows = evaluate_robot(*arguments, False, {}, videos=1)
    films = sorted(path.name for path in (tmp_path / "videos").iterdir())
    assert films == [f"000_{rows[0].object}__expert{suffix}" for suffix in (".mp4", ".png")]
    before = [(tmp_path / "videos" / name).stat().st_mtime_ns for name in films]
    assert evaluate_robot(*arguments, True, {}, videos=1) == rows
    assert [(tmp_path / "videos" / name).stat().st_mtime_ns for name in films] == before
