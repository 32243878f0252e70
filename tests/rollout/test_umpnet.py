"""Episodes in UMPNet's world: the metric on constructed ways, inversion, the first point, the command."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from tensordict import TensorDict, TensorDictBase

from fb3d_rl.algos.run import run_evaluation
from fb3d_rl.algos.umpnet import scheduled
from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.camera.umpnet import SCALE
from fb3d_rl.env.umpnet.options import UmpnetOptions
from fb3d_rl.env.umpnet.scenes import JointState, Placed, Scene, bullet_order, place, read_scenes, stand_in
from fb3d_rl.errors import UserError
from fb3d_rl.evaluation.umpnet import DETAILS, read_details
from fb3d_rl.policies.baselines import random_policy
from fb3d_rl.policies.flow_policy import FlowPolicyOptions, expert_policy
from fb3d_rl.policies.hand import VelocityLimits
from fb3d_rl.policies.pulling import flow_of
from fb3d_rl.registry import REGISTRY, behind
from fb3d_rl.report.run_page import write_report
from fb3d_rl.rollout.rows import NEVER_TOUCHED, film_name, read_trials
from fb3d_rl.rollout.umpnet import BUDGETS, Episode, run_episodes
from fb3d_rl.rollout.umpnet_film import PICTURES, film_scene

LIMITS = VelocityLimits(1.0, 1.0, 0.05)
TRUTH = UmpnetOptions(mask="target")


@pytest.fixture(scope="module")
def placed(objects: dict[str, ArticulatedObject]) -> list[Placed]:
    """The oven and the laptop, each to be opened and to be closed."""
    made = []
    for name in ("Oven", "Laptop"):
        obj = objects[name]
        link = Episode(place(_scene(obj, 0.1, 0.9), obj), np.random.default_rng(0)).placed.link
        assert link == obj.movable[0]
        made += [place(_scene(obj, *ends), obj) for ends in ((0.2, 1.0), (0.9, 0.1))]
    return made


def _scene(obj: ArticulatedObject, start: float, goal: float) -> Scene:
    number = bullet_order(obj).index(obj.movable[0])
    low, high = obj.limits[0]
    unit = SCALE if obj.joint_of(obj.movable[0]).type == "prismatic" else 1.0
    at = [unit * (low + share * (high - low)) for share in (0.0, 1.0, goal, start)]
    turned = tuple(Rotation.from_euler("z", 95.0, degrees=True).as_quat().tolist())
    return Scene("manipulation", obj.category, 0, obj.id, SCALE, 0.5, turned, number, {number: JointState(*at)})


def way(one: Placed, *shares: float) -> Episode:
    """An episode whose joint was at these shares of the way from the start to the goal, after pulls."""
    start, goal = one.start[one.joint], one.goal[one.joint]
    episode = Episode(one, np.random.default_rng(0), values=[float(start)], right=True, link=one.link)
    for share in shares:
        episode.moved(float(start + share * (goal - start)))
    return episode


def test_the_metric_on_constructed_ways(placed: list[Placed]) -> None:
    for one in placed:
        half = way(one, 0.2, 0.5)
        assert half.distance == pytest.approx(0.5) == half.own_distance and not half.reached and half.left
        near = way(one, 0.2, 0.97)  # within .1 rad
        assert near.reached and near.distance == 0.0 and near.own_distance == pytest.approx(0.03) and not near.left
        assert way(one, 1.6).reached  # crossed it in one pull
        back = way(one, -0.2)
        assert back.distance == pytest.approx(1.2)
        wrong = Episode(one, np.random.default_rng(0), values=[0.0])
        assert wrong.distance == 1.0 and not wrong.left and wrong.novelty == 0.0
        budget = BUDGETS[one.scene.category]
        assert way(one, *[0.1] * (budget - 1)).left and not way(one, *[0.1] * budget).left


def test_what_is_near_by_umpnets_rule_may_be_far_by_ours(placed: list[Placed]) -> None:
    """At most 1/3.5 of the range: a joint of small range that is a quarter of it away counts as there."""
    one = placed[0]
    low, high = one.posed.obj.limits[one.joint]
    prismatic = one.posed.obj.joint_of(one.link).type == "prismatic"
    least = min(0.05 / SCALE if prismatic else 0.1, (high - low) / 3.5)
    whole = abs(one.goal[one.joint] - one.start[one.joint])
    assert way(one, 1 - 0.99 * least / whole).reached and not way(one, 1 - 1.01 * least / whole).reached


def test_novel_states_are_counted_as_umpnet_does(placed: list[Placed]) -> None:
    one = replace(placed[0], joint=-1)
    episode = Episode(one, np.random.default_rng(0), right=True, link=one.movable[0])
    start = float(one.start[0])
    episode.values = [start, start + 0.2, start + 0.3, start + 0.5, start + 0.5]
    assert episode.novelty == 2 / 4  # .2 and .5; .3 is too near to .2
    turned = episode.sense
    episode.moved(start + 0.5)  # it did not move: the other way is tried
    assert episode.sense == -turned


def test_the_expert_reaches_goals_of_both_senses(placed: list[Placed]) -> None:
    """Whether a goal is more open decides if the flow is followed or inverted."""
    assert [one.towards_open for one in placed] == [True, False] * 2
    policy = expert_policy(LIMITS)
    episodes = run_episodes(placed, flow_of(policy, "expert"), TRUTH, 300, 0, expert=True)
    for one, episode in zip(placed, episodes, strict=True):
        assert episode.right and episode.link == one.link and episode.sense == (1 if one.towards_open else -1)
        assert episode.distance < 0.1, one.scene.name
        towards = np.sign(one.goal[one.joint] - one.start[one.joint])
        assert (np.diff(episode.values) * towards > 0).all()


def test_the_flow_seen_in_the_scene_opens_the_part(placed: list[Placed]) -> None:
    """A policy that follows the flow of the cloud, not that of the held point, gets there as well."""
    policy = expert_policy(LIMITS)
    episodes = run_episodes(placed, flow_of(policy, "expert"), replace(TRUTH, mask="goal"), 600, 0)
    assert np.mean([episode.distance for episode in episodes]) < 0.3


def test_a_wrong_first_point_ends_the_episode(placed: list[Placed]) -> None:
    """In a scene that lets nothing be moved every point is wrong, and none is pulled."""
    static = [replace(one, movable=(), joint=-1) for one in placed]
    for episode in run_episodes(static, flow_of(expert_policy(LIMITS), "expert"), TRUTH, 300, 0):
        assert not episode.right and len(episode.values) == 1 and episode.distance == 1.0 and episode.link < 0


def test_every_scene_starts_from_the_same_seed(placed: list[Placed]) -> None:
    """The random policy makes the same draws in each scene, alone or beside others."""
    flow = flow_of(random_policy(LIMITS), "random")
    together = run_episodes(placed, flow, TRUTH, 300, 0)
    alone = [run_episodes([one], flow, TRUTH, 300, 0)[0] for one in placed]
    for one, other in zip(together, alone, strict=True):
        assert one.values == other.values and one.link == other.link


def test_a_policy_without_flow_is_refused(placed: list[Placed]) -> None:
    class Acts(torch.nn.Module):
        def forward(self, seen: TensorDictBase) -> TensorDictBase:
            return seen

    with pytest.raises(UserError, match="writes no flow"):
        run_episodes(placed[:1], flow_of(Acts(), "dagger"), TRUTH, 300, 0)  # type: ignore[arg-type]


def test_procedural_objects_stand_in(objects: dict[str, ArticulatedObject]) -> None:
    for scene in read_scenes("manipulation")[::97]:
        obj = objects["Table"]
        made = stand_in(scene, obj)
        one = place(made, obj)
        joint = scene.joints[scene.selected or 0]
        share = (joint.start - joint.lower) / max(joint.upper - joint.lower, 1e-6)
        j, posed = one.joint, one.posed
        expected = posed.closed[j] + share * (posed.opened[j] - posed.closed[j])
        assert one.start[j] == pytest.approx(expected, abs=1e-6)
        front = posed.T_world_base[:3, :3] @ [-1.0, 0.0, 0.0]
        assert front[0] < -0.7  # it faces the camera, up to 45 degrees askew
    jobs, said = scheduled([(obj, "test") for obj in objects.values()], UmpnetOptions(), True, 8)
    assert len(jobs) == 8 and {job[2].category for job in jobs} == set(objects) and "stand in" in said[0]


def test_the_command_writes_rows_and_tables_and_goes_on(config: Callable[..., Any], tmp_path: Path) -> None:
    words = [
        "protocol=umpnet", "policy=normal", "assets.categories=[Laptop]", "assets.eval_count=1", "evaluation.trials=4",
        "umpnet.mask=target", "collector=direct", "data.points=300", "umpnet.batch=2",
    ]  # fmt: skip
    rows = run_evaluation(config("evaluate", words), tmp_path)
    assert [row.policy for row in rows] == ["expert"] * 4 + ["normal"] * 4 and rows == read_trials(
        tmp_path / "rows.csv"
    )
    assert all(row.success for row in rows[:4]) and all(row.contact or row.failure == NEVER_TOUCHED for row in rows)
    text = (tmp_path / "umpnet.md").read_text()
    assert "Table III" in text and "Laptop" in text and "0.81, 0.70" in text
    details = (tmp_path / DETAILS).read_text()
    assert [detail.row for detail in read_details(tmp_path / DETAILS)] == rows
    (tmp_path / DETAILS).write_text("".join(details.splitlines(True)[:3]))
    again = run_evaluation(config("evaluate", [*words, "resume=true"]), tmp_path)
    assert again == rows and (tmp_path / DETAILS).read_text() == details
    with pytest.raises(UserError, match="another folder"):
        run_evaluation(config("evaluate", [*words, "resume=true", "seed=1"]), tmp_path)


FITTED = [name for name, entry in REGISTRY.items() if entry.options == REGISTRY["artflownet"].options]


@pytest.mark.parametrize("name", FITTED)
def test_every_network_that_answers_with_a_flow_acts(name: str, placed: list[Placed]) -> None:
    """Its pulls are its own: those of another network with other weights lead elsewhere."""
    kind, ways = behind(REGISTRY[name].algorithm), []
    for seed in (0, 1):
        net = kind.network(True, 8, "delayed", torch.Generator().manual_seed(seed)).eval()
        policy = kind.policy(net, LIMITS, FlowPolicyOptions(learn=False))
        episodes = run_episodes(placed[:2], flow_of(policy, name), TRUTH, 128, 0)
        assert all(episode.right and len(episode.values) > 1 for episode in episodes)
        ways.append([value for episode in episodes for value in episode.values])
    assert ways[0] != ways[1]


class Counting:
    """A policy of somebody's own with a memory: it follows the true flow, and counts its decisions."""

    in_keys = [("privileged", "flow"), ("observation", "points"), ("count", "made")]

    def initial_state(self, batch: torch.Size) -> TensorDict:
        return TensorDict({"count": TensorDict({"made": torch.zeros(*batch, 1)}, batch)}, batch)

    def __call__(self, seen: TensorDictBase) -> TensorDictBase:
        made = seen["count", "made"]
        # What it does depends on its memory: without one it would never pull back.
        sign = torch.where(made > 2, -1.0, 1.0)
        seen["prediction", "flow"] = sign[..., None] * seen["privileged", "flow"]
        seen["action"] = torch.zeros(len(seen), 8)
        seen["next", "count"] = TensorDict({"made": made + 1}, seen.batch_size)
        return seen


