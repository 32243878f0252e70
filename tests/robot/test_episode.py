"""Attempts in the simulated cell, held to its truth, and what goes wrong in one sentence."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.assets.partnet_mobility import load_object
from fb3d_rl.errors import UserError
from fb3d_rl.procedural import generate
from fb3d_rl.robot.arm import sawyer
from fb3d_rl.robot.attempt import Attempt, AttemptOptions, Ended, Reason
from fb3d_rl.robot.driver import Driver, JointState, Picture, Wrench
from fb3d_rl.robot.episode import STOPS, attempt
from fb3d_rl.robot.motion import Mover
from fb3d_rl.robot.recorded import Recorder, Replay, Resting
from fb3d_rl.robot.seeing import Motion, denser, motion_at
from fb3d_rl.robot.simulated import CellOptions, SimulatedCell
from fb3d_rl.robot.table import on_table

PARTS = {"KitchenPot": "prismatic", "Safe": "revolute"}


@pytest.fixture(scope="module")
def things(tmp_path_factory: pytest.TempPathFactory) -> dict[str, ArticulatedObject]:
    root = tmp_path_factory.mktemp("things")
    loaded = [load_object(root / name) for name in generate(root, list(PARTS), 1, seed=0)]
    return {obj.category: obj for obj in loaded}


def cell_with(obj: ArticulatedObject, seed: int = 0, **options: object) -> SimulatedCell:
    return SimulatedCell(sawyer(), on_table(obj, 0), CellOptions(**options), seed=seed)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def opened(things: dict[str, ArticulatedObject], tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], tuple]:
    """An attempt of the expert, recorded: cell, attempt, folder."""

    @cache
    def made(category: str) -> tuple[SimulatedCell, Attempt, Path]:
        cell, folder = cell_with(things[category]), tmp_path_factory.mktemp(category)
        flows: list[np.ndarray] = []

        def expert(observation):
            flows.append(cell.expert(observation))
            return flows[-1]

        recorder = Recorder(cell, folder / "session", {"seed": 0})
        judge = recorder.judged(lambda: cell.distance() < 0.1)
        result = attempt(recorder, cell.arm, cell.believed, expert, seed=0, opened=judge)
        recorder.flush()
        np.savez(folder / "flows.npz", *flows)
        return cell, result, folder

    return made


@pytest.mark.parametrize("category", list(PARTS))
def test_the_expert_opens_a_part_through_the_driver_alone(category: str, opened: Callable[[str], tuple]) -> None:
    cell, result, _ = opened(category)
    assert isinstance(cell, Driver)
    assert cell.content.obj.joint_of(cell.content.link).type == PARTS[category]
    assert result.failed is None and result.reason is None and result.opened, result.sentence
    assert cell.distance() < 0.12  # let go, the part may spring back a little
    assert cell.held is None  # the suction is off afterwards
    assert np.abs(cell.joints().velocity).max() < 0.02  # and the arm stands still


@pytest.mark.parametrize("category", list(PARTS))
def test_the_guarded_approach_ends_on_the_true_surface(category: str, opened: Callable[[str], tuple]) -> None:
    cell, result, _ = opened(category)
    assert np.linalg.norm(result.felt - result.contact) < 0.008  # a picture without noise; pixels are 2 mm apart
    pressed = result.forces[result.times <= result.times[0] + 100.0]
    assert np.linalg.norm(pressed, axis=1).max() < AttemptOptions().most_force
    speeds = np.linalg.norm(np.diff(result.tips, axis=0), axis=1)[-30:] / 0.01
    assert speeds.max() < 0.1  # a pull of 5 cm/s


@pytest.mark.parametrize("category", ["KitchenPot", pytest.param("Safe", marks=pytest.mark.slow)])
def test_a_replayed_session_gives_the_same_commands_and_result(category: str, opened: Callable[[str], tuple]) -> None:
    cell, result, folder = opened(category)
    with np.load(folder / "flows.npz") as file:
        flows = [file[name] for name in file.files]
    again = Replay(folder / "session")
    assert isinstance(again, Driver)
    repeated = attempt(again, cell.arm, cell.believed, lambda _: flows.pop(0), seed=0, opened=again.opened)
    assert repeated.opened and repeated.reason is None, repeated.sentence
    np.testing.assert_array_equal(repeated.forces, result.forces)
    np.testing.assert_array_equal(repeated.tips, result.tips)
    other = Replay(folder / "session")
    with np.load(folder / "flows.npz") as file:
        turned = [-file[name] for name in file.files]
    differs = attempt(other, cell.arm, cell.believed, lambda _: turned.pop(0), seed=0, opened=other.opened)
    assert differs.reason is not None and not differs.opened


class Mistaken:
    """It takes the object's top for a lid, until a pull there has failed."""

    def __init__(self, cell: SimulatedCell) -> None:
        self.cell, self.refuted = cell, []

    def __call__(self, seen):
        top = seen.points[:, 2] > seen.points[:, 2].max() - 0.01
        return self.cell.flow(seen.points) if self.refuted else np.where(top[:, None], (0.0, 0.0, 1.0), 0.0)

    def refute(self, at: np.ndarray, way: np.ndarray) -> None:
        self.refuted.append((at, way))


