"""The modes, simulators and renderers that a task can run with; a missing one is an error before any work."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import sapien
import torch
from mani_skill.envs.utils.system.backend import render_backend_name_mapping, sim_backend_name_mapping

from fb3d_rl.camera.sapien import require_renderer
from fb3d_rl.errors import UserError


def require_mode(name: str, word: str | None, known: Sequence[str]) -> None:
    """Check one of the task's modes; None is its default.

    Raises:
        UserError: the task knows no such mode.
    """
    if word not in (None, *known):
        raise UserError(f"{name}={word!r} is unknown to this task; choose from {', '.join(known)}")


def choose_renderer(word: str | None, obs_mode: str | None, render_mode: str | None, camera: str) -> str:
    """ManiSkill's ``render_backend``: the one that is asked for, or the best there is where one is needed.

    Args:
        word: the backend that is asked for.
        obs_mode: the task's.
        render_mode: the task's.
        camera: kind of the depth camera; "sapien" alone renders.

    Raises:
        UserError: there is no such backend, or it does not render here.
    """
    needs = {
        "camera.kind=sapien": camera == "sapien",
        "obs_mode=rgbd": obs_mode == "rgbd",
        f"render_mode={render_mode}": render_mode not in (None, "rgb_array"),
    }
    need = next((name for name, needed in needs.items() if needed), None)
    if word in (None, "none"):
        if need is None:
            return "none"
        if word is not None:
            raise UserError(f"{need} needs a renderer, but render_backend is 'none'; leave one of them out")
        return require_renderer(need, f"leave out {need}")
    device = _device(render_backend_name_mapping, "render_backend", word)
    return require_renderer(f"render_backend={word}", "leave it out: pictures are then drawn without", [(word, device)])


def choose_simulator(word: str, num_envs: int) -> str:
    """ManiSkill's ``sim_backend`` for so many environments.

    Raises:
        UserError: there is no such backend, or it is not here.
    """
    if num_envs < 1:
        raise UserError(f"num_envs={num_envs} is too small; give 1 or more")
    chosen = ("gpu" if num_envs > 1 else "cpu") if word == "auto" else word
    device = _device({"auto": "", **sim_backend_name_mapping}, "sim_backend", chosen)
    if device == "cpu":
        if num_envs > 1:
            raise UserError(
                f"num_envs={num_envs} needs CUDA, and sim_backend={word} runs one environment in a process; give "
                "num_envs=1, or run several processes (gymnasium.vector.AsyncVectorEnv, collector=process)"
            )
        return chosen
    try:
        sapien.Device(device)
        if not torch.cuda.is_available():
            raise RuntimeError("torch finds no CUDA device")
    except RuntimeError as error:
        asks = f"num_envs={num_envs}" if word == "auto" else f"sim_backend={word}"
        raise UserError(
            f"{asks} needs a CUDA device, which is not there ({error}); give num_envs=1 and sim_backend=cpu, and for "
            "more environments run several processes (gymnasium.vector.AsyncVectorEnv, collector=process)"
        ) from error
    return chosen


def _device(known: Mapping[str, str], key: str, word: str) -> str:
    """SAPIEN's name of the device that a backend's name means, such as "cuda:1" for "gpu:1".

    Raises:
        UserError: there is no such backend.
    """
    name, _, number = word.partition(":")
    if name == "pci":  # ManiSkill hands it to SAPIEN
        return word
    if name not in known or (number and not number.isdigit()):
        raise UserError(f"{key}={word!r} is unknown; choose from {', '.join(known)}")
    kind = "cpu" if known[name].endswith("cpu") else "cuda"
    return f"{kind}:{number}" if number else kind
