"""What of a picture is the object, against the simulator's labels, with a camera's noise and a calibration error."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fb3d_rl.assets.partnet_mobility import load_object
from fb3d_rl.camera.noise import AZURE_KINECT, PRESETS, DepthNoiseOptions
from fb3d_rl.camera.views import View
from fb3d_rl.perception.foreground import HEIGHT, LEVEL, Plane, above, object_points, on_robot, table_plane
from fb3d_rl.procedural import generate

from .table_scene import Scene, Seen

PAGE = Path(__file__).resolve().parents[2] / "docs" / "robot.md"
Masks = dict[str, NDArray[np.bool_]]


def masks(seen: Seen, seed: int) -> Masks:
    """The object's points by each way that the table below compares."""
    robot, narrow = (on_robot(seen.depth, seen.robot, dilation=pixels).ravel() for pixels in (4, 0))
    table = table_plane(seen.points, np.random.default_rng(seed))
    return {
        "z cut, mask as drawn": object_points(seen.points, LEVEL, narrow, deviations=np.inf),
        "z cut, mask dilated": object_points(seen.points, LEVEL, robot, deviations=np.inf),
        "z cut, dilated, no outliers": object_points(seen.points, LEVEL, robot),
        "plane, dilated, no outliers": object_points(seen.points, table, robot),
    }


def quality(kept: NDArray[np.bool_], label: NDArray[np.int64]) -> tuple[float, float]:
    """Precision and recall."""
    on = label == 0
    return float(on[kept].mean()), float(kept[on].mean())


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Scene]:
    root, made = tmp_path_factory.mktemp("objects"), {}

    def scene(category: str) -> Scene:
        if category not in made:
            made[category] = Scene(load_object(root / generate(root, [category], 1, seed=0)[0]))
        return made[category]

    return scene


def test_above_is_the_height_over_a_plane_in_any_pose() -> None:
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (50, 4, 3))
    points[3, 2] = np.nan
    np.testing.assert_array_equal(above(points), points[..., 2] > HEIGHT)
    turn, shift = Rotation.random(random_state=1).as_matrix(), np.array([0.3, -0.2, 1.0])
    moved = Plane(turn[:, 2], float(turn[:, 2] @ shift))
    np.testing.assert_array_equal(above(points @ turn.T + shift, moved, 0.02), points[..., 2] > 0.02)


@pytest.mark.parametrize("noise", [0.0, 0.003, 0.008])
def test_the_table_is_found_where_it_is_and_not_where_it_should_be(noise: float) -> None:
    rng = np.random.default_rng(0)
    table = np.column_stack([rng.uniform(-0.5, 0.5, (9000, 2)), np.zeros(9000)])
    block = rng.uniform([-0.1, -0.1, 0.0], [0.1, 0.1, 0.3], (4000, 3))
    points = np.concatenate([table, block]) + noise * rng.standard_normal((13000, 3))
    turn = Rotation.from_rotvec([0.012, -0.008, 0.0]).as_matrix()
    seen = np.concatenate([points @ turn.T + [0, 0, 0.011], np.full((500, 3), np.nan)])
    found = table_plane(seen, np.random.default_rng(1))
    assert np.degrees(np.arccos(found.normal @ turn[:, 2])) < 0.3
    assert found.height == pytest.approx(0.011, abs=0.0025)
    far = table_plane(seen + [0, 0, 0.2], np.random.default_rng(1), Plane(LEVEL.normal, -0.2))
    assert far == Plane(LEVEL.normal, -0.2), "no points there: the expected plane"


def test_the_robot_is_what_lies_at_or_behind_its_model() -> None:
    robot = np.zeros((40, 40))
    robot[10:30, 15:25] = 1.0
    depth = np.full((40, 40), 1.5)
    depth[10:30, 15:25] = 1.0  # the robot
    depth[12, 17], depth[13, 17] = 0.96, 0.98  # in front of it, farther and nearer than the band
    depth[14, 17] = 0.0
    narrow, wide = on_robot(depth, robot, dilation=0), on_robot(depth, robot, dilation=3)
    expected = robot > 0
    expected[[12, 14], 17] = False
    np.testing.assert_array_equal(narrow, expected)
    row, column = np.indices(depth.shape)
    outside = np.hypot(
        np.maximum(0, np.maximum(10 - row, row - 29)), np.maximum(0, np.maximum(15 - column, column - 24))
    )
    np.testing.assert_array_equal(wide, (outside <= 3) & (narrow | (robot == 0)))
    assert not on_robot(depth, np.zeros_like(robot)).any()
    assert on_robot(depth, robot, band=0.05, dilation=0)[12, 17]


