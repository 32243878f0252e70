"""The buffer: what was committed is there, bit for bit, whatever happens; the rest is as if it had never been."""

from __future__ import annotations

import json
import multiprocessing
import os
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict, TensorDictBase

from fb3d_rl.camera.views import View
from fb3d_rl.data.demonstrations import TABLE, DemonstrationBuffer, EpisodeInfo
from fb3d_rl.errors import UserError

INFO = EpisodeInfo(
    object="é/1", category="Oven", link=2, start=(0.1, -0.2), view=View(12.5, 1 / 3), seed=2**40, round=1,
    success=True, normalized_distance=0.05, steps=9,
)  # fmt: skip


def frames(steps: int, seed: int) -> TensorDict:
    """Rows that no two seeds share."""
    rng = torch.Generator().manual_seed(seed)
    return TensorDict(
        {
            "observation": {
                "points": torch.randn(steps, 5, 3, generator=rng),
                "valid": torch.rand(steps, 5, generator=rng) > 0.5,
            },
            "expert": {"action": torch.randn(steps, 8, generator=rng)},
            "elapsed_steps": torch.arange(steps)[:, None],
        },
        batch_size=[steps],
    )


def fill(buffer: DemonstrationBuffer, lengths: list[int], first: int = 0) -> None:
    for seed, steps in enumerate(lengths, first):
        buffer.extend(frames(steps, seed), replace(INFO, seed=seed, steps=steps, success=seed % 2 == 0))


def same(a: TensorDictBase, b: TensorDictBase) -> bool:
    if {*a.keys(True, True)} != {*b.keys(True, True)}:
        return False
    return all(torch.equal(a[key], b[key]) and a[key].dtype == b[key].dtype for key in a.keys(True, True))


def holds(buffer: DemonstrationBuffer, lengths: list[int]) -> bool:
    """Whether the buffer is what :func:`fill` with these lengths makes."""
    return len(buffer) == sum(lengths) and all(
        buffer.episodes[e].seed == e
        and buffer.episodes[e].rows == steps
        and same(buffer.frames(e).exclude("episode"), frames(steps, e))
        and bool((buffer.frames(e)["episode"] == e).all())
        for e, steps in enumerate(lengths)
    )


def test_what_is_committed_comes_back(tmp_path: Path) -> None:
    buffer = DemonstrationBuffer.create(tmp_path / "b", 20, {"seed": 3})
    assert (len(buffer), buffer.episodes, buffer.keys) == (0, [], {})
    assert len(DemonstrationBuffer.open(tmp_path / "b")) == 0
    buffer.extend(frames(4, 0), INFO)
    buffer.commit()
    again = DemonstrationBuffer.open(tmp_path / "b")
    assert again.episodes == [replace(INFO, rows=4)] and again.about == {"seed": 3} and again.capacity == 20
    assert same(again.frames(0).exclude("episode"), frames(4, 0))
    assert same(again[torch.tensor([3, 1, 3])].exclude("episode"), frames(4, 0)[torch.tensor([3, 1, 3])])
    assert again.keys["observation", "valid"] == ((5,), torch.bool) and again.keys["episode"] == ((1,), torch.int64)


def test_it_grows_over_several_openings_up_to_its_capacity(tmp_path: Path) -> None:
    DemonstrationBuffer.create(tmp_path, 12)
    for k, lengths in enumerate(([3, 4], [1], [4])):
        buffer = DemonstrationBuffer.open(tmp_path)
        fill(buffer, lengths, first=(0, 2, 3)[k])
        buffer.commit()
    assert holds(DemonstrationBuffer.open(tmp_path), [3, 4, 1, 4])
    with pytest.raises(ValueError, match="12 of 12"):
        buffer.extend(frames(1, 9), INFO)
    assert holds(buffer, [3, 4, 1, 4]), "the refused row has replaced none"


def test_rows_are_copies_and_frames_are_left_alone(tmp_path: Path) -> None:
    buffer = DemonstrationBuffer.create(tmp_path, 4)
    given = frames(4, 0)
    buffer.extend(given, replace(INFO, seed=0))
    assert same(given, frames(4, 0))
    taken = buffer[[0, 1]]
    taken["expert", "action"].zero_()
    taken["expert", "action"] = torch.zeros(2, 8)
    assert holds(buffer, [4])
    for outside in (-5, 4):
        with pytest.raises(IndexError):
            buffer[[outside]]


def test_rows_of_another_layout_are_refused(tmp_path: Path) -> None:
    buffer = DemonstrationBuffer.create(tmp_path, 20)
    fill(buffer, [3])
    more = frames(3, 1).set("extra", torch.zeros(3, 1))
    for wrong in (more, frames(3, 1).exclude("elapsed_steps"), frames(3, 1).double()):
        with pytest.raises(ValueError, match="differ"):
            buffer.extend(wrong, INFO)
    assert holds(buffer, [3])


@pytest.mark.parametrize(("rows", "lengths"), [(0, []), (3, [3]), (5, [3, 2]), (8, [3, 4, 1])])
def test_truncate_goes_back(tmp_path: Path, rows: int, lengths: list[int]) -> None:
    buffer = DemonstrationBuffer.create(tmp_path, 30)
    fill(buffer, [3, 4])
    buffer.commit()
    fill(buffer, [5], first=2)
    buffer.truncate(rows)
    again = DemonstrationBuffer.open(tmp_path)
    for kept in (buffer, again):
        assert [info.rows for info in kept.episodes] == lengths and len(kept) == rows
        assert all(same(kept.frames(e).exclude("episode"), frames((3, 4, 5)[e], e)[:n]) for e, n in enumerate(lengths))
    with pytest.raises(ValueError, match="cannot be cut"):
        again.truncate(rows + 1)
    # A straight run and one that goes back end alike.
    if lengths in ([], [3]):
        fill(again, [3, 4, 5][len(lengths) :], first=len(lengths))
        assert holds(again, [3, 4, 5])


