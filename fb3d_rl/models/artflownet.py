"""ArtFlowNet: where each visible point of an articulated object would move (FlowBot3D, section IV-A;
supplement, II.A).
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from fb3d_rl.contract import UserError
from fb3d_rl.files import write_bytes
from fb3d_rl.models.delayed import DelayedPointNet2
from fb3d_rl.models.dense import initialize
from fb3d_rl.models.pointnet2 import PointNet2

Cloud = TypeVar("Cloud", Tensor, NDArray[np.float32])

POINTS = 1200
"""Points of the clouds that networks are trained on (contract), so that balls hold as many as they did then."""

FORMAT = "fb3d_rl artflownet 1"

BACKBONES: dict[str, type[PointNet2] | type[DelayedPointNet2]] = {"pointnet2": PointNet2, "delayed": DelayedPointNet2}

PRETRAINED = Path(__file__).resolve().parents[2] / "results" / "pretrained" / "artflownet.safetensors"
"""The weights that this project publishes."""


class ArtFlowNet(nn.Module):
    """Predict 3D articulation flow with a PointNet++.

    The network subtracts the mean of a cloud's valid points first and does not scale: its ball radii are
    metres. So its output does not change when the scene is moved, and it sees real sizes.

    Args:
        part_mask_input: feed the mask of the part to open as an input channel. Without it, the mask is
            ignored.
        neighbors: points kept in a ball. 64 is PointNet++'s; 32 is faster.
        backbone: "pointnet2", the paper's, or "delayed", which is several times as fast
            (:mod:`fb3d_rl.models.delayed`).
        generator: draws the first weights (on the CPU); None leaves them to torch's global generator.

    Shapes:
        points [B, N, 3] f32, m, world axes; valid [B, N] bool; part_mask [B, N] bool -> flow [B, N, 3] f32,
        world axes, trained towards a largest norm of 1 in a cloud; 0 on invalid points.
    """

    def __init__(
        self,
        part_mask_input: bool = True,
        neighbors: int = 64,
        backbone: str = "pointnet2",
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        self.part_mask_input = part_mask_input
        self.arguments = {"part_mask_input": part_mask_input, "neighbors": neighbors, "backbone": backbone}
        self.network = BACKBONES[backbone](inputs=int(part_mask_input), outputs=3, neighbors=neighbors)
        if generator is not None:
            initialize(self.network, generator)

    def forward(self, points: Tensor, valid: Tensor, part_mask: Tensor) -> Tensor:
        """See the class."""
        inside = valid[..., None].to(points.dtype)
        # Padding may hold anything, even NaN, which a product with 0 would keep.
        points = points.masked_fill(~valid[..., None], 0.0)
        centre = points.sum(1, keepdim=True) / inside.sum(1, keepdim=True).clamp(min=1.0)
        features = part_mask[..., None].to(points.dtype) if self.part_mask_input else None
        return self.network(points - centre, valid, features)

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

    def digest(self) -> str:
        """SHA-256 of weights and statistics."""
        return hashlib.sha256(save(self._tensors())).hexdigest()

    def _tensors(self) -> dict[str, Tensor]:
        return {name: value.detach().cpu().contiguous() for name, value in self.state_dict().items()}

    def save_pretrained(self, path: str | Path, about: Mapping[str, str] | None = None) -> None:
        """Write weights and arguments as one safetensors file, in one step.

        Args:
            path: the file, .safetensors.
            about: further facts to keep in the file: command, data, seed, revision.
        """
        metadata = {"format": FORMAT, "arguments": json.dumps(self.arguments), **(about or {})}
        write_bytes(Path(path), save(self._tensors(), metadata))

    @classmethod
    def from_pretrained(cls, path: str | Path = "pretrained") -> ArtFlowNet:
        """The network of a file that :meth:`save_pretrained` wrote, in evaluation mode; no code in it is run.

        Args:
            path: the file; "pretrained" is the one that this project publishes.

        Raises:
            UserError: the file is missing, damaged, or holds something else.
        """
        file = PRETRAINED if str(path) == "pretrained" else Path(path)
        if not file.is_file():
            raise UserError(f"There are no weights at {file}: check the path.")
        try:
            with safe_open(file, framework="pt") as content:
                metadata = content.metadata() or {}
                if metadata.get("format") != FORMAT:
                    raise UserError(f"{file} holds no ArtFlowNet of this version of fb3d_rl: choose another file.")
                tensors = {name: content.get_tensor(name) for name in content.keys()}
            net = cls(**json.loads(metadata["arguments"]))
            net.load_state_dict(tensors)
        except (SafetensorError, RuntimeError, ValueError, KeyError, TypeError) as error:
            raise UserError(
                f"{file} is damaged or holds no ArtFlowNet ({type(error).__name__}): fetch it anew."
            ) from error
        return net.eval()


def artflownet_module(net: ArtFlowNet) -> TensorDictModule:
    """Read the observation's points, valid and part_mask; write ("prediction", "flow")."""
    keys = [("observation", "points"), ("observation", "valid"), ("observation", "part_mask")]
    return TensorDictModule(net, in_keys=keys, out_keys=[("prediction", "flow")])
