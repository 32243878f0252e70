"""Pulls in UMPNet's world: the quasi-static rule against what follows by hand, and PyBullet where it is installed."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.assets.partnet_mobility import load_object
from fb3d_rl.camera.umpnet import BASE, SCALE, TURN
from fb3d_rl.env.umpnet.quasistatic import FRICTION, Paths, Quasistatic, balance, stroke
from fb3d_rl.env.umpnet.scenes import Mode, Placed, bullet_order, place, read_scenes, sorted_out
from fb3d_rl.env.umpnet.world import GAIN, STILL, STROKE, make_world
from fb3d_rl.errors import UserError

from .made import scene_of


def backends() -> list[object]:
    return ["quasistatic", pytest.param("pybullet", marks=pytest.mark.skipif(not has_pybullet(), reason="no PyBullet"))]


def has_pybullet() -> bool:
    try:
        import pybullet  # noqa: F401
    except ImportError:
        return False
    return True


def some(objects: dict[str, ArticulatedObject], **joint: float) -> list[Placed]:
    return [place(scene_of(obj, **joint), obj) for obj in objects.values()]


def grip(placed: Placed) -> np.ndarray:
    """The vertex of the selected link that is farthest from its joint's axis, in the world."""
    link, pose = placed.posed.obj.links[placed.link], placed.posed.poses(placed.start)[placed.link]
    vertices = np.concatenate([mesh.vertices for mesh in link.visuals])
    axis = placed.posed.obj.joint_of(placed.link).axis
    far = np.linalg.norm(np.cross(vertices, axis), axis=1).argmax()
    return np.asarray(pose[:3, :3] @ vertices[far] + pose[:3, 3])


def test_the_balance_is_the_least_of_the_forces_work() -> None:
    rng = np.random.default_rng(0)
    wanted, tangent = (torch.from_numpy(rng.normal(size=(200, 3))) for _ in range(2))
    tangent[:40, 0], tangent[20:60, 1] = 0.0, 0.0
    wanted[100:] *= 0.01
    motion = balance(wanted, tangent)

    def work(s: torch.Tensor) -> torch.Tensor:
        return (wanted - s[:, None] * tangent).abs().sum(1) + FRICTION * s.abs()

    for off in (-1e-3, 1e-3, 0.1, -0.1):
        assert (work(motion) <= work(motion + off) + 1e-12).all()
    assert (motion == 0).any() and (motion != 0).any()


def test_a_pull_along_a_slide_ends_where_the_carriage_hardly_moves() -> None:
    zero = np.zeros(3)
    row = np.concatenate([zero, zero, zero, [0.0, 1.0, 0.0], [-9.0, 9.0]])
    ends = stroke(Paths([row]), torch.zeros(1).double(), torch.tensor([[0.0, 1.0, 0.0]]).double())
    assert float(ends) == pytest.approx(STROKE - STILL / GAIN, abs=5 * STILL)  # .05 m short
    across = stroke(Paths([row]), torch.zeros(1).double(), torch.tensor([[1.0, 0.0, 0.0]]).double())
    assert float(across) == 0.0
    short = np.concatenate([row[:12], [-0.01, 0.02]])
    ways = torch.tensor([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]]).double()
    assert stroke(Paths([short, short]), torch.zeros(2).double(), ways).tolist() == pytest.approx([0.02, -0.01])


def test_friction_holds_a_part_that_is_pulled_near_its_hinge() -> None:
    """A motor of 1500 N moves a joint with 240 N m of friction from a radius of .16 m on."""
    zero, ways = np.zeros(3), torch.tensor([[0.0, 1.0, 0.0]] * 2).double()
    rows = [np.concatenate([zero, [r, 0, 0], [0, r, 0], zero, [-3.0, 3.0]]) for r in (0.99 * FRICTION, 1.2 * FRICTION)]
    near, far = stroke(Paths(rows), torch.zeros(2).double(), ways).tolist()
    assert near == 0.0 and far > 0.1


@pytest.mark.parametrize("backend", backends())
def test_every_scene_starts_in_its_joint_state(backend: str, objects: dict[str, ArticulatedObject]) -> None:
    placed = some(objects)
    world = make_world(backend, placed)
    for one, state in zip(placed, world.states, strict=True):
        np.testing.assert_allclose(state, one.start, atol=1e-9)
    world.close()