@pytest.mark.slow
def test_a_pull_that_moves_nothing_refutes_the_answer_and_the_next_grip_opens(
    things: dict[str, ArticulatedObject],
) -> None:
    cell = cell_with(things["Safe"], suction="perfect")
    predictor, lines = Mistaken(cell), []
    result = attempt(
        cell, cell.arm, cell.believed, predictor, seed=0, opened=lambda: cell.distance() < 0.1, say=lines.append
    )
    assert result.opened and result.grips == 2, lines
    [(at, way)] = predictor.refuted
    assert way == pytest.approx((0.0, 0.0, 1.0), abs=0.05) and np.linalg.norm(result.contact - at) > 0.04
    assert any("goes back" in line for line in lines)
    cell = cell_with(things["Safe"], suction="perfect")
    once = attempt(cell, cell.arm, cell.believed, Mistaken(cell), replace(AttemptOptions(), grips=1), seed=0)
    assert once.grips == 1 and once.sealed and not once.moved and once.reason is not None


class Still:
    """A robot that stands before an empty table; every answer can be replaced."""

    def __init__(self, cell: SimulatedCell, **answers: Callable[[], object]) -> None:
        self.cell, self.answers, self.moves = cell, answers, 0

    def joints(self) -> JointState:
        return self.answers.get("joints", self.cell.joints)()  # type: ignore[return-value]

    def wrench(self) -> Wrench:
        return self.answers.get("wrench", self.cell.wrench)()  # type: ignore[return-value]

    def move(self, velocity: np.ndarray) -> None:
        self.moves += 1
        self.cell.move(velocity)

    def suction(self, on: bool) -> bool:
        return self.cell.suction(on)

    def picture(self) -> Picture:
        return self.answers.get("picture", self.cell.picture)()  # type: ignore[return-value]


@pytest.fixture(scope="module")
def pot(things: dict[str, ArticulatedObject]) -> SimulatedCell:
    return cell_with(things["KitchenPot"])


def failing(name: str) -> Callable[[], object]:
    def fails() -> object:
        raise UserError(f"the {name} is not connected")

    return fails


def test_bad_pictures_end_an_attempt_in_one_sentence(pot: SimulatedCell) -> None:
    shot = pot.picture()
    bare = np.where(pot.labels() == -3, shot.depth, 0.0).astype(np.float32)
    cases: list[tuple[object, Reason, bool]] = [
        (lambda: None, Reason.NO_PICTURE, False),
        (lambda: replace(shot, depth=None), Reason.NO_DEPTH, False),
        (lambda: replace(shot, depth=np.zeros_like(shot.depth)), Reason.NO_DEPTH, False),
        (lambda: replace(shot, depth=1000 * shot.depth), Reason.NO_DEPTH, False),
        (lambda: replace(shot, depth=bare), Reason.NO_OBJECT, True),
        (failing("camera"), Reason.DRIVER, False),
    ]
    for picture, reason, seen in cases:
        driver = Still(pot, picture=picture)  # type: ignore[arg-type]
        result = attempt(driver, pot.arm, pot.believed, pot.expert)
        assert result.reason is reason and result.seen is seen and not result.segmented
        assert result.sentence and "\n" not in result.sentence and driver.moves == STOPS  # it stops, and no more


def test_bad_flows_and_places_end_an_attempt_in_one_sentence(pot: SimulatedCell) -> None:
    def refuses(observation: object) -> np.ndarray:
        raise UserError("the network is confused")

    cases: list[tuple[Callable, Reason]] = [
        (lambda seen: np.zeros_like(seen.points), Reason.NO_FLOW),
        (lambda seen: np.full_like(seen.points, np.nan), Reason.NO_FLOW),
        (lambda seen: seen.points[:5], Reason.NO_FLOW),
        (refuses, Reason.NO_FLOW),
        # All moves down, so that the arm would have to come from below.
        (lambda seen: np.tile([0.0, 0.0, -1.0], (len(seen.points), 1)), Reason.GOAL_COLLISION),
    ]
    for predictor, reason in cases:
        result = attempt(pot, pot.arm, pot.believed, predictor, AttemptOptions(contacts=1))
        assert result.seen and result.segmented and not result.planned
        assert result.reason in (reason, Reason.UNREACHABLE) and result.failed == "planned"
        assert result.sentence


def test_a_force_that_is_no_number_and_a_robot_that_may_not_move_end_an_attempt(pot: SimulatedCell) -> None:
    broken = Still(pot, wrench=lambda: Wrench(np.full(3, np.nan), np.zeros(3)))
    result = attempt(broken, pot.arm, pot.believed, pot.expert)
    assert result.reason is Reason.BAD_FORCE and result.planned and not result.touched
    before = pot.joints().position
    result = attempt(Resting(pot), pot.arm, pot.believed, pot.expert)
    assert result.reason is Reason.DRIVER and "--allow-motion" in result.sentence and result.planned
    np.testing.assert_array_equal(pot.joints().position, before)


