"""Demonstrations as ManiSkill's trajectory files, out and in: FILE.h5 and FILE.json as its RecordEpisode writes them.

``traj_<k>`` holds ``actions`` [T, 8], ``terminated``, ``truncated``, ``success`` [T] and below ``obs`` the groups that
the task's observation has ("observation", "privileged") with T + 1 moments. A buffer has no observation of the moment
after the last step: the last one is repeated there, which ManiSkill's loaders and ours leave out. All further
keys (the expert's label, who acted) are below ``fb3d_rl``, the table of the episodes is in the JSON file, so what is
read back equals what was written in every bit. Not kept: the buffer's capacity; there are no ``env_states``.

Files that RecordEpisode wrote of this package's task with ``obs_mode="pointcloud"`` can be read, too. Their actions
become the expert's labels; they do not name object and trial, so that their episodes cannot be run again.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase

from fb3d_rl.data.demonstrations import DemonstrationBuffer, EpisodeInfo, demonstrated, foreign_episode, new_buffer
from fb3d_rl.errors import UserError
from fb3d_rl.files import replacing, write_text

OWN = "fb3d_rl"
"""Group of a trajectory, and key in the JSON file, for facts that ManiSkill's format has no place for."""


def write(buffer: DemonstrationBuffer, path: Path) -> None:
    """Write all episodes to ``path`` (.h5) and the JSON file beside it.

    Args:
        buffer: the demonstrations; ManiSkill's fields get ``about["env_info"]`` and ``about["control_mode"]``.
        path: ends in ``.h5``.

    Raises:
        UserError: there is such a file, or h5py is not installed.
    """
    h5py = _h5py()
    if path.exists():
        raise UserError(f"{path} exists already; choose another file")
    path.parent.mkdir(parents=True, exist_ok=True)
    about = {
        "env_info": {"env_id": "unknown", "env_kwargs": {}, **(buffer.about.get("env_info") or {})},
        "source_type": "motionplanning",
        "source_desc": "recorded with fb3d_rl",
        "episodes": [_json_entry(k, info, buffer.about) for k, info in enumerate(buffer.episodes)],
        OWN: buffer.about,
    }
    with replacing(path) as beside:
        with h5py.File(beside, "w") as file:
            for k, info in enumerate(buffer.episodes):
                _write_episode(file.create_group(f"traj_{k}"), buffer.frames(k).exclude("episode"), info)
        write_text(path.with_suffix(".json"), json.dumps(about, indent=2) + "\n")


def read(path: Path, out: Path | str) -> DemonstrationBuffer:
    """Make a buffer at ``out`` of the trajectories in ``path`` (.h5).

    Raises:
        UserError: a file is missing or damaged, its observations are not the task's, there is something at ``out``, or
            h5py is not installed.
    """
    h5py = _h5py()
    try:
        about = json.loads(path.with_suffix(".json").read_text())
        with h5py.File(path, "r") as file:
            rows = sum(len(file[name]["actions"]) for name in file)
            with new_buffer(out, max(rows, 1), about.get(OWN, {"env_info": about.get("env_info")})) as buffer:
                for entry in about["episodes"]:
                    buffer.extend(*_read_episode(file[f"traj_{entry['episode_id']}"], entry))
                if rows and not len(buffer):
                    raise ValueError(f"{path.with_suffix('.json').name} names none of the episodes")
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise UserError(f"{path} cannot be read as trajectories of ManiSkill ({error})") from error
    return buffer


def _json_entry(k: int, info: EpisodeInfo, about: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "episode_id": k,
        "episode_seed": info.seed,
        "control_mode": about.get("control_mode"),
        "elapsed_steps": info.rows,
        "reset_kwargs": {},
        "success": info.success,
        OWN: asdict(info),
    }


def _write_episode(group: Any, frames: TensorDictBase, info: EpisodeInfo) -> None:
    last = np.zeros(len(frames), dtype=bool)
    last[-1] = info.rows == info.steps
    group["actions"] = frames["action"].numpy()
    group["success"] = group["terminated"] = last & info.success
    group["truncated"] = last & (not info.success)
    for key in frames.keys(include_nested=True, leaves_only=True):
        value: NDArray[Any] = frames.get(key).numpy()
        names = key if isinstance(key, tuple) else (key,)
        if names[0] in ("observation", "privileged"):
            group["/".join(("obs", *names))] = np.concatenate([value, value[-1:]])
        elif key != "action":
            group["/".join((OWN, *names))] = value


def _read_episode(group: Any, entry: Mapping[str, Any]) -> tuple[TensorDictBase, EpisodeInfo]:
    steps = len(group["actions"])
    frames: TensorDictBase = TensorDict({"action": torch.from_numpy(group["actions"][:])}, batch_size=[steps])
    _read_group(frames, group["obs"], ())
    if OWN in group:
        _read_group(frames, group[OWN], ())
    frames = demonstrated(frames)
    if OWN in entry:
        return frames, EpisodeInfo.from_dict(entry[OWN])
    success = "success" in group and bool(group["success"][-1])
    return frames, foreign_episode("unknown", success, steps)


def _read_group(frames: TensorDictBase, group: Any, names: tuple[str, ...]) -> None:
    if not hasattr(group, "items"):
        raise ValueError('its observations are flat; record them with obs_mode="pointcloud"')
    for name, item in group.items():
        if hasattr(item, "items"):
            _read_group(frames, item, (*names, name))
        else:
            value = torch.from_numpy(item[: len(frames)])
            if len(value) < len(frames):
                raise ValueError(f"{'/'.join((*names, name))} has {len(value)} rows for {len(frames)} actions")
            frames[(*names, name)] = value if value.ndim > 1 else value[:, None]


def _h5py() -> Any:
    try:
        import h5py
    except ImportError as error:
        raise UserError("ManiSkill's trajectory files need h5py; install it: pip install h5py") from error
    return h5py