@pytest.mark.parametrize("backend", backends())
def test_the_held_point_moves_with_its_link(backend: str, objects: dict[str, ArticulatedObject]) -> None:
    """Pulled along its path the part moves that way, by less than the stroke; pulled back it returns; others rest."""
    placed = some(objects)
    world = make_world(backend, placed)
    points = [grip(one) for one in placed]
    for k, (one, point) in enumerate(zip(placed, points, strict=True)):
        world.touch(k, one.link, point)
        np.testing.assert_allclose(world.held(k), point, atol=1e-6)
    ways = []
    for one, point in zip(placed, points, strict=True):
        low = one.start.copy()
        low[one.joint] += 1e-4
        before, after = (one.posed.poses(state)[one.link] for state in (one.start, low))
        moved = after @ np.linalg.inv(before) @ np.append(point, 1.0)
        ways.append((moved[:3] - point) / np.linalg.norm(moved[:3] - point))
    directions = np.stack(ways)
    directions[-1] = 0.0
    world.pull(directions)
    for k, one in enumerate(placed[:-1]):
        j = one.joint
        assert world.states[k][j] > one.start[j] + 0.01
        stroke_of = np.linalg.norm(world.held(k) - points[k]) * SCALE
        assert 0.01 < stroke_of < STROKE
        pose = one.posed.poses(world.states[k])[one.link] @ np.linalg.inv(one.posed.poses(one.start)[one.link])
        np.testing.assert_allclose((pose @ np.append(points[k], 1.0))[:3], world.held(k), atol=1e-5)
        others = np.arange(len(one.start)) != j
        np.testing.assert_allclose(world.states[k][others], one.start[others], atol=1e-4)
    np.testing.assert_array_equal(world.states[-1], placed[-1].start)
    world.close()


def test_the_two_worlds_agree(objects: dict[str, ArticulatedObject]) -> None:
    pytest.importorskip("pybullet")
    placed = [one for one in some(objects) for _ in range(6)]
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(len(placed), 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    ends = []
    for backend in ("quasistatic", "pybullet"):
        world = make_world(backend, placed)
        for k, one in enumerate(placed):
            world.touch(k, one.link, grip(one))
        world.pull(directions)
        ends.append(
            [world.states[k][one.joint] / np.ptp(one.posed.obj.limits[one.joint]) for k, one in enumerate(placed)]
        )
        world.close()
    assert (np.abs(np.subtract(*ends)) < 0.03).mean() > 0.8
    assert np.ptp(ends[0]) > 0.1


def test_without_pybullet_one_sentence_says_so(
    objects: dict[str, ArticulatedObject], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pybullet", None)
    with pytest.raises(UserError, match=r"fb3d_rl\[umpnet\]"):
        make_world("pybullet", some(objects))


def test_a_circle_about_a_hinge_off_the_origin(objects: dict[str, ArticulatedObject]) -> None:
    """The path of a held point is the one on which the kinematic tree moves it."""
    for one in some(objects):
        world, point = Quasistatic([one]), grip(one)
        world.touch(0, one.link, point)
        for share in (0.2, 0.7):
            state = one.start.copy()
            low, high = one.posed.obj.limits[one.joint]
            state[one.joint] = low + share * (high - low)
            world.states[0] = state
            moved = one.posed.poses(state)[one.link] @ np.linalg.inv(one.posed.poses(one.start)[one.link])
            np.testing.assert_allclose(world.held(0), (moved @ np.append(point, 1.0))[:3], atol=1e-9)
    assert math.isclose(float(np.linalg.det(TURN)), 1.0) and BASE[2] == 0.0


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["manipulation", "exploration"])
@pytest.mark.parametrize("backend", backends())
def test_every_scene_of_the_table_resets_to_its_joint_states(backend: str, mode: Mode, real_root: Path) -> None:
    kept, _ = sorted_out(read_scenes(mode), [path.name for path in real_root.iterdir()])
    known: dict[str, ArticulatedObject] = {}
    for scene in kept:
        if scene.object not in known:
            known[scene.object] = load_object(real_root / scene.object)
        placed = place(scene, known[scene.object])
        world = make_world(backend, [placed])
        (state,), order = world.states, bullet_order(placed.posed.obj)
        world.close()
        for index, joint in scene.joints.items():
            link = order[index]
            unit = SCALE if placed.posed.obj.joint_of(link).type == "prismatic" else 1.0
            wanted = joint.start if index == scene.selected else joint.goal
            assert unit * state[placed.posed.obj.movable.index(link)] == pytest.approx(wanted, abs=1e-6), scene.name
