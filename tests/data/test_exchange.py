"""Demonstrations in other people's formats: they come back in every bit, and strangers' files can be read."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from fb3d_rl.camera.views import View
from fb3d_rl.contract import spec
from fb3d_rl.data import lerobot, maniskill
from fb3d_rl.data.demonstrations import DemonstrationBuffer, EpisodeInfo, recorded
from fb3d_rl.errors import UserError

POINTS = 6
INFO = EpisodeInfo("a/1", "Oven", 2, (0.1, -0.2), View(12.5, 1 / 3), 2**40, 1, True, 0.05, 9)
LENGTHS = (9, 4, 7)


def frames(steps: int, seed: int) -> TensorDict:
    rng = torch.Generator().manual_seed(seed)
    td = TensorDict({}, batch_size=[steps])
    for group in ("observation", "privileged", "action"):
        for key, entry in spec(group).items():
            shape = [POINTS if size == "N" else int(size) for size in entry.shape]
            value = torch.randn(steps, *shape, generator=rng)
            td[key] = value > 0 if entry.dtype is torch.bool else value
    td["action"] = td["action"].tanh()
    td["expert", "action"] = torch.randn(steps, 8, generator=rng).tanh()
    td["expert", "acts"] = torch.rand(steps, 1, generator=rng) > 0.5
    td["elapsed_steps"] = torch.arange(steps, dtype=torch.int32)[:, None]
    td["learner", "discrepancy"] = torch.rand(steps, 1, generator=rng)
    td["action"][0, 0] = -0.0  # equal to 0, but of other bits
    return td


@pytest.fixture
def buffer(tmp_path: Path) -> DemonstrationBuffer:
    """An episode that succeeded, one that was cut, one that failed, in another category."""
    buffer = DemonstrationBuffer.create(tmp_path / "made", 50, {"seed": 3, "env_info": {"env_id": "E"}})
    infos = (INFO, replace(INFO, seed=1), replace(INFO, seed=2, category="Box", success=False, steps=7))
    for k, (steps, info) in enumerate(zip(LENGTHS, infos, strict=True)):
        buffer.extend(recorded(frames(steps, k), info, beta=0.7**k, version=k - 1), info)
    buffer.commit()
    return buffer


def same(a: DemonstrationBuffer, b: DemonstrationBuffer) -> bool:
    first, second = a[range(len(a))], b[range(len(b))]
    return (
        (a.episodes, a.about, a.keys) == (b.episodes, b.about, b.keys)
        and a.keys != {}
        and all(first[key].numpy().tobytes() == second[key].numpy().tobytes() for key in a.keys)
    )


def test_maniskills_files_come_back_in_every_bit(tmp_path: Path, buffer: DemonstrationBuffer) -> None:
    maniskill.write(buffer, tmp_path / "x.h5")
    assert same(buffer, maniskill.read(tmp_path / "x.h5", tmp_path / "again"))
    assert same(buffer, DemonstrationBuffer.open(tmp_path / "again"))
    assert {path.name for path in tmp_path.iterdir()} == {"made", "again", "x.h5", "x.json"}


def test_maniskills_own_loader_reads_them(tmp_path: Path, buffer: DemonstrationBuffer) -> None:
    dataset = pytest.importorskip("mani_skill.trajectory.dataset")
    maniskill.write(buffer, tmp_path / "x.h5")
    loaded = dataset.ManiSkillTrajectoryDataset(str(tmp_path / "x.h5"))
    rows = buffer[range(len(buffer))]
    assert len(loaded) == len(buffer)
    assert np.array_equal(loaded.obs["observation"]["points"], rows["observation", "points"])
    assert np.array_equal(loaded.actions, rows["action"])
    ends = np.zeros(len(buffer), dtype=bool)
    ends[8] = True  # the second episode was cut, the third failed
    assert np.array_equal(loaded.success, ends) and np.array_equal(loaded.terminated, ends)
    assert np.flatnonzero(loaded.truncated).tolist() == [19]
    assert [episode["elapsed_steps"] for episode in loaded.episodes] == list(LENGTHS)
    only = dataset.ManiSkillTrajectoryDataset(str(tmp_path / "x.h5"), success_only=True)
    assert len(only) == 13


def test_lerobots_data_set_comes_back_in_every_bit(
    tmp_path: Path, buffer: DemonstrationBuffer, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("pyarrow")
    for name, megabytes in (("one", 100), ("many", 0)):
        monkeypatch.setattr(lerobot, "FILE_MB", megabytes)
        lerobot.write(buffer, tmp_path / name, rate=20)
        assert len(list((tmp_path / name / "data").rglob("*.parquet"))) == (1 if megabytes else 3)
        assert same(buffer, lerobot.read(tmp_path / name, tmp_path / f"{name} again"))


def test_lerobots_data_set_says_what_lerobot_asks_for(tmp_path: Path, buffer: DemonstrationBuffer) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    lerobot.write(buffer, tmp_path / "x", rate=20)
    info = json.loads((tmp_path / "x/meta/info.json").read_text())
    assert info["features"]["observation.points"] == {"dtype": "float32", "shape": [POINTS, 3], "names": None}
    assert (info["total_episodes"], info["total_frames"], info["fps"]) == (3, 20, 20)
    table = parquet.read_table(tmp_path / "x" / info["data_path"].format(chunk_index=0, file_index=0))
    assert table.num_rows == 20 and set(table.column_names) == set(info["features"])
    assert table["index"].to_pylist() == list(range(20))
    assert table["frame_index"].to_pylist() == [t for steps in LENGTHS for t in range(steps)]
    assert table["timestamp"].to_pylist()[:3] == pytest.approx([0, 0.05, 0.1])
    assert table["task_index"].to_pylist() == [0] * 13 + [1] * 7
    episodes = parquet.read_table(tmp_path / "x/meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [(e["dataset_from_index"], e["dataset_to_index"], e["length"]) for e in episodes] == [
        (0, 9, 9), (9, 13, 4), (13, 20, 7),
    ]  # fmt: skip
    stats = json.loads((tmp_path / "x/meta/stats.json").read_text())
    points = buffer[range(20)]["observation", "points"].double()
    for name, value in {
        "mean": points.mean(0), "std": points.std(0, correction=0), "min": points.amin(0), "max": points.amax(0),
    }.items():  # fmt: skip
        assert np.allclose(stats["observation.points"][name], value, atol=1e-12), name
    assert stats["action"]["count"] == [20]


def test_a_data_set_without_the_table_of_episodes_still_says_how_its_rows_came_about(
    tmp_path: Path, buffer: DemonstrationBuffer
) -> None:
    pytest.importorskip("pyarrow")
    lerobot.write(buffer, tmp_path / "set", 20)
    features = json.loads((tmp_path / "set" / "meta" / "info.json").read_text())["features"]
    assert {"action", "expert.action", "expert.acts", "learner.discrepancy", "record.beta"} < set(features)
    (tmp_path / "set" / lerobot.ABOUT).unlink()
    again = lerobot.read(tmp_path / "set", tmp_path / "again")
    assert [(info.success, info.round) for info in again.episodes] == [(True, 1), (True, 1), (False, 1)]
    assert torch.equal(again.frames(2)["record", "beta"], buffer.frames(2)["record", "beta"])


def test_strangers_data_become_the_experts(tmp_path: Path, buffer: DemonstrationBuffer) -> None:
    """As RecordEpisode and LeRobot write it: no labels, and nothing about trials."""
    import h5py

    maniskill.write(buffer, tmp_path / "x.h5")
    with h5py.File(tmp_path / "x.h5", "a") as file:
        for group in file.values():
            del group[maniskill.OWN], group["obs/observation/goal_sense"]
    about = json.loads((tmp_path / "x.json").read_text())
    for entry in (about, *about["episodes"]):
        del entry[maniskill.OWN]
    (tmp_path / "x.json").write_text(json.dumps(about))
    read = [maniskill.read(tmp_path / "x.h5", tmp_path / "from h5")]
    if find_spec("pyarrow"):
        lerobot.write(buffer, tmp_path / "y", rate=20)
        (tmp_path / "y" / lerobot.ABOUT).unlink()
        read.append(lerobot.read(tmp_path / "y", tmp_path / "from lerobot"))
    for strange in read:
        assert [info.rows for info in strange.episodes] == list(LENGTHS)
        assert all(info.start == () for info in strange.episodes)
        assert torch.equal(strange[range(20)]["action"], buffer[range(20)]["action"])
    rows = read[0][range(20)]
    assert bool((rows["observation", "goal_sense"] == 1).all()), "who says nothing of a goal opens"
    assert torch.equal(rows["expert", "action"], rows["action"]) and bool(rows["expert", "acts"].all())
    assert rows["elapsed_steps"].flatten().tolist() == [t for steps in LENGTHS for t in range(steps)]
    ours = {key: value for key, value in buffer.keys.items() if key[0] not in ("learner", "record")}
    assert {key: read[0].keys[key] for key in ours} == ours, "trained on together with our own"
    assert [info.success for info in read[0].episodes] == [True, False, False]


def test_whatever_is_wrong_with_a_file_is_one_sentence_and_leaves_nothing(
    tmp_path: Path, buffer: DemonstrationBuffer
) -> None:
    import h5py

    out = tmp_path / "out"
    with pytest.raises(UserError, match="cannot be read"):
        maniskill.read(tmp_path / "nowhere.h5", out)
    maniskill.write(buffer, tmp_path / "x.h5")
    with pytest.raises(UserError, match="exists already"):
        maniskill.write(buffer, tmp_path / "x.h5")
    with h5py.File(tmp_path / "x.h5", "a") as file:
        del file["traj_2/obs/observation/points"]
    with pytest.raises(UserError, match="points"):
        maniskill.read(tmp_path / "x.h5", out)
    with h5py.File(tmp_path / "x.h5", "a") as file:
        del file["traj_0/obs"]
        file["traj_0/obs"] = np.zeros((10, 3))
    with pytest.raises(UserError, match="flat"):
        maniskill.read(tmp_path / "x.h5", out)
    (tmp_path / "x.h5").write_bytes(b"no")
    with pytest.raises(UserError, match="cannot be read"):
        maniskill.read(tmp_path / "x.h5", out)
    assert not out.exists()


BAD = {
    "a row is missing": (lambda group: shorten(group, "obs/observation/qpos", 3), r"observation/qpos has 3 rows for 7"),
    "no step": (lambda group: [shorten(group, name, 0) for name in leaves(group)], "no step"),
    "labels of no number": (lambda group: put(group["actions"], np.nan), "from -1 to 1"),
    "labels that are too large": (lambda group: put(group["actions"], 7.5), "from -1 to 1"),
    "points of no number": (lambda group: put(group["obs/observation/points"], np.nan), "points holds NaN"),
    "an infinite force": (lambda group: put(group["obs/observation/contact_force"], np.inf), "contact_force holds NaN"),
}


def leaves(group: Any) -> list[str]:
    names: list[str] = []
    group.visititems(lambda name, item: names.append(name) if hasattr(item, "shape") else None)
    return names


def shorten(group: Any, name: str, rows: int) -> None:
    values = group[name][:rows]
    del group[name]
    group[name] = values


def put(values: Any, number: float) -> None:
    values[2] = number


@pytest.mark.parametrize("what", BAD)
def test_an_episode_that_cannot_be_learned_from_is_refused(
    tmp_path: Path, buffer: DemonstrationBuffer, what: str
) -> None:
    import h5py

    change, says = BAD[what]
    maniskill.write(buffer, tmp_path / "x.h5")
    with h5py.File(tmp_path / "x.h5", "a") as file:
        file["traj_2/obs/observation/valid"][:] = True
        change(file["traj_2"])
    with pytest.raises(UserError, match=says):
        maniskill.read(tmp_path / "x.h5", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_what_lies_where_no_point_is_does_not_matter(tmp_path: Path, buffer: DemonstrationBuffer) -> None:
    import h5py

    maniskill.write(buffer, tmp_path / "x.h5")
    with h5py.File(tmp_path / "x.h5", "a") as file:
        observation = file["traj_0/obs/observation"]
        points = observation["points"][:]
        points[~observation["valid"][:]] = np.nan
        observation["points"][:] = points
    assert len(maniskill.read(tmp_path / "x.h5", tmp_path / "out")) == len(buffer)


def test_a_file_whose_table_names_no_episode_is_refused(tmp_path: Path, buffer: DemonstrationBuffer) -> None:
    maniskill.write(buffer, tmp_path / "x.h5")
    about = json.loads((tmp_path / "x.json").read_text())
    (tmp_path / "x.json").write_text(json.dumps({**about, "episodes": []}))
    with pytest.raises(UserError, match="names none of the episodes"):
        maniskill.read(tmp_path / "x.h5", tmp_path / "out")


def test_a_data_set_that_was_not_finished_is_refused(tmp_path: Path, buffer: DemonstrationBuffer) -> None:
    pytest.importorskip("pyarrow")
    lerobot.write(buffer, tmp_path / "y", rate=20)
    (tmp_path / "y" / "data" / "chunk-000" / "file-000.parquet").unlink()
    with pytest.raises(UserError, match="0 of its 20 frames"):
        lerobot.read(tmp_path / "y", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_whatever_is_wrong_with_a_data_set_is_one_sentence_and_leaves_nothing(
    tmp_path: Path, buffer: DemonstrationBuffer
) -> None:
    pytest.importorskip("pyarrow")
    out = tmp_path / "out"
    with pytest.raises(UserError, match="cannot be read"):
        lerobot.read(tmp_path / "nowhere", out)
    lerobot.write(buffer, tmp_path / "y", rate=20)
    with pytest.raises(UserError, match="exists already"):
        lerobot.write(buffer, tmp_path / "y", 20)
    data = tmp_path / "y" / "data" / "chunk-000" / "file-000.parquet"
    whole = data.read_bytes()
    data.write_bytes(whole[:1000])
    with pytest.raises(UserError, match="cannot be read"):
        lerobot.read(tmp_path / "y", out)
    data.write_bytes(whole)
    about = tmp_path / "y" / "meta" / "info.json"
    about.write_text(about.read_text().replace("v3.0", "v2.1"))
    with pytest.raises(UserError, match=r"v2\.1; convert"):
        lerobot.read(tmp_path / "y", out)
    assert not out.exists()


def test_without_pyarrow_it_says_what_to_install(
    tmp_path: Path, buffer: DemonstrationBuffer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(UserError, match="pip install pyarrow"):
        lerobot.write(buffer, tmp_path / "y", rate=20)
    with pytest.raises(UserError, match="pip install pyarrow"):
        lerobot.read(tmp_path / "y", tmp_path / "out")
