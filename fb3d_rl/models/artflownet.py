"""ArtFlowNet: where each visible point of an articulated object would move (FlowBot3D, section IV-A;
supplement, II.A).
"""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from fb3d_rl.errors import UserError
from fb3d_rl.models.cloud_network import CloudNetwork
from fb3d_rl.places import folder

Cloud = TypeVar("Cloud", Tensor, NDArray[np.float32])

POINTS = 1200
"""Points of the clouds that networks are trained on (contract), so that balls hold as many as they did then."""

PRETRAINED = folder("pretrained") / "artflownet.safetensors"
"""The weights that this project publishes."""


class ArtFlowNet(CloudNetwork):
    """Predict 3D articulation flow with a PointNet++.

    Args: as of :class:`CloudNetwork`.

    Shapes:
        points [B, N, 3] f32, m, world axes; valid [B, N] bool; part_mask [B, N] bool -> flow [B, N, 3] f32,
        world axes, trained towards a largest norm of 1 in a cloud; 0 on invalid points. A network that was
        trained without part_mask does not read it.
    """

    NAME = "artflownet"
    OUTPUTS = 3

    def forward(self, points: Tensor, valid: Tensor, part_mask: Tensor | None = None) -> Tensor:
        """See the class."""
        return self.per_point(points, valid, part_mask)

    @torch.no_grad()
    def predict(self, points: Cloud, part_mask: Tensor | NDArray[np.bool_] | None = None) -> Cloud:
        """The flow of a cloud of any size, in evaluation mode.

        A cloud of more than 1200 points is dealt out at random (always alike) into clouds of at most as many, and each
        point's flow is the one that its own gets.

        Args:
            points: [N, 3] m, z up; an array or a tensor on any device. Points that are not finite count as missing.
            part_mask: [N] bool, the points on the part to open; needed if the network was trained with it.

        Returns:
            [N, 3] f32 of the kind of ``points``, on its device; largest norm about 1, 0 where a point is missing.

        Raises:
            UserError: a shape is another, or the mask is missing.
        """
        cloud = torch.as_tensor(points)
        if cloud.ndim != 2 or cloud.shape[1] != 3 or not cloud.is_floating_point():
            raise UserError(f"The cloud is {cloud.dtype} {list(cloud.shape)}: give floats [N, 3].")
        if part_mask is None and self.part_mask_input:
            raise UserError("This network was trained with the mask of the part to open: give part_mask, [N] bool.")
        count = len(cloud)
        mask = torch.zeros(count, dtype=torch.bool) if part_mask is None else torch.as_tensor(part_mask)
        if mask.shape != (count,):
            raise UserError(f"The mask is {list(mask.shape)} for {count} points: give [N] bool.")
        device = next(self.parameters()).device
        cloud, mask = cloud.to(device, torch.float32), mask.to(device, torch.bool)
        valid = cloud.isfinite().all(1)
        flow = torch.zeros_like(cloud)
        rows = valid.nonzero().flatten()
        if len(rows):
            clouds = -(-len(rows) // POINTS)
            size = -(-len(rows) // clouds)
            dealt = rows
            if clouds > 1:
                dealt = rows[torch.randperm(len(rows), generator=torch.Generator().manual_seed(0)).to(device)]
            # Filled up to whole clouds with padding.
            places = torch.nn.functional.pad(dealt, (0, clouds * size - len(rows))).view(clouds, size)
            real = torch.arange(clouds * size, device=device).view(clouds, size) < len(rows)
            training = self.training
            self.eval()
            try:
                found = self(cloud[places], real, mask[places] & real)
            finally:
                self.train(training)
            flow[places[real]] = found[real]
        if isinstance(points, Tensor):
            return flow.to(points.device)
        return flow.cpu().numpy()

    @classmethod
    def from_pretrained(cls, path: str | Path = "pretrained") -> ArtFlowNet:
        """As :meth:`CloudNetwork.from_pretrained`; "pretrained" is the network that this project publishes."""
        return super().from_pretrained(PRETRAINED if str(path) == "pretrained" else path)


def reads_mask(net: nn.Module) -> bool:
    """Whether a network was trained with the mask of the part to open; one that does not say so was."""
    return bool(getattr(net, "part_mask_input", True))


def artflownet_module(net: nn.Module) -> TensorDictModule:
    """Read the observation's points, valid and, if the network was trained with it, part_mask; write ("prediction",
    "flow"), what the network answers.
    """
    keys = [("observation", key) for key in ("points", "valid", *(["part_mask"] if reads_mask(net) else []))]
    return TensorDictModule(net, in_keys=keys, out_keys=[("prediction", "flow")])
