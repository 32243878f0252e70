"""A training step's loss and gradients as one launch on a GPU (CUDA graph), where some thousand small launches take
longer than what they compute.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from torch import Tensor

from fb3d_rl.models.cloud_network import CloudNetwork

WARM_UP = 3
"""Calls before the recording, in which libraries choose their kernels and take their memory."""


class GraphedLoss:
    """A loss that is recorded in its first call, with its gradients, and played back in every one.

    Args:
        model: on a GPU, with a backbone that can compute in fixed shapes. Its gradients are in place after each call.
            Its buffers change as they do without a graph.
        loss: of rows [B] that always have the same shapes, without a wait for the GPU.
    """

    def __init__(self, model: CloudNetwork, loss: Callable[[TensorDictBase], Tensor]) -> None:
        self._model, self._loss = model, loss
        self._graph = torch.cuda.CUDAGraph()
        self._rows: TensorDictBase | None = None
        self._value = torch.empty(())
        self._gradients: list[Tensor | None] = []

    def __call__(self, rows: TensorDictBase) -> Tensor:
        """The loss, without a graph of autograd: backward is done."""
        if self._rows is None:
            self._rows = rows.clone()
            self._model.network.fixed_shapes = True
            try:
                self._record(self._rows)
            finally:
                self._model.network.fixed_shapes = False
        self._rows.update_(rows)
        self._graph.replay()
        for weights, gradient in zip(self._model.parameters(), self._gradients, strict=True):
            weights.grad = gradient
        return self._value

    def _record(self, rows: TensorDictBase) -> None:
        before = [buffer.clone() for buffer in self._model.buffers()]
        beside = torch.cuda.Stream()
        beside.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(beside):
            for _ in range(WARM_UP):
                self._model.zero_grad(set_to_none=True)
                self._loss(rows).backward()
        torch.cuda.current_stream().wait_stream(beside)
        self._model.zero_grad(set_to_none=True)
        with torch.cuda.graph(self._graph):
            value = self._loss(rows)
            value.backward()
            self._value = value.detach()
        self._gradients = [weights.grad for weights in self._model.parameters()]
        for buffer, value in zip(self._model.buffers(), before, strict=True):
            buffer.copy_(value)
