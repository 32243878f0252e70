"""A digest that identifies a policy: of its classes, options and weights."""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from fb3d_rl.options import came_later

LENGTH = 16
"""Hexadecimal digits of a digest."""

_PLAIN = (bool, int, float, str, bytes, type(None), Path, Enum, torch.dtype)


def policy_digest(policy: nn.Module) -> str:
    """The first :data:`LENGTH` digits of the SHA-256 of a policy's classes, options, weights and buffers.

    Options are the public attributes of a module and of those that it holds: plain values, dataclasses, and lists and
    dicts of these. Two policies that act differently through anything else, such as a function that they call or the
    version of this package, have the same digest.
    """
    digest = hashlib.sha256()
    seen: set[int] = set()

    def take(module: nn.Module) -> None:
        if id(module) in seen:
            return
        seen.add(id(module))
        hidden: list[nn.Module] = []
        options = {
            name: _described(value, hidden)
            for name, value in sorted(vars(module).items())
            if not name.startswith("_") and name != "training"
        }
        about = f"{type(module).__module__}.{type(module).__qualname__}"
        digest.update(json.dumps([about, options], sort_keys=True).encode())
        own = itertools.chain(module.named_parameters(recurse=False), module.named_buffers(recurse=False))
        for name, value in own:
            digest.update(f"{name} ".encode())
            _take_tensor(digest, value)
        for child in (*module.children(), *hidden):
            take(child)

    take(policy)
    return digest.hexdigest()[:LENGTH]


def _take_tensor(digest: Any, value: Tensor) -> None:
    plain = value.detach().cpu().contiguous()
    digest.update(f"{plain.dtype} {tuple(plain.shape)} ".encode())
    digest.update(plain.flatten().view(torch.uint8).numpy().tobytes() if plain.numel() else b"")


def _described(value: Any, hidden: list[nn.Module]) -> Any:
    """``value`` as JSON; modules go to ``hidden``; values without a lasting form are named by their type."""
    if isinstance(value, nn.Module):
        hidden.append(value)
        return "module"
    if isinstance(value, Tensor):
        digest = hashlib.sha256()
        _take_tensor(digest, value)
        return digest.hexdigest()
    if is_dataclass(value) and not isinstance(value, type):
        held = {
            item.name: _described(getattr(value, item.name), hidden)
            for item in fields(value)
            if not came_later(item, getattr(value, item.name))
        }
        return [type(value).__qualname__, held]
    if isinstance(value, Mapping):
        return [[_described(key, hidden), _described(item, hidden)] for key, item in value.items()]
    if isinstance(value, (list, tuple)):
        return [_described(item, hidden) for item in value]
    if isinstance(value, _PLAIN):
        return repr(value)
    return type(value).__qualname__
