"""The task: simulator and formulas agree, episodes repeat bit for bit, states can be restored."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import gymnasium
import h5py
import numpy as np
import pytest
import sapien
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.trajectory import replay_trajectory
from mani_skill.utils.wrappers import RecordEpisode
from mani_skill.vector.wrappers.gymnasium import ManiSkillVectorEnv
from tensordict import TensorDict

from fb3d_rl import contract
from fb3d_rl.assets.articulation import ArticulatedObject, Link, Mesh
from fb3d_rl.camera.views import View, ViewRange
from fb3d_rl.env.options import EnvOptions, Trial, default_trial
from fb3d_rl.env.task import OpenArticulatedEnv
from fb3d_rl.errors import UserError
from fb3d_rl.kinematics.opening import openable_links

from .conftest import POINTS, links_called, place_before, start, step_until, velocity


def middle(obj: ArticulatedObject, seed: int) -> torch.Tensor:
    """A random joint state [J] within the limits."""
    limits = np.nan_to_num(obj.limits, posinf=1.0, neginf=-1.0)
    return torch.as_tensor(np.random.default_rng(seed).uniform(limits[:, 0], limits[:, 1]))


def set_joints(env: OpenArticulatedEnv, state: torch.Tensor) -> None:
    qpos = torch.zeros(1, len(state))
    qpos[:, env.stages[0].order] = state.float()
    env.articulation.set_qpos(qpos)


def poses(env: OpenArticulatedEnv) -> np.ndarray:
    return np.stack([link.entity_pose.to_transformation_matrix() for link in env.stages[0].links])


def check_kinematics(env: OpenArticulatedEnv, obj: ArticulatedObject) -> None:
    env.reset(options={"trials": [default_trial(obj)]})
    for seed in range(3):
        state = middle(obj, seed)
        set_joints(env, state)
        expected = env.stages[0].model.poses(state)
        np.testing.assert_allclose(poses(env), expected, atol=1e-4)


def test_simulator_has_the_poses_of_the_kinematic_tree(
    env: OpenArticulatedEnv, objects: dict[str, ArticulatedObject]
) -> None:
    for obj in objects.values():
        check_kinematics(env, obj)


def test_real_objects_have_the_poses_of_the_kinematic_tree(real_objects: list[ArticulatedObject]) -> None:
    env = OpenArticulatedEnv(real_objects, EnvOptions(points=POINTS))
    for obj in real_objects:
        check_kinematics(env, obj)


def test_object_equals_the_one_that_maniskill_reads(
    env: OpenArticulatedEnv, objects: dict[str, ArticulatedObject]
) -> None:
    obj = objects["StorageFurniture"]
    env.reset(options={"trials": [default_trial(obj)]})
    loader = env.scene.create_urdf_loader()
    loader.name = "reference"
    builder = loader.parse(str(obj.urdf))["articulation_builders"][0]
    for link in builder.link_builders:
        link.visual_records.clear()
    builder.initial_pose = sapien.Pose(env.stages[0].model.T_world_base)
    reference = builder.build(fix_root_link=True)
    state = middle(obj, 0)
    set_joints(env, state)
    by_link = dict(zip((obj.links[i].name for i in obj.movable), state.tolist(), strict=True))
    reference.set_qpos(torch.tensor([[by_link[joint.child_link.name] for joint in reference.active_joints]]))
    for link, pose in zip(obj.links, poses(env), strict=True):
        other = reference.links_map[link.name]._objs[0]
        np.testing.assert_allclose(other.entity_pose.to_transformation_matrix(), pose, atol=1e-4)
        if not env.stages[0].tree.descendants[:, obj.index(link.name)].any():
            continue
        mass = env.stages[0].links[obj.index(link.name)].mass
        assert other.mass * env.options.density / 1000.0 == pytest.approx(mass, rel=0.02)


def test_observation_keeps_the_contract(env: OpenArticulatedEnv, objects: dict[str, ArticulatedObject]) -> None:
    obj = objects["StorageFurniture"]
    obs = start(env, obj, links_called(obj, "rotation_door")[0])
    td = TensorDict(obs, batch_size=[1])
    contract.check(td, "observation")
    contract.check(td, "privileged")
    contract.check(TensorDict(env.evaluate(), batch_size=[1]).exclude("success"), "metrics")
    assert float(env.evaluate()["normalized_distance"]) == 1.0


def test_flow_is_the_simulators_own_motion(env: OpenArticulatedEnv, objects: dict[str, ArticulatedObject]) -> None:
    for category, semantic in (("StorageFurniture", "rotation_door"), ("Table", "drawer"), ("Laptop", "screen")):
        obj = objects[category]
        obs = start(env, obj, links_called(obj, semantic)[0])
        state = env.joint_positions()[0].double()
        before = poses(env)
        state[env.stages[0].target] += 0.002 * np.sign(
            env.stages[0].goal - env.stages[0].trial.start[env.stages[0].target]
        )
        set_joints(env, state)
        motion = poses(env) @ np.linalg.inv(before)
        points = obs["observation"]["points"][0].numpy()
        link = obs["privileged"]["link"][0].numpy()
        moved = np.einsum("nij,nj->ni", motion[link][:, :3, :3], points) + motion[link][:, :3, 3] - points
        moved[link < 0] = 0
        expected = moved / np.linalg.norm(moved, axis=-1).max()
        flow = obs["privileged"]["flow"][0].numpy()
        np.testing.assert_allclose(flow, expected, atol=0.01)
        part = obs["observation"]["part_mask"][0].numpy()
        assert part.any() and not flow[~part].any()


def test_the_gripper_hides_points_and_is_none(objects: dict[str, ArticulatedObject]) -> None:
    env = OpenArticulatedEnv([objects["Table"]], EnvOptions(points=96 * 96))
    obs, _ = env.reset()
    eye = obs["observation"]["camera_position"][0]
    seen = int(obs["observation"]["valid"].sum())
    # A hand close to the lens covers the object.
    middle_of_view = obs["observation"]["points"][0].mean(0)
    hand = torch.zeros(1, 8)
    hand[0, :3] = eye + 0.1 * (middle_of_view - eye)
    env.agent.robot.set_qpos(hand)
    covered = env.get_obs()["observation"]
    assert int(covered["valid"].sum()) < seen
    cloud = covered["points"][0][covered["valid"][0]]
    assert len(cloud) and float((cloud - hand[0, :3]).norm(dim=-1).min()) > 0.2


def episode(env: OpenArticulatedEnv, trial: Trial) -> list[bytes]:
    """Push, touch and pull for some steps; every bit of every observation, and of the metrics."""
    obs, info = env.reset(options={"trials": [trial]})
    place_before(env, trial.link, obs)
    record = []
    for action in [velocity(x=0.3)] * 12 + [velocity(x=-0.3, y=0.1)] * 12:
        obs, reward, *_, info = env.step(action)
        tensors = [value for group in obs.values() for value in group.values()]
        tensors += [reward, info["normalized_distance"], info["contact"]]
        record.append(b"".join(tensor.numpy().tobytes() for tensor in tensors))
    return record


def test_a_trial_repeats_bit_for_bit(env: OpenArticulatedEnv, objects: dict[str, ArticulatedObject]) -> None:
    cabinet, table = objects["StorageFurniture"], objects["Table"]
    a = default_trial(cabinet, links_called(cabinet, "drawer")[0], View(20.0, 40.0), seed=3)
    b = default_trial(table)
    first = episode(env, a)
    episode(env, b)
    assert episode(env, a) == first
    fresh = OpenArticulatedEnv([cabinet], EnvOptions(points=POINTS))
    assert episode(fresh, a) == first
    assert episode(env, dataclasses.replace(a, seed=4)) != first


def test_state_can_be_restored(env: OpenArticulatedEnv, objects: dict[str, ArticulatedObject]) -> None:
    drawer = links_called(objects["Table"], "drawer")[0]
    place_before(env, drawer, start(env, objects["Table"], drawer))
    held, _ = step_until(env, velocity(x=0.3), lambda: env.stages[0].suction.attached)
    for _ in range(5):
        env.step(velocity(x=-0.2))
    state = env.get_state_dict()
    assert held and len(state["articulations"]) == 2, "the object and the gripper"
    outcomes = []
    for _ in range(2):
        for _ in range(5):
            obs, *_, info = env.step(velocity(x=-0.3))
        outcomes.append((obs["observation"]["qpos"], info["normalized_distance"], env.elapsed_steps.clone()))
        env.stages[0].suction.release()
        env.step(velocity(x=-0.5))
        env.set_state_dict(state)
        restored = env.get_state_dict()
        for key in ("suction", "episode"):
            torch.testing.assert_close(restored[key], state[key])
        for name, value in state["articulations"].items():
            torch.testing.assert_close(restored["articulations"][name], value, atol=1e-5, rtol=0)
    for first, second in zip(*outcomes, strict=True):
        torch.testing.assert_close(first, second, atol=2e-3, rtol=0)


def test_a_flat_state_restores_all_of_it(env: OpenArticulatedEnv, objects: dict[str, ArticulatedObject]) -> None:
    """In another object than the first one too: its state has another length."""
    for category in ("Table", "StorageFurniture"):
        drawer = links_called(objects[category], "drawer")[0]
        place_before(env, drawer, start(env, objects[category], drawer))
        held, _ = step_until(env, velocity(x=0.3), lambda: env.stages[0].suction.attached)
        assert held
        state, seen = env.get_state(), env.get_obs()
        env.reset(options={"trials": [env.stages[0].trial]})
        assert not env.stages[0].suction.attached
        env.set_state(state)
        torch.testing.assert_close(env.get_state(), state, atol=1e-5, rtol=0)
        for group, entries in env.get_obs().items():
            for key, value in entries.items():
                torch.testing.assert_close(value, seen[group][key], atol=1e-4, rtol=0, msg=key)


def test_a_stage_takes_another_trial_with_what_is_built(
    env: OpenArticulatedEnv, objects: dict[str, ArticulatedObject]
) -> None:
    """What a reset of some of several environments does: their objects stay."""
    obj = objects["StorageFurniture"]
    drawer, door = links_called(obj, "drawer")[0], links_called(obj, "rotation_door")[0]
    start(env, obj, drawer)
    built = env.stages[0]
    placed = built.place(default_trial(obj, door))
    assert placed.links is built.links and placed.static is built.static and placed.order == built.order
    assert obj.movable[placed.target] == door and bool(placed.moved[door]) and not bool(placed.moved[drawer])
    assert placed.direction.tolist() == [placed.sign * (link == door) for link in obj.movable]
    rng = np.random.default_rng(0)
    kept = [env.source.draw(rng, obj.id, built.trial.view) for _ in range(5)]
    assert {(trial.object, trial.view) for trial in kept} == {(obj.id, built.trial.view)}, "object and view stay"
    with pytest.raises(UserError, match="trials"):
        env.reset(options={"trials": [default_trial(obj), default_trial(obj)]})


def test_an_episode_is_truncated_at_the_horizon(objects: dict[str, ArticulatedObject]) -> None:
    env = OpenArticulatedEnv([objects["Table"]], EnvOptions(points=POINTS, horizon=4))
    env.reset()
    flags = [bool(env.step(velocity())[3]) for _ in range(4)]
    assert flags == [False, False, False, True]


def test_gymnasium_makes_it(objects: dict[str, ArticulatedObject]) -> None:
    made = gymnasium.make(
        "fb3d_rl.env.task:OpenArticulated-v1",
        objects=[objects["Table"]],
        options=EnvOptions(points=POINTS, horizon=3),
        reward_mode="sparse",
    )
    obs, _ = made.reset(seed=1)
    assert obs["observation"]["points"].shape == (1, POINTS, 3)
    results = [made.step(made.action_space.sample()) for _ in range(3)]
    assert [bool(truncated) for *_, truncated, _ in results] == [False, False, True]
    assert all(float(reward) == 0.0 for _, reward, *_ in results)
    vector = ManiSkillVectorEnv(made, record_metrics=True)
    vector.reset(seed=1)
    *_, info = [vector.step(vector.action_space.sample()) for _ in range(3)][-1]
    assert int(info["final_info"]["episode"]["episode_len"]) == 3


def test_gymnasiums_time_limit_is_the_task_s_horizon(objects: dict[str, ArticulatedObject]) -> None:
    """As ManiSkill's training scripts make it; gymnasium's own wrapper would answer True in place of a tensor."""
    given = {"objects": [objects["Table"]], "options": EnvOptions(points=POINTS), "obs_mode": "state"}
    made = gymnasium.make("fb3d_rl.env.task:OpenArticulated-v1", max_episode_steps=3, **given)
    for env in (made, gymnasium.make(made.spec)):
        assert env.unwrapped.options.horizon == env.unwrapped.max_episode_steps == 3
        assert not isinstance(env, gymnasium.wrappers.TimeLimit)
        vector = ManiSkillVectorEnv(env, auto_reset=True, ignore_terminations=True, record_metrics=True)
        vector.reset(seed=0)
        ends = [bool(vector.step(vector.action_space.sample())[3]) for _ in range(7)]
        assert ends == [False, False, True] * 2 + [False]
    assert EnvOptions(points=POINTS) == given["options"], "the user's own options are as they were"


def test_it_needs_no_objects_from_outside() -> None:
    made = gymnasium.make("fb3d_rl.env.task:OpenArticulated-v1", obs_mode="none")
    assert len(made.unwrapped.objects) == 3


def test_flat_observations_are_the_state(objects: dict[str, ArticulatedObject]) -> None:
    flat = OpenArticulatedEnv([objects["Table"]], obs_mode="state")
    nested = OpenArticulatedEnv([objects["Table"]], obs_mode="state_dict")
    row, _ = flat.reset(seed=5)
    entries, _ = nested.reset(seed=5)
    values = [value.float() for group in entries.values() for value in group.values()]
    torch.testing.assert_close(row, torch.cat(values, dim=-1))
    assert flat.single_observation_space.shape == row.shape[1:]


def test_an_episodes_seed_makes_it_again(objects: dict[str, ArticulatedObject]) -> None:
    """RecordEpisode keeps it, also of an episode that began without one."""
    env = OpenArticulatedEnv(objects.values(), EnvOptions(points=POINTS, start="random"), obs_mode="state")
    kept = []
    for seed in (3, None, None, [4]):
        env.reset(seed=seed)
        kept.append((int(env._episode_seed[0]), env.stages[0].trial))
    assert (kept[0][0], kept[3][0]) == (3, 4) and len({trial for _, trial in kept}) == 4
    for number, trial in reversed(kept):
        env.reset(seed=number)
        assert env.stages[0].trial == trial


def test_a_state_of_a_file_is_restored(objects: dict[str, ArticulatedObject]) -> None:
    """There it is of arrays without the axis of the environments."""

    def plain(state: Any) -> Any:
        return {k: plain(v) for k, v in state.items()} if isinstance(state, dict) else state.cpu().numpy()[0]

    env = OpenArticulatedEnv([objects["Table"]], EnvOptions(points=POINTS), obs_mode="state")
    env.reset(seed=0)
    for _ in range(3):
        env.step(env.action_space.sample())
    state = env.get_state()
    file = plain(env.get_state_dict())
    env.reset(seed=0)
    assert not torch.equal(env.get_state(), state)
    env.set_state_dict(file)
    assert torch.equal(env.get_state(), state)


@pytest.mark.slow
@pytest.mark.parametrize("extra", [[], ["--use-env-states"]], ids=["by actions", "by states"])
def test_maniskill_replays_what_it_recorded(tmp_path: Path, extra: list[str]) -> None:
    name, file = "fb3d_rl.env.task:OpenArticulated-v1", tmp_path / "trajectory.h5"
    env = RecordEpisode(gymnasium.make(name, obs_mode="pointcloud"), str(tmp_path), save_video=False,
                        trajectory_name="trajectory", source_type="test", source_desc="test")  # fmt: skip
    for seed in (1, None):
        env.reset(seed=seed)
        for _ in range(5):
            env.step(env.action_space.sample())
    env.close()
    words = ["--traj-path", str(file), "-o", "pointcloud", "--save-traj", "--allow-failure", *extra]
    replay_trajectory.main(replay_trajectory.parse_args(words))
    [replayed] = set(tmp_path.glob("*.h5")) - {file}
    with h5py.File(file) as first, h5py.File(replayed) as second:
        assert set(first) == set(second) == {"traj_0", "traj_1"}
        for trajectory in first:
            keys = [f"{trajectory}/obs/observation/{key}" for key in ("qpos", "points")]
            for key in keys:
                np.testing.assert_allclose(first[key][:], second[key][:], atol=1e-5)


def test_trials_are_drawn_from_the_seed(objects: dict[str, ArticulatedObject]) -> None:
    options = EnvOptions(points=POINTS, start="random", views=ViewRange((-30.0, 30.0), (20.0, 50.0)))
    env = OpenArticulatedEnv(objects.values(), options)

    def trials(seed: int) -> list[Trial]:
        drawn = []
        for i in range(12):
            obs, _ = env.reset(seed=seed if i == 0 else None)
            assert int(obs["observation"]["part_mask"].sum()) > 0, "the part to open is in sight"
            drawn.append(env.stages[0].trial)
        return drawn

    first = trials(7)
    assert trials(7) == first and trials(8) != first
    assert len({trial.object for trial in first}) > 2
    for trial in first:
        assert -30 <= trial.view.azimuth <= 30 and 20 <= trial.view.elevation <= 50
        obj = objects[next(name for name, obj in objects.items() if obj.id == trial.object)]
        assert trial.link in openable_links(obj)
    assert len({max(trial.start) for trial in first}) > 6, "starts differ"


def test_the_link_can_be_named(objects: dict[str, ArticulatedObject]) -> None:
    obj = objects["StorageFurniture"]
    door = obj.links[links_called(obj, "rotation_door")[0]].name
    env = OpenArticulatedEnv([objects["Oven"], obj], EnvOptions(points=POINTS, start="closed"), link=door)
    for _ in range(5):
        env.reset()
        trial = env.stages[0].trial
        assert env.objects[trial.object].links[trial.link].name == door
    with pytest.raises(UserError, match="nowhere"):
        OpenArticulatedEnv([obj], link="nowhere")


@pytest.mark.parametrize("bad", [math.nan, math.inf, 1.5, -1.01])
def test_impossible_actions_are_refused(
    env: OpenArticulatedEnv, objects: dict[str, ArticulatedObject], bad: float
) -> None:
    start(env, objects["Table"], objects["Table"].movable[0])
    state, action = env.get_state(), velocity()
    action[0, 4] = bad
    with pytest.raises(UserError, match="from -1 to 1"):
        env.step(action)
    with pytest.raises(UserError, match="shape"):
        env.step(torch.zeros(1, 7))
    torch.testing.assert_close(env.get_state(), state, atol=0, rtol=0)


def test_pictures_need_no_renderer(objects: dict[str, ArticulatedObject]) -> None:
    obj = objects["Table"]
    env = OpenArticulatedEnv([obj], EnvOptions(points=POINTS), render_mode="rgb_array")
    drawer = links_called(obj, "drawer")[0]
    place_before(env, drawer, start(env, obj, drawer))
    before = env.render()
    assert before.shape == (1, 512, 512, 3) and before.dtype == torch.uint8
    assert torch.equal(env.render(), before)
    state = env.joint_positions()[0].double()
    state[env.stages[0].target] = env.stages[0].goal
    set_joints(env, state)
    assert (env.render() != before).any(-1).float().mean() > 0.01, "the drawer is out"


def test_nothing_is_rendered(env: OpenArticulatedEnv, objects: dict[str, ArticulatedObject]) -> None:
    start(env, objects["Table"], objects["Table"].movable[0])
    assert not env.scene.can_render()
    entities = env.scene.sub_scenes[0].entities
    assert len(entities) > 3
    for entity in entities:
        assert not any(isinstance(part, sapien.render.RenderBodyComponent) for part in entity.components)


def test_parts_do_not_coast_on(env: OpenArticulatedEnv, objects: dict[str, ArticulatedObject]) -> None:
    obj = objects["Table"]
    start(env, obj, links_called(obj, "drawer")[0])
    speed = torch.zeros(1, len(obj.movable))
    speed[:, env.stages[0].order[env.stages[0].target]] = 0.3
    env.articulation.set_qvel(speed)
    for _ in range(20):
        env.step(velocity())
    assert (
        0.02
        < float(env.joint_positions()[0, env.stages[0].target]) - env.stages[0].trial.start[env.stages[0].target]
        < 0.1
    )


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"object": "nobody"}, "nobody"),
        ({"link": 0}, "movable"),
        ({"start": (0.0,)}, "start"),
    ],
)
def test_wrong_trials_are_refused(
    env: OpenArticulatedEnv, objects: dict[str, ArticulatedObject], change: dict, words: str
) -> None:
    trial = dataclasses.replace(default_trial(objects["Table"]), **change)
    with pytest.raises(UserError, match=words):
        env.reset(options={"trials": [trial]})


def test_a_trial_that_is_won_from_the_start_is_refused(
    env: OpenArticulatedEnv, objects: dict[str, ArticulatedObject]
) -> None:
    obj = objects["Oven"]
    with pytest.raises(UserError, match="fully open"):
        env.reset(options={"trials": [dataclasses.replace(default_trial(obj), start=tuple(obj.limits[:, 1]))]})


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ({"num_envs": 2}, "num_envs=2 needs a CUDA device"),
        ({"num_envs": 2, "sim_backend": "physx_cpu"}, "num_envs=2 needs CUDA"),
        ({"num_envs": 0}, "num_envs=0"),
        ({"sim_backend": "gpu"}, "sim_backend=gpu needs a CUDA device"),
        ({"sim_backend": "cuda:1"}, "sim_backend=cuda:1 needs a CUDA device"),
        ({"sim_backend": "warp"}, "sim_backend='warp' is unknown; choose from auto, "),
        ({"render_backend": "gpu"}, "render_backend=gpu needs Vulkan"),
        ({"render_backend": "opengl"}, "render_backend='opengl' is unknown; choose from"),
        ({"render_mode": "human"}, "render_mode=human needs Vulkan"),
        ({"render_mode": "sensors"}, "render_mode=sensors needs Vulkan"),
        ({"render_mode": "ascii"}, "render_mode='ascii' is unknown to this task; choose from human, "),
        ({"obs_mode": "rgbd", "render_backend": "none"}, "obs_mode=rgbd needs a renderer"),
        ({"obs_mode": "sound"}, "obs_mode='sound' is unknown"),
        ({"reward_mode": "dense"}, "reward_mode='dense' is unknown"),
    ],
)
def test_what_is_not_there_is_refused_in_a_sentence(
    objects: dict[str, ArticulatedObject], monkeypatch: pytest.MonkeyPatch, asked: dict, words: str
) -> None:
    def nothing(device: str) -> None:
        raise RuntimeError(f'failed to find device "{device}"')

    monkeypatch.setattr("fb3d_rl.camera.sapien._renderer", nothing)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(UserError) as error:
        OpenArticulatedEnv([objects["Table"]], EnvOptions(points=POINTS), **asked)
    assert words in str(error.value) and "\n" not in str(error.value)


def test_a_window_that_cannot_be_opened_is_named(env: OpenArticulatedEnv, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_screen(self: object) -> None:
        raise RuntimeError("Create window failed")

    monkeypatch.setattr(BaseEnv, "render_human", no_screen)
    with pytest.raises(UserError, match="screen"):
        env.render_human()


def test_nor_the_window_that_the_first_reset_opens(env: OpenArticulatedEnv, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_screen(self: object, options: object) -> None:
        raise RuntimeError("Create window failed")

    monkeypatch.setattr(BaseEnv, "_reconfigure", no_screen)
    with pytest.raises(RuntimeError, match="Create window failed"):  # without a window it is another fault
        env._reconfigure({})
    monkeypatch.setattr(env, "render_mode", "human")
    with pytest.raises(UserError, match="screen"):
        env._reconfigure({})


def test_an_environment_without_objects_is_refused() -> None:
    with pytest.raises(UserError, match="object"):
        OpenArticulatedEnv([])


def test_what_cannot_move_collides_where_it_is_seen(
    env: OpenArticulatedEnv, objects: dict[str, ArticulatedObject]
) -> None:
    for obj in objects.values():
        env.reset(options={"trials": [default_trial(obj)]})
        seen = [
            mesh.vertices @ pose[:3, :3].T + pose[:3, 3]
            for i, (link, pose) in enumerate(zip(obj.links, poses(env), strict=True))
            for mesh in link.collisions
            if not env.stages[0].tree.descendants[:, i].any()
        ]
        box = env.stages[0].static.compute_global_aabb_tight()
        vertices = np.concatenate(seen)
        np.testing.assert_allclose(box, [vertices.min(0), vertices.max(0)], atol=1e-4)


def merged(link: Link) -> tuple[Mesh, ...]:
    """The link's collision meshes as one: its hull closes every hollow."""
    if not link.collisions:
        return ()
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in link.collisions)])
    faces = [mesh.faces + start for mesh, start in zip(link.collisions, starts, strict=False)]
    return (Mesh(np.concatenate([mesh.vertices for mesh in link.collisions]), np.concatenate(faces)),)


