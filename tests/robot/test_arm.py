from __future__ import annotations

import contextlib
import io
import math
from pathlib import Path

import numpy as np
import pytest
import pytorch_kinematics
import torch
import trimesh

from fb3d_rl.assets.articulation import Mesh
from fb3d_rl.errors import UserError
from fb3d_rl.geometry.transforms import rotate
from fb3d_rl.robot.arm import CUP_LENGTH, SAWYER, Arm, load_arm, named_arm, panda, sawyer
from fb3d_rl.robot.capsules import Capsule, enclosing_capsule, enclosing_capsules, point_distance
from fb3d_rl.robot.inverse import rotation_vector

FLANGES = {"sawyer": "right_hand", "panda_v2": "panda_link8"}
ARMS = pytest.mark.parametrize("arm", [sawyer, panda], ids=["sawyer", "panda"])


def drawn(arm: Arm, count: int, seed: int = 0) -> torch.Tensor:
    shape = (count, len(arm.joints))
    return torch.as_tensor(np.random.default_rng(seed).uniform(arm.lower, arm.upper, shape))


@ARMS
def test_the_tip_is_where_a_second_implementation_has_the_flange_and_the_cup_on_it(arm) -> None:
    arm = arm()
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        chain = pytorch_kinematics.build_serial_chain_from_urdf(arm.urdf.read_bytes(), FLANGES[arm.name])
    assert chain.get_joint_parameter_names() == list(arm.joints)
    q = drawn(arm, 20)
    expected = chain.to(dtype=torch.float64).forward_kinematics(q).get_matrix()
    expected[:, :3, 3] += CUP_LENGTH * expected[:, :3, 2]
    torch.testing.assert_close(arm.tip(q), expected, atol=1e-6, rtol=0.0)  # it reads angles as float32
    alone = torch.stack([arm.tip(state) for state in q])
    torch.testing.assert_close(arm.tip(q), alone)


@ARMS
def test_the_jacobian_is_the_derivative_of_the_tips_pose(arm) -> None:
    arm, step = arm(), 1e-6
    q = drawn(arm, 5)
    jacobian = arm.jacobian(q)
    for j in range(len(arm.joints)):
        aside = torch.zeros(len(arm.joints), dtype=q.dtype)
        aside[j] = step
        before, after = arm.tip(q - aside), arm.tip(q + aside)
        turn = rotation_vector(after[:, :3, :3] @ before[:, :3, :3].mT)
        change = torch.cat([after[:, :3, 3] - before[:, :3, 3], turn], dim=-1) / (2 * step)
        torch.testing.assert_close(jacobian[:, :, j], change, atol=1e-7, rtol=0.0)


PLANAR = """<robot name="planar"><link name="ground"/>
<link name="rail"/><link name="one"><collision><origin xyz="0.2 0 0"/><geometry><box size="0.4 0.02 0.02"/></geometry>
</collision></link><link name="two"/><link name="hand"/>
<joint name="slide" type="prismatic"><parent link="ground"/><child link="rail"/><axis xyz="0 1 0"/>
<limit lower="0.1" upper="0.5" velocity="1"/></joint>
<joint name="shoulder" type="revolute"><parent link="rail"/><child link="one"/><axis xyz="0 0 1"/>
<limit lower="-3" upper="3" velocity="0.5"/></joint>
<joint name="elbow" type="continuous"><origin xyz="0.4 0 0"/><parent link="one"/><child link="two"/><axis xyz="0 0 1"/>
</joint>
<joint name="wrist" type="fixed"><origin xyz="0.3 0 0" rpy="0 1.5707963267948966 0"/><parent link="two"/>
<child link="hand"/></joint></robot>"""


@pytest.fixture
def planar(tmp_path: Path) -> Path:
    (tmp_path / "planar.urdf").write_text(PLANAR)
    return tmp_path / "planar.urdf"


def test_an_arm_of_two_joints_follows_its_closed_form(planar: Path) -> None:
    arm = load_arm(planar, ["shoulder", "elbow"], "hand", cup_length=0.05)
    for a, b in ((0.0, 0.0), (0.4, -1.3), (-2.0, 2.5)):
        x = 0.4 * math.cos(a) + 0.35 * math.cos(a + b)
        y = 0.1 + 0.4 * math.sin(a) + 0.35 * math.sin(a + b)  # the slide stands at its limit
        tip = arm.tip(torch.tensor([a, b], dtype=torch.float64))
        np.testing.assert_allclose(tip[:3, 3], [x, y, 0.0], atol=1e-12)
        np.testing.assert_allclose(tip[:3, 2], [math.cos(a + b), math.sin(a + b), 0.0], atol=1e-12)
    assert arm.velocity.tolist() == [0.5, math.inf]