def test_trailing_points_go_and_the_object_stays() -> None:
    rng = np.random.default_rng(0)
    plate = np.stack(
        [
            *np.meshgrid(np.arange(0, 0.3, 0.003), np.arange(0.1, 0.3, 0.003)),
        ],
        -1,
    ).reshape(-1, 2)
    plate = np.column_stack([plate[:, 0], 0 * plate[:, 0], plate[:, 1]]) + 0.0015 * rng.standard_normal((len(plate), 3))
    trail = rng.uniform([-0.3, -0.3, 0.05], [0.3, -0.05, 0.4], (60, 3))
    lost = np.full((7, 3), np.nan)
    kept = object_points(np.concatenate([plate, trail, lost]), LEVEL)
    assert kept[: len(plate)].mean() > 0.99 and kept[len(plate) : -7].mean() < 0.1 and not kept[-7:].any()
    everything = object_points(np.concatenate([plate, trail, lost]), LEVEL, deviations=np.inf)
    assert everything[:-7].all() and not everything[-7:].any()


def drawn(seed: int) -> DepthNoiseOptions:
    """A camera from half as noisy to twice as noisy as an Azure Kinect."""
    rng, kinect = np.random.default_rng(seed), AZURE_KINECT
    factor = 2.0 ** rng.uniform(-1.0, 1.0, 5)
    return replace(
        kinect,
        bias_offset=kinect.bias_offset * factor[0],
        axial_sigma=tuple(x * factor[1] for x in kinect.axial_sigma),
        lateral_pixels=kinect.lateral_pixels * factor[2],
        flying_share=kinect.flying_share * factor[3],
        holes_share=kinect.holes_share * factor[4],
    )


@pytest.mark.parametrize("category, seed", [("Microwave", 0), ("KitchenPot", 1), ("Box", 2)])
def test_the_object_is_found_with_drawn_noise(scenes: Callable[[str], Scene], category: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    seen = scenes(category).see(View(rng.uniform(-30, 30), 40.0), drawn(seed), seed, 0.3, 0.003)
    precision, recall = quality(masks(seen, seed)["plane, dilated, no outliers"], seen.label)
    assert precision >= 0.98 and recall >= 0.92
    raw = object_points(seen.points, LEVEL, deviations=np.inf)
    assert quality(raw, seen.label)[0] < 0.95, "the robot is in the picture"


SETTINGS = (
    ("exact", 0.0, 0.0), ("azure_kinect", 0.0, 0.0), ("azure_kinect", 0.2, 0.002), ("azure_kinect", 0.5, 0.005),
    ("azure_kinect", 1.0, 0.01), ("stereo", 0.0, 0.0),
)  # fmt: skip


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_precision_and_recall_are_those_of_the_table(scenes: Callable[[str], Scene]) -> None:
    """``pytest tests/perception/test_foreground.py -m slow -s`` prints it: 4 objects of 60 cm, 3 views of each."""
    lines, best = [], {}
    for noise, degrees, metres in SETTINGS:
        found: dict[str, list[tuple[float, float]]] = {}
        for number, category in enumerate(("Microwave", "KitchenPot", "Box", "Laptop")):
            for view in range(3):
                seed = 100 * number + view
                shot = scenes(category).see(View(-30.0 + 20.0 * view, 40.0), PRESETS[noise], seed, degrees, metres)
                for name, kept in masks(shot, seed).items():
                    found.setdefault(name, []).append(quality(kept, shot.label))
        means = {name: np.mean(pairs, 0) for name, pairs in found.items()}
        best[noise, degrees] = means
        cells = [f"{100 * precision:.1f} / {100 * recall:.1f}" for precision, recall in means.values()]
        lines.append(f"| {noise}, {degrees:g} degrees, {1000 * metres:g} mm | {' | '.join(cells)} |")
    print("", *lines, sep="\n")
    for (noise, _), means in best.items():
        drawn_mask, dilated, filtered, plane = means.values()
        assert dilated[0] >= drawn_mask[0] - 1e-9 and filtered[0] >= dilated[0]
        if noise != "stereo":
            assert plane[0] >= 0.99 and plane[1] >= 0.92
    assert best["azure_kinect", 1.0]["z cut, mask as drawn"][0] < 0.97
    shown = {line.split(" |")[0]: line for line in PAGE.read_text().splitlines()}
    for line in lines:
        key = line.split(" |")[0]
        there, here = (np.array(re.findall(r"\d+\.\d", text[len(key) :]), float) for text in (shown[key], line))
        np.testing.assert_allclose(there, here, atol=1.0)
