"""A person takes over from a learner: who acts when, where the hand goes, and what is kept of it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDictBase

from fb3d_rl.algos.recording import shared_rows
from fb3d_rl.assets.gripper import HAND_LENGTH
from fb3d_rl.errors import UserError
from fb3d_rl.live.server import start_server
from fb3d_rl.live.shared_page import SharedPage
from fb3d_rl.policies.flow_policy import FlowPolicyOptions, expert_policy
from fb3d_rl.policies.hand import hand_axis
from fb3d_rl.policies.interaction import BetaGate, InteractivePolicy, OracleGate
from fb3d_rl.policies.options import LearnerOptions

from .shared import LIMITS, SMALL, Open, another_point, goal_of, learner, steps


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