def make_counting(limits: VelocityLimits, options: FlowPolicyOptions) -> Counting:
    return Counting()


def make_acting(limits: VelocityLimits, options: FlowPolicyOptions) -> Callable[[TensorDictBase], torch.Tensor]:
    return lambda seen: torch.zeros(len(seen), 8)


SMALL = [
    "protocol=umpnet", "assets.categories=[Laptop]", "assets.eval_count=1", "evaluation.trials=2",
    "umpnet.mask=target", "collector=direct", "data.points=300", "policy.name=plugin", "evaluation.expert=false",
]  # fmt: skip


def test_a_policy_of_somebodys_own_runs_on_the_scenes(config: Callable[..., Any], tmp_path: Path) -> None:
    rows = run_evaluation(config("evaluate", [*SMALL, f"policy.target={__name__}:make_counting"]), tmp_path)
    assert [row.policy for row in rows] == ["plugin_privileged"] * 2 and all(row.contact for row in rows)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["policy_target"] == f"{__name__}:make_counting" and summary["privileged_inputs"] == ["flow"]
    for detail in read_details(tmp_path / DETAILS):
        ways = np.diff(detail.values)  # the touch is the first decision: two pulls there, then back
        assert ways[0] * ways[1] > 0 and ways[2] * ways[1] < 0
    with pytest.raises(UserError, match="plugin writes no flow"):
        run_evaluation(config("evaluate", [*SMALL, f"policy.target={__name__}:make_acting"]), tmp_path / "acting")


