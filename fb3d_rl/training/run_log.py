"""A run's numbers: metrics.jsonl, one JSON object a line, and one of TorchRL's loggers if the user wants it."""

from __future__ import annotations

import json
import math
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

from fb3d_rl.errors import UserError
from fb3d_rl.files import write_text

if TYPE_CHECKING:
    from torchrl.record.loggers import Logger

FILE_NAME = "metrics.jsonl"
TIME_PREFIX = "time/"
"""Keys that start so hold timings and differ between two runs of one seed."""


class RunLog:
    """Append rows to metrics.jsonl in a run's folder; each is on disk when ``write`` returns.

    Args:
        out_dir: the run's folder; made if it is missing.
        resume_step: keep the rows up to this step, drop later ones, which a resumed run writes again. None
            starts an empty file.
        resume_rows: keep this many rows instead.
        logger: gets the numbers too, by step.

    Attributes:
        rows: how many rows there are.
    """

    def __init__(
        self,
        out_dir: Path | str,
        resume_step: int | None = None,
        resume_rows: int | None = None,
        logger: Logger | None = None,
    ) -> None:
        folder = Path(out_dir)
        folder.mkdir(parents=True, exist_ok=True)
        self.path = folder / FILE_NAME
        kept = []
        if resume_step is not None and self.path.exists():
            kept = [row for row in read_rows(self.path) if row.get("step", 0) <= resume_step]
        if resume_rows is not None and self.path.exists():
            kept = read_rows(self.path)[:resume_rows]
        self.rows = len(kept)
        write_text(self.path, "".join(json.dumps(row) + "\n" for row in kept))
        self._file = self.path.open("a", encoding="utf-8")
        self._logger = logger

    def write(self, row: dict[str, Any]) -> None:
        """Append one row. JSON has no nan or infinity: they become null."""
        plain = {
            key: None if isinstance(value, float) and not math.isfinite(value) else value for key, value in row.items()
        }
        self._file.write(json.dumps(plain) + "\n")
        self._file.flush()
        self.rows += 1
        if self._logger is not None:
            for key, value in plain.items():
                if key != "step" and isinstance(value, (int, float)):
                    self._logger.log_scalar(key, float(value), step=row.get("step"))

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> RunLog:
        """Use as a context that closes the file."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the file."""
        self.close()


def open_logger(name: str, project: str, out: Path) -> Logger | None:
    """TorchRL's logger of this name, which writes below ``out``/name; None for "none".

    Args:
        name: "none", "csv", "tensorboard" or "wandb".
        project: of Weights & Biases.
        out: the run's folder.

    Raises:
        UserError: its package is not installed.
    """
    if name == "none":
        return None
    from torchrl.record.loggers import get_logger

    kwargs = {"wandb_kwargs": {"project": project}} if name == "wandb" else {}
    (out / name).mkdir(parents=True, exist_ok=True)
    try:
        return get_logger(name, logger_name=str(out / name), experiment_name=out.name, **kwargs)
    except ImportError as error:
        (out / name).rmdir()
        raise UserError(f"logger={name} needs a package that is not installed: pip install {name}") from error


def read_rows(path: Path | str, times: bool = True) -> list[dict[str, Any]]:
    """Rows of a metrics.jsonl; ``times=False`` leaves timings out. A last line cut short by a crash is
    dropped.
    """
    text = Path(path).read_text(encoding="utf-8")
    complete = text[: text.rfind("\n") + 1]
    rows = [json.loads(line) for line in complete.splitlines()]
    if times:
        return rows
    return [{key: value for key, value in row.items() if not key.startswith(TIME_PREFIX)} for row in rows]
