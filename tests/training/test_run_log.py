from __future__ import annotations

import math
from pathlib import Path

import pytest

from fb3d_rl.errors import UserError
from fb3d_rl.training.run_log import RunLog, open_logger, read_rows


def test_rows_are_on_disk_at_once_and_times_can_be_left_out(tmp_path: Path) -> None:
    log = RunLog(tmp_path / "run")
    log.write({"step": 1, "train/loss": 0.5, "time/seconds": 2.0, "flow/cosine": math.nan})
    assert read_rows(log.path, times=False) == [{"step": 1, "train/loss": 0.5, "flow/cosine": None}]
    log.close()
    with RunLog(tmp_path / "run"):
        pass
    assert read_rows(log.path) == []


def test_resuming_drops_later_and_broken_rows(tmp_path: Path) -> None:
    with RunLog(tmp_path) as log:
        for step in range(1, 6):
            log.write({"step": step})
    with log.path.open("a") as file:
        file.write('{"step": 2, "trai')
    with RunLog(tmp_path, resume_step=3) as log:
        log.write({"step": 4, "again": True})
    assert read_rows(log.path) == [{"step": 1}, {"step": 2}, {"step": 3}, {"step": 4, "again": True}]


def test_a_logger_gets_every_number_by_step(tmp_path: Path) -> None:
    with RunLog(tmp_path, logger=open_logger("csv", "", tmp_path)) as log:
        log.write({"step": 3, "train/loss": 0.5, "note": "text", "flow/cosine": math.nan})
        log.write({"step": 4, "train/loss": 0.25})
    (scalars,) = (tmp_path / "csv").rglob("loss.csv")
    assert [line.split(",") for line in scalars.read_text().split()] == [["3", "0.5"], ["4", "0.25"]]
    assert len(list((tmp_path / "csv").rglob("*.csv"))) == 1
    assert open_logger("none", "", tmp_path) is None


def test_a_logger_whose_package_is_missing_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torchrl.record.loggers.tensorboard._has_tb", False)
    with pytest.raises(UserError, match="pip install tensorboard"):
        open_logger("tensorboard", "", tmp_path)
    assert not any(tmp_path.iterdir())
