"""What is answered: the policy's own action, a plan, in any frame, from points or depth."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torchrl.envs.utils import step_mdp

from fb3d_rl import plan
from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.camera.options import CameraOptions
from fb3d_rl.env.options import EnvOptions, default_trial
from fb3d_rl.env.torchrl_env import make_env
from fb3d_rl.errors import UserError
from fb3d_rl.models.artflownet import ArtFlowNet
from fb3d_rl.policies.flow_policy import expert_policy
from fb3d_rl.rollout.run import policy_env, state_of
from fb3d_rl.serve.episode import Episode, Served
from fb3d_rl.serve.request import KEYS

from .conftest import LIMITS, OPTIONS, POINTS, TOOL, offered


def turned(request: dict[str, Any], pose: np.ndarray) -> dict[str, Any]:
    """A request in the world frame, seen from the frame with T_world_cloud ``pose``."""
    turn, place = pose[:3, :3], pose[:3, 3]
    tool = np.asarray(request["tool_pose"])
    rotation = Rotation.from_matrix(turn.T) * Rotation.from_quat(tool[[4, 5, 6, 3]])
    return {
        **request,
        "points": (request["points"].astype(np.float64) - place) @ turn,
        "camera": (request["camera"] - place) @ turn,
        "tool_pose": np.concatenate([(tool[:3] - place) @ turn, rotation.as_quat()[[3, 0, 1, 2]]]),
        "T_world_cloud": pose,
    }


def test_an_episode_is_answered_by_the_bits_that_the_policy_decides(
    procedural_objects: dict[str, ArticulatedObject], quick: ArtFlowNet
) -> None:
    obj = procedural_objects["Microwave"]
    served, steps = offered(quick), 25
    base = make_env([obj], EnvOptions(points=POINTS, camera=CameraOptions(resolution=64)))
    env = policy_env(base, state_of(served.policy()))
    base.set_trials([default_trial(obj)])
    frame, episode, policy = env.reset(), Episode(served), served.policy()
    moved = []
    for _ in range(steps):
        seen = {key: value[0].numpy() for key, value in frame["observation"].items()}
        valid = seen.pop("valid")
        request = {key: seen[key] for key in ("qpos", "qvel", "tool_pose", "attached", "goal_sense")}
        request |= {"points": seen["points"][valid], "mask": seen["part_mask"][valid], "T_world_cloud": np.eye(4)}
        request |= {"camera": seen["camera_position"], "force": seen["contact_force"]}
        answer = episode.answer(request)
        with torch.no_grad():
            frame = policy(frame)
        np.testing.assert_array_equal(answer["actions"], frame["action"].numpy())
        moved.append(answer["actions"])
        frame = step_mdp(env.step(frame))
    env.close()
    assert np.abs(np.diff(moved, axis=0)).max() > 0.01, "the actions of different steps are different"


def test_joints_and_tip_say_the_same_of_the_tool(served: Served, acting: dict[str, Any]) -> None:
    angles = [0.3, -0.4, 0.5]
    rotation = Rotation.from_euler("XYZ", angles)
    joints = np.array([-1.6, 0.1, 0.8, *angles, 0.0, 0.0])
    by_joints = {key: value for key, value in acting.items() if key != "tool_pose"} | {"qpos": joints}
    first = Episode(served).answer(by_joints)
    from fb3d_rl.assets.gripper import TIP

    tip = joints[:3] + rotation.apply([TIP, 0.0, 0.0])
    second = Episode(served).answer({**acting, "tool_pose": [*tip, *rotation.as_quat()[[3, 0, 1, 2]]]})
    np.testing.assert_allclose(first["actions"], second["actions"], atol=1e-5)
    assert np.abs(first["twist"]).max() > 0.1


def test_another_frame_turns_the_twist_and_leaves_the_action(served: Served, acting: dict[str, Any]) -> None:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_euler("xyz", [0.4, -1.2, 2.0]).as_matrix(), [1.0, -2.0, 0.5]
    here, there = Episode(served).answer(acting), Episode(served).answer(turned(acting, pose))
    np.testing.assert_allclose(here["actions"], there["actions"], atol=1e-4)
    for part in (slice(0, 3), slice(3, 6)):
        np.testing.assert_allclose(here["twist"][0, part], pose[:3, :3] @ there["twist"][0, part], atol=1e-3)
    assert np.abs(here["twist"] - there["twist"]).max() > 0.1


def test_the_twist_is_the_tip_s_velocity_under_the_action(served: Served, acting: dict[str, Any]) -> None:
    """By the difference between the poses that the joints give before and after a short time."""
    from fb3d_rl.assets.gripper import TIP

    joints = np.array([-1.6, 0.1, 0.8, 0.3, -0.4, 0.5, 0.0, 0.0])
    answer = Episode(served).answer({**acting, "qpos": joints, "tool_pose": None})
    top = np.array([LIMITS.linear] * 3 + [LIMITS.angular] * 3)
    dt = 1e-4
    after = joints[:6] + dt * top * answer["actions"][0, :6]
    tips = [q[:3] + Rotation.from_euler("XYZ", q[3:6]).apply([TIP, 0, 0]) for q in (joints, after)]
    np.testing.assert_allclose((tips[1] - tips[0]) / dt, answer["twist"][0, :3], atol=2e-3)


@pytest.mark.parametrize("place", [None, "given"])
def test_a_plan_is_the_one_of_the_library(served: Served, seen: dict[str, Any], quick: ArtFlowNet, place: Any) -> None:
    further = {"tool_pose": TOOL, "plan": True, "T_world_cloud": np.eye(4)} if place else {}
    answer = Episode(served).answer({**seen, **further, "flow": True, "up": [0, 0, 1], "front": "-x"})
    tool = TOOL if place else None
    own = plan(seen["points"], seen["mask"], seen["camera"], model=quick, up="z", front="-x", tool_pose=tool)
    hypothesis = answer["plan"]["hypotheses"][0]
    for name in ("contact_point", "pull", "precontact_point", "quaternion"):
        np.testing.assert_array_equal(hypothesis[name], getattr(own, name))
    np.testing.assert_array_equal(answer["plan"]["flow"], own.flow)
    assert ("actions" in answer) == bool(place)
    if not place:
        np.testing.assert_array_equal(answer["T_world_cloud"], own.T_world_cloud)


def test_a_depth_image_is_the_cloud_of_its_pixels(served: Served) -> None:
    rng = np.random.default_rng(0)
    depth = (1500 + 40 * rng.random((24, 32))).astype(np.uint16)
    depth[3, 4] = 0
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], [-1.5, 0.0, 0.8]
    fx, fy, cx, cy = 30.0, 31.0, 15.5, 11.5
    v, u = np.mgrid[:24, :32]
    z = depth / 1000.0
    points = np.stack([(u - cx) * z / fx, (v - cy) * z / fy, z], -1)[depth > 0] @ pose[:3, :3].T + pose[:3, 3]
    common = {"tool_pose": TOOL, "T_world_cloud": np.eye(4)}
    by_points = Episode(served).answer({**common, "points": points, "camera": pose[:3, 3]})
    for intrinsics in (
        [fx, fy, cx, cy],
        np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]),
        {"fx": fx, "fy": fy, "cx": cx, "cy": cy},
    ):
        request = {**common, "depth": depth, "intrinsics": intrinsics, "camera": pose}
        np.testing.assert_allclose(Episode(served).answer(request)["actions"], by_points["actions"], atol=1e-4)
    metres = {**common, "depth": z, "intrinsics": [fx, fy, cx, cy], "camera": pose}
    np.testing.assert_allclose(Episode(served).answer(metres)["actions"], by_points["actions"], atol=1e-4)


def test_the_first_step_of_a_small_object_goes_where_its_plan_does(seen: dict[str, Any], quick: ArtFlowNet) -> None:
    """The network gets both enlarged; the frame is found by the plan, and kept."""
    episode = Episode(replace(offered(quick), points=1000))
    small = {"points": 0.25 * seen["points"][:1000], "mask": seen["mask"][:1000], "camera": 0.25 * seen["camera"]}
    small["points"][:, 0] += 3.0
    small["camera"] = small["camera"] + [3.0, 0.0, 0.0]
    answer = episode.answer({**small, "tool_pose": [2.0, 0.0, 0.6, 1.0, 0.0, 0.0, 0.0]})
    assert answer["plan"]["network_scale"] > 2
    chosen = episode._memory.policy["policy", "contact_point"][0].double().numpy()
    pose = np.array(answer["T_world_cloud"])
    contact = pose[:3, :3] @ answer["plan"]["hypotheses"][0]["contact_point"] + pose[:3, 3]
    np.testing.assert_allclose(chosen, contact, atol=1e-5)
    kept = episode.answer({**small, "tool_pose": [2.0, 0.0, 0.6, 1.0, 0.0, 0.0, 0.0]})
    assert kept["T_world_cloud"] == answer["T_world_cloud"] and "plan" not in kept


def test_a_request_that_is_refused_changes_nothing(served: Served, acting: dict[str, Any]) -> None:
    moving = [{**acting, "tool_pose": np.array([-1.6 + 0.05 * k, 0.1, 0.8, 1, 0, 0, 0])} for k in range(4)]
    undisturbed, disturbed = Episode(served), Episode(served)
    for request in moving:
        expected = undisturbed.answer(request)["actions"]
        for wrong in ({"tool_pose": [np.nan] * 7}, {"qvel": [1.0]}, {"reset": True, "force": np.inf}):
            with pytest.raises(UserError):
                disturbed.answer({**request, **wrong})
        np.testing.assert_array_equal(disturbed.answer(request)["actions"], expected)


def test_reset_begins_anew(served: Served, acting: dict[str, Any]) -> None:
    episode = Episode(served)
    first = episode.answer(acting)["actions"]
    pressed = {**acting, "tool_pose": [-0.5, 0.1, 0.8, 1, 0, 0, 0], "force": 40.0}
    for _ in range(8):
        episode.answer(pressed)
    assert np.abs(episode.answer(acting)["actions"] - first).max() > 1e-3, "it remembers"
    np.testing.assert_array_equal(episode.answer({**acting, "reset": True})["actions"], first)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"points": np.zeros((5, 4))}, r"\[5, 4\]"),
        ({"points": np.zeros((5, 3), dtype=bool)}, "bool"),
        ({"points": np.full((2913, 3), np.nan)}, "0 points that are finite"),
        ({"points": "cloud"}, "cloud"),
        ({"points": [[0, 0, 0], [1]]}, "cloud"),
        ({"mask": np.ones(3, dtype=bool)}, "mask is \\[3\\]"),
        ({"mask": np.arange(2913) % 3}, "ids 1, 2"),
        ({"camera": [0.0, 1.0]}, "camera"),
        ({"camera": [np.nan] * 3}, "camera"),
        ({"tool_pose": [0.0] * 7}, "quaternion 0"),
        ({"tool_pose": np.zeros((2, 7))}, "tool_pose"),
        ({"qpos": [np.inf] * 8}, "qpos"),
        ({"attached": "yes"}, "attached"),
        ({"force": [1.0, 2.0]}, "force"),
        ({"T_world_cloud": 2 * np.eye(4)}, "no rotation"),
        ({"T_world_cloud": np.eye(3)}, "T_world_cloud"),
        ({"poinst": 1}, "'poinst' is unknown"),
        ({"depth": np.ones((3, 3))}, "one of the two"),
        ({"plan": True, "up": "w"}, "up=w"),
        ({"plan": True, "tilt": "flat"}, "tilt"),
    ],
)
def test_a_wrong_request_is_one_sentence(served: Served, acting: dict[str, Any], wrong: Any, words: str) -> None:
    with pytest.raises(UserError, match=words) as caught:
        Episode(served).answer({**acting, **wrong})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"depth": np.ones((3, 3, 1))}, "depth is"),
        ({"intrinsics": None}, "without intrinsics"),
        ({"intrinsics": [1.0, 2.0]}, "intrinsics"),
        ({"intrinsics": {"fx": 1.0}}, "intrinsics"),
        ({"intrinsics": [0.0, 0.0, 1.0, 1.0]}, "intrinsics"),
        ({"depth_scale": -1}, "depth_scale"),
        ({"depth": np.zeros((3, 3))}, "0 points"),
    ],
)
def test_a_wrong_depth_image_is_one_sentence(served: Served, wrong: Any, words: str) -> None:
    good = {"depth": np.ones((9, 9)), "intrinsics": [9.0, 9.0, 4.0, 4.0], "tool_pose": TOOL, "T_world_cloud": np.eye(4)}
    with pytest.raises(UserError, match=words):
        Episode(served).answer({**good, **wrong})


def test_what_reads_the_truth_is_not_served(served: Served) -> None:
    with pytest.raises(UserError, match=r"policy=expert reads privileged\.flow"):
        replace(served, name="expert", policy=lambda: expert_policy(LIMITS, OPTIONS)).metadata()


def test_a_policy_without_a_network_acts_and_makes_no_plans(served: Served, acting: dict[str, Any]) -> None:
    from fb3d_rl.policies.baselines import normal_policy

    other = Episode(replace(served, name="normal", policy=lambda: normal_policy(LIMITS, OPTIONS), network=None))
    assert np.abs(other.answer(acting)["actions"]).max() > 0
    with pytest.raises(UserError, match="makes no plans"):
        other.answer({**acting, "plan": True})


def test_the_page_names_every_key() -> None:
    from .conftest import ROOT

    text = (ROOT / "docs" / "serve.md").read_text()
    assert all(f"| `{key}` | {meaning} |\n" in text for key, meaning in KEYS.items())
