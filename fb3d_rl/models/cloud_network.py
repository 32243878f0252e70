"""What the networks of a cloud with a part mask share: one PointNet++, from a cloud's centre, and their files."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar, TypeVar

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from fb3d_rl.errors import UserError
from fb3d_rl.files import write_bytes
from fb3d_rl.models.delayed import DelayedPointNet2
from fb3d_rl.models.dense import initialize
from fb3d_rl.models.pointnet2 import PointNet2

Network = TypeVar("Network", bound="CloudNetwork")

BACKBONES: dict[str, type[PointNet2] | type[DelayedPointNet2]] = {"pointnet2": PointNet2, "delayed": DelayedPointNet2}


class CloudNetwork(nn.Module):
    """A PointNet++ that says ``OUTPUTS`` numbers about each point of a cloud.

    The network subtracts the mean of a cloud's valid points first and does not scale: its ball radii are
    metres. So its output does not change when the scene is moved, and it sees real sizes.

    Args:
        part_mask_input: feed the mask of the part to open as an input channel. Without it, the mask is
            ignored.
        neighbors: points kept in a ball. 64 is PointNet++'s; 32 is faster.
        backbone: "pointnet2", the paper's, or "delayed", which is several times as fast
            (:mod:`fb3d_rl.models.delayed`).
        generator: draws the first weights (on the CPU); None leaves them to torch's global generator.
    """

    NAME: ClassVar[str]
    """Of its files."""

    OUTPUTS: ClassVar[int]

    def __init__(
        self,
        part_mask_input: bool = True,
        neighbors: int = 64,
        backbone: str = "pointnet2",
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        self.part_mask_input = part_mask_input
        self.arguments: dict[str, bool | int | str] = {
            "part_mask_input": part_mask_input,
            "neighbors": neighbors,
            "backbone": backbone,
        }
        self.network = BACKBONES[backbone](inputs=int(part_mask_input), outputs=self.outputs(), neighbors=neighbors)
        self.add_layers()
        if generator is not None:
            initialize(self, generator)

    def outputs(self) -> int:
        """How many numbers the PointNet++ yields for each point."""
        return self.OUTPUTS

    def add_layers(self) -> None:
        """Make what a network has beside its PointNet++: nothing, here."""

    def per_point(self, points: Tensor, valid: Tensor, part_mask: Tensor | None) -> Tensor:
        """Points [B, N, 3] f32 (m, world axes), valid [B, N] bool and part_mask [B, N] bool, None where nobody marked a
        part -> [B, N, OUTPUTS]; 0 on invalid points.
        """
        features = None
        if self.part_mask_input:
            shown = valid if part_mask is None else part_mask  # as it was trained where there is none
            features = shown[..., None].to(points.dtype)
        output: Tensor = self.network(from_centre(points, valid), valid, features)
        return output

    def digest(self) -> str:
        """SHA-256 of weights and statistics."""
        return hashlib.sha256(save(self._tensors())).hexdigest()

    @classmethod
    def _format(cls) -> str:
        return f"fb3d_rl {cls.NAME} 1"

    def _tensors(self) -> dict[str, Tensor]:
        return {name: value.detach().cpu().contiguous() for name, value in self.state_dict().items()}

    def save_pretrained(self, path: str | Path, about: Mapping[str, str] | None = None) -> None:
        """Write weights and arguments as one safetensors file, in one step.

        Args:
            path: the file, .safetensors.
            about: further facts to keep in the file: command, data, seed, revision.
        """
        metadata = {"format": self._format(), "arguments": json.dumps(self.arguments), **(about or {})}
        write_bytes(Path(path), save(self._tensors(), metadata))

    @classmethod
    def from_pretrained(cls: type[Network], path: str | Path) -> Network:
        """The network of a file that :meth:`save_pretrained` wrote, in evaluation mode; no code in it is run.

        Args:
            path: the file.

        Raises:
            UserError: the file is missing, damaged, or holds something else.
        """
        file = Path(path)
        if not file.is_file():
            raise UserError(f"There are no weights at {file}: check the path.")
        try:
            with safe_open(file, framework="pt") as content:
                metadata = content.metadata() or {}
                if metadata.get("format") != cls._format():
                    raise UserError(f"{file} holds no {cls.__name__} of this version of fb3d_rl: choose another file.")
                tensors = {name: content.get_tensor(name) for name in content.keys()}
            net = cls(**json.loads(metadata["arguments"]))
            net.load_state_dict(tensors)
        except (SafetensorError, RuntimeError, ValueError, KeyError, TypeError) as error:
            raise UserError(
                f"{file} is damaged or holds no {cls.__name__} ({type(error).__name__}): fetch it anew."
            ) from error
        return net.eval()


def from_centre(points: Tensor, valid: Tensor) -> Tensor:
    """Points [B, N, 3] less the mean of a cloud's valid ones [B, N]."""
    inside = valid[..., None].to(points.dtype)
    # Padding may hold anything, even NaN, which a product with 0 would keep.
    points = points.masked_fill(~valid[..., None], 0.0)
    return points - points.sum(1, keepdim=True) / inside.sum(1, keepdim=True).clamp(min=1.0)