def test_an_approach_that_meets_nothing_ends_after_its_way(pot: SimulatedCell) -> None:
    mover = Mover(pot, pot.arm, AttemptOptions(approach_limit=0.02))
    start = mover.tip(pot.joints())[:3, 3]
    with pytest.raises(Ended) as ended:
        mover.touch(np.array([0.0, 0.0, -1.0]))  # upwards, into the air
    assert ended.value.reason is Reason.NO_TOUCH
    gone = mover.tip(pot.joints())[:3, 3] - start
    np.testing.assert_allclose(gone, [0.0, 0.0, 0.02], atol=2e-3)
    mover.stop(20)


def test_the_wrench_has_the_bias_and_tells_a_contact(pot: SimulatedCell) -> None:
    """Pressing on the table is felt as the force that holds the tip up."""
    quiet = cell_with(pot.content.obj, force_bias=0.0, force_noise=0.0)
    mover = Mover(quiet, quiet.arm, AttemptOptions(approach_limit=0.5, approach_speed=0.1))
    felt = mover.touch(np.array([0.0, 0.0, 1.0]))
    force, _ = quiet.true_wrench()
    assert felt[2] < 0.25 and force[2] > 1.0 and np.linalg.norm(force[:2]) < 0.6 * force[2]
    biased = cell_with(pot.content.obj, seed=3, force_noise=0.0)
    rest = biased.wrench().force
    assert 0.1 < np.abs(rest).max() <= 2.01


def test_a_denser_picture_keeps_planes_and_edges() -> None:
    x, y = np.meshgrid(np.linspace(-0.3, 0.3, 41), np.linspace(-0.3, 0.3, 41))
    plane = 1.0 / (0.8 + 0.3 * x + 0.2 * y)
    near = np.where(x < 0.0, plane, plane + 0.1)
    fine = denser(near)
    assert fine.shape == (81, 81)
    np.testing.assert_allclose(fine[::2, ::2], near, atol=1e-6)
    fx, fy = np.meshgrid(np.linspace(-0.3, 0.3, 81), np.linspace(-0.3, 0.3, 81))
    left = fx < -0.01
    np.testing.assert_allclose(fine[left], (1.0 / (0.8 + 0.3 * fx + 0.2 * fy))[left], atol=1e-6)
    assert (fine[:, 39] == 0).all()  # between the two surfaces there is nothing


def test_the_motion_of_a_door_is_that_of_its_hinge() -> None:
    rng = np.random.default_rng(0)
    hinge, axis = np.array([0.6, 0.2, 0.0]), np.array([0.0, 0.0, 1.0])
    points = hinge + np.column_stack([np.zeros(500), -rng.uniform(0.0, 0.3, 500), rng.uniform(0.0, 0.2, 500)])
    flow = np.cross(axis, points - hinge)
    at = hinge + np.array([0.0, -0.28, 0.1])
    motion = motion_at(points, flow / np.abs(flow).max(), at)
    assert motion is not None
    np.testing.assert_allclose(motion.velocity, [1.0, 0.0, 0.0], atol=1e-3)
    np.testing.assert_allclose(motion.turn, axis / 0.28, atol=0.2)
    np.testing.assert_allclose(motion.of(hinge), 0.0, atol=0.06)
    assert motion_at(points + 1.0, flow, at) is None  # nothing near that moves


def test_a_motion_carries_on_around_its_axis() -> None:
    motion = Motion(np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(motion.of(np.array([0.0, 1.0, 0.0])), [-1.0, 0.0, 0.0], atol=1e-12)


def test_a_session_that_is_missing_damaged_or_there_already_is_refused(tmp_path: Path, pot: SimulatedCell) -> None:
    with pytest.raises(UserError, match="no recorded session"):
        Replay(tmp_path)
    recorder = Recorder(pot, tmp_path / "a", {})
    recorder.joints()
    recorder.flush()
    with pytest.raises(UserError, match="holds a recorded session"):
        Recorder(pot, tmp_path / "a", {})
    replay = Replay(tmp_path / "a")
    np.testing.assert_array_equal(replay.joints().position, pot.joints().position)
    with pytest.raises(UserError, match="ends here"):
        replay.wrench()
    with pytest.raises(UserError, match="goes on with joints, not wrench"):
        Replay(tmp_path / "a").wrench()
    (tmp_path / "a" / "calls_0000.npz").write_bytes(b"no archive")
    with pytest.raises(UserError, match="damaged"):
        Replay(tmp_path / "a")


def test_a_full_recording_stops_writing_and_lets_the_robot_go_on(tmp_path: Path, pot: SimulatedCell) -> None:
    recorder = Recorder(pot, tmp_path / "a", {}, largest=1)
    for _ in range(3):
        assert recorder.picture().depth.any()
    recorder.flush()
    assert len(list((tmp_path / "a").glob("picture_*.npz"))) == 1
