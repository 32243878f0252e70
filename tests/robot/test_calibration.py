"""launch/robot.py calibrate: pictures of a marker in, the camera's pose and a verdict out."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from fb3d_rl.robot.calibration import calibrated
from fb3d_rl.robot.calibration_session import LENS, Session, read_session, simulate
from fb3d_rl.robot.marker import Marker
from launch.robot import main


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with pictures and poses of a simulated cell, and its calibration beside them."""
    folder = tmp_path_factory.mktemp("cell")
    assert (
        main(["calibrate", "--samples", "20", "--seed", "3", "--out", f"{folder / 'out.json'}", "--keep", f"{folder}"])
        == 0
    )
    return folder


@pytest.fixture
def copy(kept: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(kept, tmp_path / "copy"))


def rows_of(folder: Path) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = json.loads((folder / "poses.json").read_text())
    return rows


def refusal(folder: Path, capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """The one sentence that the command says."""
    assert main(["calibrate", str(folder), "--out", str(folder / "new.json"), *words]) == 2
    said = capsys.readouterr()
    assert said.err.startswith("error: ") and said.err.count("\n") == 1 and not said.out
    assert not (folder / "new.json").exists()
    return said.err


@pytest.mark.parametrize("seed", range(3))
def test_the_simulated_camera_is_found(seed: int) -> None:
    found = calibrated(simulate(30, seed, Marker()), Marker())
    assert found.errors is not None and found.errors[0] < 0.1 and found.errors[1] < 0.002
    assert found.grade == "good" and found.verdict.startswith("good: ") and len(found.names) + len(found.unseen) == 30


def test_a_seed_gives_the_same_pictures() -> None:
    first, again, other = (simulate(5, seed, Marker()) for seed in (1, 1, 2))
    for one, two in zip(first.pictures(), again.pictures(), strict=True):
        np.testing.assert_array_equal(one, two)
    np.testing.assert_array_equal(first.flange, again.flange)
    assert np.abs(first.flange - other.flange).max() > 0.01


def test_few_samples_are_not_called_good() -> None:
    """Errors of so few are larger than they seem."""
    assert calibrated(simulate(10, 0, Marker()), Marker()).grade == "fair"


def test_a_folder_gives_what_the_cell_gave(kept: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "deep" / "again.json"
    assert main(["calibrate", str(kept), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "20 of 20 pictures" in said and "Good: " in said and str(out) in said and "True error" not in said
    cell, folder = (json.loads(path.read_text()) for path in (kept / "out.json", out))
    truth = cell.pop("truth")
    for name in ("T_base_camera", "T_flange_marker"):
        np.testing.assert_allclose(folder[name], cell[name], atol=1e-6)
        np.testing.assert_allclose(folder[name], truth[name], atol=0.005)
    assert folder.keys() == cell.keys() and folder["not_seen"] == [] and len(folder["samples"]) == 20
    assert truth["error"]["position_mm"] < 2.0


def test_quaternions_in_csv_are_the_same_poses(kept: Path, copy: Path) -> None:
    matrices = read_session(kept)
    (copy / "poses.json").unlink()
    with (copy / "poses.csv").open("w") as file:
        writer = csv.writer(file)
        writer.writerow("image x y z qw qx qy qz".split())
        for name, pose in zip(matrices.names, matrices.flange, strict=True):
            x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
            writer.writerow([name, *pose[:3, 3], w, x, y, z])
    np.testing.assert_allclose(read_session(copy).flange, matrices.flange, atol=1e-9)


def test_pictures_without_the_marker_and_wrong_poses_are_named(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = rows_of(copy)
    Image.new("RGB", (1280, 720)).save(copy / rows[4]["image"])
    rows[7]["T_base_flange"], rows[9]["T_base_flange"] = rows[9]["T_base_flange"], rows[7]["T_base_flange"]
    (copy / "poses.json").write_text(json.dumps(rows))
    assert main(["calibrate", str(copy), "--out", str(copy / "new.json")]) == 0
    assert "19 of 20 pictures" in (said := capsys.readouterr().out)
    assert "2 of 19 samples disagree with the others (007.png, 009.png)" in said
    content, truth = json.loads((copy / "new.json").read_text()), json.loads((copy / "out.json").read_text())["truth"]
    assert content["not_seen"] == ["004.png"]
    assert [sample["image"] for sample in content["samples"] if sample["outlier"]] == ["007.png", "009.png"]
    np.testing.assert_allclose(content["T_base_camera"], truth["T_base_camera"], atol=0.005)


def test_a_marker_of_another_size_is_noticed_and_does_no_harm(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    expected = json.loads((copy / "out.json").read_text())
    for side in (".12", ".102"):
        assert main(["calibrate", str(copy), "--marker-side", side, "--out", str(copy / "new.json")]) == 0
        assert f"mm, not {1000 * float(side):g}" in capsys.readouterr().out
        content = json.loads((copy / "new.json").read_text())
        np.testing.assert_allclose(content["T_base_camera"], expected["T_base_camera"], atol=1e-4)
        assert content["marker_side_mm"]["found"] == pytest.approx(100.0, abs=0.3)
    assert "mm, not" not in expected["verdict"]


@pytest.mark.parametrize("wrong", ["inverted", "shuffled", "focal length"])
def test_wrong_poses_and_intrinsics_are_not_to_be_used(
    wrong: str, copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = rows_of(copy)
    poses = [row["T_base_flange"] for row in rows]
    if wrong == "inverted":
        poses = np.linalg.inv(poses).tolist()
    elif wrong == "shuffled":
        poses = poses[1:] + poses[:1]
    else:
        lens = json.loads((copy / "camera.json").read_text())
        (copy / "camera.json").write_text(json.dumps({**lens, "fx": 0.9 * lens["fx"], "fy": 0.9 * lens["fy"]}))
    changed = [{**row, "T_base_flange": pose} for row, pose in zip(rows, poses, strict=True)]
    (copy / "poses.json").write_text(json.dumps(changed))
    assert main(["calibrate", str(copy), "--out", str(copy / "new.json")]) == 1
    assert "Poor: " in (said := capsys.readouterr().out) and "do not use it: check the intrinsics" in said


def test_a_turn_about_one_axis_is_refused(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = rows_of(copy)
    for i, row in enumerate(rows):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_rotvec([0.0, 0.1 * i, 0.0]).as_matrix()
        row["T_base_flange"] = pose.tolist()
    (copy / "poses.json").write_text(json.dumps(rows))
    assert "one axis only" in refusal(copy, capsys)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("--marker-id", "3"), "marker 3 of 4X4_50 was found in 0 of 20 images"),
        (("--dictionary", "7X7_50"), "found in 0 of 20"),
        (("--dictionary", "none"), "choose from"),
        (("--marker-id", "-1"), "0 to 49"),
        (("--marker-side", "0"), "out of range"),
        (("--marker-side", "nan"), "out of range"),
        (("--samples", "5"), "leave it out"),
    ],
)
def test_settings_that_do_not_fit_are_refused(
    words: tuple[str, ...], says: str, copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert says in refusal(copy, capsys, *words)


def row(**changes: Any) -> str:
    """poses.json with one row."""
    return json.dumps([{"image": "000.png", **dict.fromkeys(("x", "y", "z", "qx", "qy", "qz"), 0), "qw": 1, **changes}])


def lens(**changes: Any) -> str:
    return json.dumps({"fx": 600, "fy": 600, "cx": 320, "cy": 240, **changes})


@pytest.mark.parametrize(
    ("file", "text", "says"),
    [
        ("poses.json", None, "poses.json or poses.csv"),
        ("poses.json", "[{", "cannot be read"),
        ("poses.json", "{}", "no list of rows"),
        ("poses.json", "[]", "no rows"),
        ("poses.json", row(image="nothing.png"), "'nothing.png'"),
        ("poses.json", '[{"image": "000.png", "x": 1}]', "no qw"),
        ("poses.json", row(T_base_flange=[1, 2]), "no pose"),
        ("poses.json", row(qw=2), "length 1"),
        ("poses.json", row(x="far"), "no pose"),
        ("poses.json", row(y="nan"), "no rigid"),
        ("poses.json", row(x=512), "millimetres"),
        ("poses.json", row(T_base_flange=np.diag([1, 1, -1, 1]).tolist()), "no rigid"),
        ("poses.json", row(), "too few"),
        ("camera.json", None, "camera.json"),
        ("camera.json", '{"fx": 600}', "intrinsics"),
        ("camera.json", lens(width=640, height=480), "1280 x 720"),
        ("camera.json", lens(distortion=[1, 2, 3]), "distortion"),
        ("camera.json", lens(D=[0, 0, 0, 0], distortion_model="fisheye"), "undistort"),
        ("005.png", "no image", "005.png is damaged"),
    ],
)
def test_files_that_are_not_what_they_should_be_are_refused(
    file: str, text: str | None, says: str, copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if text is None:
        (copy / file).unlink()
    else:
        (copy / file).write_text(text)
    assert says in refusal(copy, capsys)


def test_no_folder_and_too_few_samples_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "no folder" in refusal(tmp_path / "none", capsys)
    assert main(["calibrate", "--samples", "3", "--out", str(tmp_path / "out.json")]) == 2
    assert "too few" in capsys.readouterr().err


def test_distortion_is_read_as_ros_and_opencv_write_it(copy: Path) -> None:
    matrix = [LENS.fx, 0, LENS.cx, 0, LENS.fy, LENS.cy, 0, 0, 1]
    text = f"camera_matrix:\n  rows: 3\n  cols: 3\n  data: {matrix}\n"
    text += "distortion_model: plumb_bob\ndistortion_coefficients:\n  data: [0.1, -0.2, 0, 0.001, 0]\n"
    (copy / "camera.json").unlink()
    (copy / "camera.yaml").write_text(text)
    session: Session = read_session(copy)
    assert session.lens.distortion == (0.1, -0.2, 0.0, 0.001, 0.0) and session.lens.fx == LENS.fx
