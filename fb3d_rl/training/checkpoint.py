"""Checkpoints that describe themselves: a network runs from the file alone."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from fb3d_rl.errors import UserError
from fb3d_rl.files import replacing

FORMAT = "fb3d_rl checkpoint 1"

CONTENT = {"algo": str, "config": dict, "model_kwargs": dict, "state": dict, "step": int, "seed": int,
           "git_revision": str}  # fmt: skip
"""Entries of a checkpoint other than its format."""


def git_revision() -> str:
    """The commit of this source tree, with "+" if files were changed since; "unknown" outside a git
    checkout.
    """
    folder = Path(__file__).resolve().parents[2]
    if not (folder / ".git").exists():
        return "unknown"
    command = ["git", "-C", str(folder), "describe", "--always", "--abbrev=40", "--exclude=*", "--dirty=+"]
    try:
        answer = subprocess.run(command, capture_output=True, text=True, check=False)
    except FileNotFoundError:  # git is not installed
        return "unknown"
    return answer.stdout.strip() or "unknown"


def save_checkpoint(
    path: Path | str,
    *,
    algo: str,
    config: dict[str, Any],
    model_kwargs: dict[str, Any],
    state: dict[str, Any],
    seed: int,
) -> None:
    """Write a checkpoint so that a crash leaves the old file or the new one, never half of one.

    Args:
        path: the file; its folder is made.
        algo: which algorithm's checkpoint this is, such as "artflownet".
        config: the whole run's configuration, of plain numbers, strings, lists and dicts.
        model_kwargs: arguments that build the model.
        state: what training resumes from; state["model"] are the weights, state["step"] the steps done.
        seed: of the run.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    content = {
        "format": FORMAT,
        "algo": algo,
        "config": config,
        "model_kwargs": model_kwargs,
        "state": state,
        "step": state["step"],
        "seed": seed,
        "git_revision": git_revision(),
    }
    with replacing(path) as beside, beside.open("wb") as file:
        torch.save(content, file)
        file.flush()
        os.fsync(file.fileno())


def load_checkpoint(path: Path | str, algo: str | None = None, device: str = "cpu") -> dict[str, Any]:
    """Read a checkpoint; no code in it is run.

    Args:
        path: the file.
        algo: the algorithm that it must belong to; None for any.
        device: where its tensors go.

    Returns:
        {"format", "algo", "config", "model_kwargs", "state", "step", "seed", "git_revision"}.

    Raises:
        UserError: the file is missing, damaged, not a checkpoint of this project, or of another algorithm.
    """
    path = Path(path)
    if not path.is_file():
        raise UserError(f"There is no checkpoint at {path}: check the path or train first.")
    try:
        content = torch.load(path, map_location=device, weights_only=True)
    except Exception as error:  # noqa: BLE001, of a file that was cut torch may raise anything
        if isinstance(error, OSError) and error.filename is not None:  # the file cannot be read at all
            raise
        raise UserError(
            f"{path} is damaged or no checkpoint ({type(error).__name__}): copy it again or train again."
        ) from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise UserError(f"{path} is not a checkpoint of this version of fb3d_rl: train again.")
    for key, kind in CONTENT.items():
        if not isinstance(content.get(key), kind):
            raise UserError(f'{path} is damaged (it lacks "{key}"): copy it again or train again.')
    if algo is not None and content["algo"] != algo:
        raise UserError(f"{path} is a checkpoint of {content['algo']}, not of {algo}: choose another file.")
    return content


@contextmanager
def fitting(path: Path | str) -> Iterator[None]:
    """A context in which the content of the checkpoint at ``path`` is used; an error in it names the file.

    Raises:
        UserError: the content does not fit.
    """
    try:
        yield
    except (RuntimeError, LookupError, TypeError, ValueError, AttributeError) as error:
        raise UserError(
            f"{path} holds other weights or entries than this run needs ({type(error).__name__}): "
            "choose another file, copy it again or train again."
        ) from error
