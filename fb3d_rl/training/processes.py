"""One fit by several processes, as ``torchrun`` starts them: each computes a share of every batch."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path

import torch
from torch import distributed, nn

from fb3d_rl.errors import UserError

LONGEST_WAIT = timedelta(days=2)
"""The first process may draw clouds or collect labels for hours while the others wait."""


def started() -> int:
    """How many processes ``torchrun`` started; 1 without it."""
    return int(os.environ.get("WORLD_SIZE", "1"))


def rank_and_count() -> tuple[int, int]:
    """Number of this process among those that fit together, and how many there are: (0, 1) alone."""
    if not distributed.is_initialized():
        return 0, 1
    return distributed.get_rank(), distributed.get_world_size()


def wait_for_all() -> None:
    """Return when all processes have come here; at once if there is one."""
    if distributed.is_initialized():
        distributed.barrier()


def equal_share(batch_size: int) -> None:
    """Check that the processes can compute equal shares of a batch.

    Raises:
        UserError: they cannot.
    """
    processes = started()
    if batch_size % processes:
        raise UserError(
            f"algo.batch_size={batch_size} cannot be split equally among {processes} processes; give a multiple"
        )


def average_gradients(model: nn.Module) -> None:
    """Give each weight the mean of its gradients in all processes, in place; all of them must call it."""
    gradients = [weight.grad for weight in model.parameters() if weight.grad is not None]
    whole = torch.cat([gradient.flatten() for gradient in gradients])
    distributed.all_reduce(whole)
    whole /= distributed.get_world_size()
    for gradient, mean in zip(gradients, whole.split([gradient.numel() for gradient in gradients]), strict=True):
        gradient.copy_(mean.view_as(gradient))


@contextmanager
def joined(out: Path, fresh: bool) -> Iterator[Path]:
    """Join the processes that ``torchrun`` started; nothing happens without it.

    Args:
        out: the run folder that this process was given.
        fresh: it is new, so that processes other than the first may remove theirs.

    Yields:
        The first process's run folder.
    """
    if started() == 1:
        yield out
        return
    cuda = torch.cuda.is_available()
    if cuda:
        torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))
    distributed.init_process_group("nccl" if cuda else "gloo", timeout=LONGEST_WAIT)
    try:
        shared = [str(out.resolve())]
        distributed.broadcast_object_list(shared)
        if fresh and Path(shared[0]) != out.resolve():
            shutil.rmtree(out)
        yield Path(shared[0])
    finally:
        distributed.destroy_process_group()
