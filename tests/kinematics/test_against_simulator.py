"""The kinematic tree and the flow are the simulator's own, on objects of every joint type."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from fb3d_rl.assets.articulation import ArticulatedObject, Joint, JointType, Mimic
from fb3d_rl.assets.folders import find_folders
from fb3d_rl.assets.partnet_mobility import load_object
from fb3d_rl.env.options import EnvOptions, default_trial
from fb3d_rl.env.task import OpenArticulatedEnv
from fb3d_rl.flow.articulation_flow import STEP, articulation_flow
from fb3d_rl.kinematics.opening import openable_links
from fb3d_rl.kinematics.tree import KinematicTree

from .chains import box, joint, make, pose


def nested(obj: ArticulatedObject) -> bool:
    """Whether a joint carries another one."""
    return bool((KinematicTree.from_object(obj).descendants.sum(0) > 1).any())


def simulated_poses(env: OpenArticulatedEnv, qpos: torch.Tensor) -> np.ndarray:
    """World poses [L, 4, 4] that the simulator gives the links at the joint state ``qpos`` [J]."""
    stage = env.stages[0]
    state = torch.zeros(1, len(stage.order) + len(stage.led))
    state[:, [*stage.order, *stage.led]] = stage.tree.positions(qpos).float()
    env.articulation.set_qpos(state)
    return np.stack([link.entity_pose.to_transformation_matrix() for link in env.stages[0].links]).astype(np.float64)


def check(objects: Iterable[ArticulatedObject]) -> None:
    objects = list(objects)
    env = OpenArticulatedEnv(objects, EnvOptions(points=64))
    rng = np.random.default_rng(0)
    for obj in objects:
        env.reset(options={"trials": [default_trial(obj)]})
        limits = np.nan_to_num(obj.limits, posinf=3.0, neginf=-3.0)
        for _ in range(3):
            qpos = torch.as_tensor(rng.uniform(limits[:, 0], limits[:, 1]))
            poses = simulated_poses(env, qpos)
            np.testing.assert_allclose(poses, env.stages[0].model.poses(qpos), atol=1e-4)
            for j in range(len(qpos)):
                check_flow(env, obj, qpos, j, rng)
    env.close()


def check_flow(
    env: OpenArticulatedEnv, obj: ArticulatedObject, qpos: torch.Tensor, j: int, rng: np.random.Generator
) -> None:
    direction = torch.zeros(len(qpos), dtype=torch.float64)
    direction[j] = 1.0
    links = np.arange(len(obj.links)).repeat(3)
    local = rng.uniform(-1.0, 1.0, size=(len(links), 3))

    def world(offset: float) -> np.ndarray:
        poses = simulated_poses(env, qpos + offset * direction)[links]
        return np.einsum("nij,nj->ni", poses[:, :3, :3], local) + poses[:, :3, 3]

    now = torch.as_tensor(simulated_poses(env, qpos))
    tree = env.stages[0].tree
    flow = articulation_flow(tree, torch.as_tensor(world(0.0)), torch.as_tensor(links), now, direction)
    np.testing.assert_allclose(flow.numpy(), world(0.5 * STEP) - world(-0.5 * STEP), atol=1e-5)


def test_procedural_objects(procedural_objects: dict[str, ArticulatedObject]) -> None:
    check(procedural_objects.values())


def coupled() -> ArticulatedObject:
    """Joints that follow others: beside them, above them, and across fixed and moving links."""
    side = pose((0.0, 0.5, 0.2), Rotation.from_rotvec((0.3, 0.0, 0.2)))
    door = replace(joint("revolute", (0, 0, 1), (0.0, 1.2), pose((0.1, -0.4, 0.0))), name="door")
    plate = box((0.3, 0.02, 0.3), (0.2, 0.0, 0.0))

    def follower(name: str, kind: JointType, multiplier: float, offset: float) -> Joint:
        ends = sorted((offset, 1.2 * multiplier + offset))
        limits = (ends[0], ends[1])
        return replace(joint(kind, (0, 0.6, 0.8), limits, side), name=name, mimic=Mimic("door", multiplier, offset))

    return make(
        (-1, None, "", ()),
        (0, replace(joint("fixed", origin=side), name="glue"), "", (box((0.5, 0.5, 0.5)),)),
        (1, door, "door", (plate,)),
        (1, follower("twin", "revolute", -1.5, 0.1), "", (plate,)),
        (2, replace(joint("fixed", origin=side), name="hinge"), "", ()),
        (4, follower("fold", "revolute", -2.0, 0.0), "", (plate,)),
        (0, replace(joint("prismatic", (1, 0, 0), (0.0, 0.5), side), name="tray"), "drawer", (plate,)),
        (6, follower("rack", "prismatic", 0.25, 0.0), "", (plate,)),
    )


def test_joints_that_follow_others() -> None:
    check([coupled()])


@pytest.mark.parametrize("pushed", ["door", "twin", "fold", "rack"])
def test_whatever_of_a_coupled_mechanism_is_pushed_all_of_it_moves(pushed: str) -> None:
    obj = coupled()
    env = OpenArticulatedEnv([obj], EnvOptions(points=64))
    env.reset(options={"trials": [default_trial(obj, obj.index("link_2"))]})
    (articulation,), stage = env.articulation._objs, env.stages[0]
    joints = [found.child_link.name for found in articulation.active_joints]
    number = next(i for i, link in enumerate(obj.links) if link.joint is not None and link.joint.name == pushed)
    force = np.zeros(len(joints))
    mimic = obj.joint_of(number).mimic
    force[next(k for k, name in enumerate(joints) if name.endswith(f"link_{number}"))] = (
        10.0 if mimic is None else 10.0 * np.sign(mimic.multiplier)
    )
    for _ in range(150):
        articulation.set_qf(force)
        env.scene.step()
        at = articulation.get_qpos()[[*stage.order, *stage.led]]
        together = stage.tree.positions(torch.as_tensor(at[: len(stage.order)]))
        np.testing.assert_allclose(at, together, atol=0.05)  # the moment it runs into its limit
    np.testing.assert_allclose(at, together, atol=2e-3)
    assert env.joint_positions()[0, 0] > 0.9
    env.close()


def test_real_objects_of_every_joint_type(real_root: Path) -> None:
    wanted = {"revolute", "prismatic", "continuous", "nested"}
    chosen: list[ArticulatedObject] = []
    for name in find_folders(real_root):
        text = (real_root / name / "mobility.urdf").read_text(encoding="utf-8")
        kinds = set(re.findall(r'<joint\b[^>]*\btype="(\w+)"', text))
        if not wanted or not (kinds | {"nested"}) & wanted:
            continue
        # Few joints keep the test short; a nested pair needs two.
        if text.count("<joint") > 8 or text.count("<collision") > 60 or (wanted == {"nested"} and len(kinds) < 3):
            continue
        obj = load_object(real_root / name)
        found = kinds & wanted | ({"nested"} & wanted if nested(obj) else set())
        if found and openable_links(obj):
            chosen.append(obj)
            wanted -= found
    if wanted:
        pytest.skip(f"FB3D_PARTNET_MOBILITY holds no small openable object with {', '.join(sorted(wanted))} joints")
    check(chosen)