def test_a_film_is_the_episode(placed: list[Placed]) -> None:
    """It begins in front of the point, holds it after the first second, and shows each pull's end."""
    for policy, expert in ((expert_policy(LIMITS), True), (random_policy(LIMITS), False)):
        flow = flow_of(policy, "any")
        for one in placed[:2]:
            episode = run_episodes([one], flow, TRUTH, 300, 0, expert)[0]
            film = film_scene("any", one, flow, TRUTH, 300, 0, expert, False, 0.1)
            assert len(film) == PICTURES * len(episode.values) and film.link == one.link
            assert film.success == (episode.distance < 0.1)
            assert not film.attached[: PICTURES - 1].any() and film.attached[PICTURES - 1 :].all() == episode.right
            ends = film.distance[PICTURES - 1 :: PICTURES]
            way = abs(episode.values[0] - one.goal[one.joint])
            assert ends == pytest.approx(np.abs(np.array(episode.values) - one.goal[one.joint]) / way, abs=1e-5)
            state = one.start.copy()
            state[one.joint] = episode.values[-1]
            np.testing.assert_allclose(film.poses[-1][: len(one.posed.obj.links)], one.posed.poses(state), atol=1e-9)
            # The hand holds the part at the same place of it all the time.
            held = film.poses[PICTURES - 1 :]
            apart = np.linalg.inv(held[:, one.link]) @ held[:, -1]
            assert np.ptp(apart, axis=0).max() < 1e-6
            hand = np.linalg.norm(film.tips[:, None] - film.points[:, film.part[0]][:1], axis=-1).min(1)
            assert hand[PICTURES - 1] < 1e-3 and hand[0] > 0.1


def test_scenes_are_filmed_and_on_the_page(config: Callable[..., Any], tmp_path: Path) -> None:
    words = [*SMALL, f"policy.target={__name__}:make_counting", "evaluation.videos=1"]
    rows = run_evaluation(config("evaluate", words), tmp_path)
    names = {path.name for path in (tmp_path / "videos").iterdir()}
    film = film_name(rows[0]), film_name(rows[1])
    assert len(names) == 2 and names <= {f"{name}.{suffix}" for name in film for suffix in ("mp4", "png")}
    page = write_report(tmp_path).read_text()
    assert "Table III: success" in page and "train categories, class mean" in page


def test_other_commands_refuse_the_protocol(config: Callable[..., Any]) -> None:
    with pytest.raises(UserError, match="launch/evaluate.py"):
        config("train", ["protocol=umpnet"])
