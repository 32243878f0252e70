from __future__ import annotations

import math
from pathlib import Path

from fb3d_rl.training.run_log import RunLog, read_rows


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