def test_an_option_names_an_arm_by_its_file_and_flange(planar: Path) -> None:
    arm = named_arm(f"{planar}:hand")
    assert arm.joints == ("shoulder", "elbow")  # what slides does not turn it
    assert named_arm(f"{planar}:shoulder,elbow:hand").joints == arm.joints
    assert named_arm("panda") is panda()
    for name in ("ur5", f"{planar}", f"{planar}:a:b:c"):
        with pytest.raises(UserError, match="is unknown; choose sawyer or panda"):
            named_arm(name)
    with pytest.raises(UserError, match="no joint turns ground"):
        named_arm(f"{planar}:ground")


@pytest.mark.parametrize(
    ("joints", "tip", "says"),
    [
        (["shoulder", "elbow"], "gripper", "no link 'gripper'"),
        (["elbow", "shoulder"], "hand", "in this order; those that do are slide, shoulder, elbow"),
        (["shoulder", "knee"], "hand", "knee"),
        (["slide", "shoulder"], "hand", "slides"),
    ],
)
def test_an_arm_that_the_file_does_not_hold_is_refused_in_a_sentence(planar, joints, tip, says) -> None:
    with pytest.raises(UserError, match=says):
        load_arm(planar, joints, tip)


def test_a_file_that_is_missing_or_broken_is_refused_in_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="cannot be read"):
        load_arm(tmp_path / "none.urdf", ["a"], "b")
    (tmp_path / "broken.urdf").write_text("<robot><link>")
    with pytest.raises(UserError, match="no well-formed XML"):
        load_arm(tmp_path / "broken.urdf", ["a"], "b")


def test_links_between_which_the_srdf_disables_collisions_are_tolerated(planar: Path) -> None:
    planar.with_suffix(".srdf").write_text('<robot><disable_collisions link1="two" link2="rail"/></robot>')
    assert load_arm(planar, ["shoulder", "elbow"], "hand").tolerated == {(0, 2)}


def test_the_sawyer_stretches_as_far_as_its_links_are_long() -> None:
    arm = sawyer()
    far = (arm.tip(drawn(arm, 20000))[:, :3, 3] - torch.tensor([0.081, 0.0, 0.317])).norm(dim=-1).max()
    # Rethink gives 1.26 m to the wrist's end from the axis of the base; the cup adds its length.
    assert 1.0 < float(far) < 1.26 + CUP_LENGTH
    assert SAWYER.is_file() and arm.joints[0] == "right_j0"


def test_capsules_enclose_what_they_were_made_of() -> None:
    rng = np.random.default_rng(0)
    turn = rotate(torch.eye(3), torch.tensor([[0.3, -0.8, 0.5]])).numpy().T
    shapes = [
        trimesh.creation.box((0.1, 0.3, 0.05)),
        trimesh.creation.cylinder(0.05, 0.4),
        trimesh.creation.icosphere(radius=0.1),
        trimesh.util.concatenate([trimesh.creation.box((0.5, 0.05, 0.05)), trimesh.creation.box((0.05, 0.05, 0.3))]),
    ]
    for shape in shapes:
        shape.apply_transform(np.block([[turn, rng.normal(size=(3, 1))], [np.zeros((1, 3)), 1.0]]))
        capsules = enclosing_capsules(Mesh(np.asarray(shape.vertices), np.asarray(shape.faces)))
        points = trimesh.sample.sample_surface(shape, 2000, seed=0)[0]
        apart = np.min([point_distance(points, np.asarray(c.ends)) - c.radius for c in capsules], axis=0)
        assert apart.max() < 1e-6
        assert sum(c.volume for c in capsules) < 7 * shape.convex_hull.volume


def test_the_capsule_of_a_capsules_points_is_that_capsule() -> None:
    shape = trimesh.creation.capsule(height=0.3, radius=0.05)
    found = enclosing_capsule(np.asarray(shape.vertices))
    assert found.volume < 1.03 * Capsule(np.array([[0, 0, 0], [0, 0, 0.3]]), 0.05).volume