def test_rows_written_after_going_back_are_gone_unless_committed(tmp_path: Path) -> None:
    for rows, lengths in ((3, [3]), (0, [])):
        path = tmp_path / str(rows)
        fill(buffer := DemonstrationBuffer.create(path, 30), [3, 4])
        buffer.commit()
        buffer.truncate(rows)
        fill(buffer, [5], first=len(lengths))
        assert holds(buffer, [*lengths, 5])
        assert holds(DemonstrationBuffer.open(path), lengths)


def test_filter_copies_whole_episodes(tmp_path: Path) -> None:
    buffer = DemonstrationBuffer.create(tmp_path / "all", 30, {"seed": 3})
    fill(buffer, [3, 4, 5, 6])
    copy = buffer.filter(tmp_path / "some", lambda info: info.success, {"filter": "success"})
    again = DemonstrationBuffer.open(tmp_path / "some")
    assert copy.episodes == again.episodes == [buffer.episodes[0], buffer.episodes[2]]
    assert again.about == {"seed": 3, "filter": "success"} and len(again) == again.capacity == 8
    assert same(again.frames(1).exclude("episode"), frames(5, 2)) and bool((again.frames(1)["episode"] == 1).all())
    with pytest.raises(UserError, match="none of the 4 episodes"):
        buffer.filter(tmp_path / "none", lambda info: info.steps > 6)
    assert not (tmp_path / "none").exists()


def test_plain_torchrl_reads_the_folder(tmp_path: Path) -> None:
    from torchrl.data import LazyMemmapStorage

    fill(buffer := DemonstrationBuffer.create(tmp_path, 9), [3, 4])
    buffer.commit()
    storage = LazyMemmapStorage(9, scratch_dir=tmp_path)
    storage.loads(tmp_path)
    assert len(storage) == 7 and same(storage[:7], buffer[range(7)])


def test_the_disk_is_occupied_as_rows_are_added(tmp_path: Path) -> None:
    fill(buffer := DemonstrationBuffer.create(tmp_path, 1_000_000), [3])
    buffer.commit()
    sizes = [file.stat() for file in tmp_path.rglob("*.memmap")]
    assert sum(size.st_size for size in sizes) > 1e8 > 1e6 > sum(512 * size.st_blocks for size in sizes)


def test_a_full_disk_is_said_so_before_it_is_written_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fill(buffer := DemonstrationBuffer.create(tmp_path, 9), [3])
    monkeypatch.setattr("shutil.disk_usage", lambda path: type("Usage", (), {"free": 100}))
    with pytest.raises(UserError, match="no room"):
        fill(buffer, [4], first=1)
    assert holds(buffer, [3])


def test_whatever_is_wrong_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="there are no demonstrations at .*nowhere"):
        DemonstrationBuffer.open(tmp_path / "nowhere")
    fill(buffer := DemonstrationBuffer.create(tmp_path / "b", 9), [3])
    buffer.commit()
    with pytest.raises(UserError, match="exists already"):
        DemonstrationBuffer.create(tmp_path / "b", 9)
    table, points = tmp_path / "b" / TABLE, tmp_path / "b" / "observation" / "points.memmap"
    whole, size = table.read_text(), points.stat().st_size
    content = json.loads(whole)
    broken = [
        "",
        whole[: len(whole) // 2],
        "[]",
        json.dumps(content | {"format": "x"}),
        json.dumps({"format": content["format"]}),
    ]
    for text in [*broken, json.dumps(content | {"episodes": [{"object": "a"}]})]:
        table.write_text(text)
        with pytest.raises(UserError, match="damaged|no demonstrations of this version"):
            DemonstrationBuffer.open(tmp_path / "b")
    table.write_text(whole)
    os.truncate(points, size - 1)
    with pytest.raises(UserError, match="another size"):
        DemonstrationBuffer.open(tmp_path / "b")
    points.unlink()
    with pytest.raises(UserError, match=r"points\.memmap"):
        DemonstrationBuffer.open(tmp_path / "b")
    assert not points.exists(), "opening makes nothing"


def write_for_ever(path: Path, says: Connection) -> None:
    buffer = DemonstrationBuffer.create(path, 5000)
    for seed in range(1000):
        fill(buffer, [3 + seed % 3], first=seed)
        says.send(0)
        if seed % 3 == 2:
            buffer.commit()
            says.send(len(buffer.episodes))


@pytest.mark.parametrize("messages", [1, 2, 3, 4, 5, 6, 7, 8, 15, 16])
def test_a_killed_writer_leaves_its_last_commit(tmp_path: Path, messages: int) -> None:
    # Forked, which saves the seconds that the imports take.
    context = multiprocessing.get_context("fork")
    hears, says = context.Pipe(duplex=False)
    writer = context.Process(target=write_for_ever, args=(tmp_path / "b", says))
    writer.start()
    says.close()
    heard = [hears.recv() for _ in range(messages)]
    writer.kill()  # it has gone on meanwhile, to anywhere
    writer.join()
    while hears.poll():
        try:
            heard.append(hears.recv())
        except EOFError:
            break
    committed = max(heard)
    buffer = DemonstrationBuffer.open(tmp_path / "b")
    found = len(buffer.episodes)
    assert found in (committed, committed + 3), "a commit may have been done and not been told"
    assert holds(buffer, [3 + seed % 3 for seed in range(found)])
    fill(buffer, [7], first=found)  # and it goes on from there
    buffer.commit()
    assert holds(DemonstrationBuffer.open(tmp_path / "b"), [*(3 + seed % 3 for seed in range(found)), 7])
