"""Where a network is trained: precision, compiler, and the memory of a CPU or GPU."""

from __future__ import annotations

import ctypes
import sys
from typing import Any, Protocol, cast

import torch

from fb3d_rl.errors import UserError
from fb3d_rl.training.options import FitOptions


class Rows(Protocol):
    """Stored rows: a TensorDict [R], TorchRL's replay buffer, or anything else that is indexed by row numbers."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: Any, /) -> Any: ...


def require_compiler(device: torch.device) -> None:
    """Check that torch.compile can work.

    Raises:
        UserError: it cannot, since there is no compiler.
    """
    try:
        torch.compile(torch.neg)(torch.ones(2, device=device))
    except RuntimeError as error:
        reason = str(error).strip().splitlines()[0]
        raise UserError(
            f"torch.compile does not work here ({reason}): install a C++ compiler (on a GPU: Triton), or leave it off"
        ) from error


def emulates_bf16(device: torch.device) -> bool:
    """Whether ``device`` is an x86 processor without AVX-512, where bfloat16 products take several times fp32's."""
    return device.type == "cpu" and torch.backends.cpu.get_cpu_capability() == "AVX2"


def products_of(options: FitOptions, device: torch.device) -> torch.autocast:
    """The context in which a network's products have the precision of the options."""
    return torch.autocast(device.type, torch.bfloat16, enabled=options.precision == "bf16")


def resident(rows: Rows, device: torch.device | str, room: int, chunk: int = 1024) -> Rows:
    """The rows in the memory of ``device``, so that a step needs no copy from the host; unchanged if they take
    more than ``room`` bytes.
    """
    one = rows[torch.arange(1)]
    if len(rows) * one.bytes() > room:
        return rows
    copy = one.to(device).new_empty(len(rows))
    for numbers in torch.arange(len(rows)).split(chunk):
        copy[numbers] = rows[numbers].to(device)
    return cast(Rows, copy)


def tune_cpu() -> None:
    """Two process-wide settings without which training on a CPU is up to three times slower.

    Gradients shrink into denormal floats as training converges, which CPUs handle in microcode: flush them to
    0. And glibc hands every large freed block back to the system, which then clears each page of the next
    one: keep them.
    """
    torch.set_flush_denormal(True)
    if sys.platform == "linux":
        mallopt = getattr(ctypes.CDLL(None), "mallopt", None)  # glibc only
        if mallopt is not None:
            m_trim_threshold, m_mmap_max = -1, -4  # malloc.h
            mallopt(m_mmap_max, 0)
            mallopt(m_trim_threshold, 2**31 - 1)