def test_the_hand_reaches_into_a_hollow_body_but_not_through_its_walls(objects: dict[str, ArticulatedObject]) -> None:
    obj = objects["Oven"]
    obj = dataclasses.replace(obj, links=tuple(dataclasses.replace(x, collisions=merged(x)) for x in obj.links))
    env = OpenArticulatedEnv([obj], EnvOptions(points=POINTS))
    door = links_called(obj, "door")[0]
    env.reset(options={"trials": [default_trial(obj, door)]})
    state = torch.as_tensor(np.where(np.array(obj.movable) == door, obj.limits[:, 1], env.stages[0].trial.start))
    set_joints(env, state)  # the door is open
    (front, _, _), (back, _, top) = env.stages[0].static.compute_global_aabb_tight()
    hand = torch.zeros(1, 8)
    hand[0, 0], hand[0, 2] = float(front) - 0.4, 0.5 * float(top)
    env.agent.robot.set_qpos(hand)
    for _ in range(40):
        env.step(velocity(x=2.0))
    tip = float(env.agent.tool_pose()[0, 0])
    assert front + 0.1 < tip < back


@pytest.mark.parametrize("past", [-0.2, 0.05, 0.2])
def test_a_part_that_went_past_a_goal_within_the_range_has_missed_it(
    objects: dict[str, ArticulatedObject], past: float
) -> None:
    """Past the limit that opens it is open; there the sign counts."""
    table = objects["Table"]
    env = OpenArticulatedEnv([table], EnvOptions(points=64))
    link = openable_links(table)[0]
    for goal, fraction, expected in ((0.5, 0.1, abs(past)), (0.5, 0.9, abs(past)), (None, 0.1, max(0.0, -past))):
        trial = default_trial(table, link, fraction=fraction, goal=goal)
        env.reset(options={"trials": [trial]})
        stage = env.stages[0]
        state = torch.tensor(trial.start)
        state[stage.target] = stage.goal + past * (stage.goal - trial.start[stage.target])
        set_joints(env, state)
        metrics = env.evaluate()
        assert float(metrics["normalized_distance"]) == pytest.approx(expected, abs=1e-4)
        assert bool(metrics["success"]) == (expected < 0.1)
