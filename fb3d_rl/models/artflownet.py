"""ArtFlowNet: where each visible point of an articulated object would move (FlowBot3D, section IV-A;
supplement, II.A).
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple, TypeGuard, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from fb3d_rl.errors import UserError
from fb3d_rl.models.cloud_network import CloudNetwork
from fb3d_rl.perception.arrays import as_mask, as_points, draw, near_origin, nearest
from fb3d_rl.places import folder

Cloud = TypeVar("Cloud", Tensor, NDArray[np.float32])

POINTS = 1200
"""Points of the clouds that networks are trained on (contract), so that balls hold as many as they did then."""

LARGEST = 16 * POINTS
"""Points of the largest cloud of which each gets a flow of its own, as many as a depth image of 160 x 120 has."""

PRETRAINED = folder("pretrained") / "artflownet.safetensors"
"""The weights that this project publishes."""


class Hypotheses(NamedTuple):
    """K possible flows of each cloud, since sight alone does not tell which way a closed lid or a lever goes.

    Attributes:
        flows: [B, K, N, 3] f32, world axes; 0 on invalid points.
        log_probabilities: [B, K, N] f32, of the hypotheses at each point; their exponentials add up to 1 over K.
    """

    flows: Tensor
    log_probabilities: Tensor

    def of_clouds(self, points: Tensor) -> Tensor:
        """Probabilities [B, K] of the hypotheses for ``points`` [B, N] (bool) as a whole, such as those of a part.

        All points of a part move by one hypothesis: its log-probability is the mean of theirs, up to a constant.
        """
        count = points.sum(1).clamp(min=1)[:, None]
        return (self.log_probabilities.masked_fill(~points[:, None], 0.0).sum(2) / count).softmax(1)


class ArtFlowNet(CloudNetwork):
    """Predict 3D articulation flow with a PointNet++.

    Args:
        part_mask_input: as of :class:`CloudNetwork`, and so the next three.
        neighbors: points kept in a ball.
        backbone: "pointnet2" or "delayed".
        generator: draws the first weights.
        hypotheses: K, how many flows it proposes for each cloud, each with a probability; with 1 it is the paper's.
        mask_optional: whether it was trained on clouds without a mask, too, so that the mask may be left out.

    Shapes:
        points [B, N, 3] f32, m, world axes; valid [B, N] bool; part_mask [B, N] bool -> flow [B, N, 3] f32,
        world axes, trained towards a largest norm of 1 in a cloud; 0 on invalid points. A network that was
        trained without part_mask does not read it. With several hypotheses it is the most probable one: of the part if
        the network is given the mask, else of each point.
    """

    NAME = "artflownet"
    OUTPUTS = 3

    def __init__(
        self,
        part_mask_input: bool = True,
        neighbors: int = 64,
        backbone: str = "pointnet2",
        generator: torch.Generator | None = None,
        hypotheses: int = 1,
        mask_optional: bool = False,
    ) -> None:
        self.hypotheses = hypotheses
        super().__init__(part_mask_input, neighbors, backbone, generator)
        self.mask_optional = mask_optional or not part_mask_input
        self.arguments |= {"hypotheses": hypotheses, "mask_optional": self.mask_optional}

    def outputs(self) -> int:
        """Of each hypothesis a flow, and a score if there are several."""
        return self.OUTPUTS if self.hypotheses == 1 else (self.OUTPUTS + 1) * self.hypotheses

    def forward(
        self, points: Tensor, valid: Tensor, part_mask: Tensor | None = None, propose: bool = False
    ) -> Tensor | Hypotheses:
        """See the class; with ``propose`` all hypotheses."""
        found = self.propose(points, valid, part_mask)
        return found if propose else self.most_probable(found, valid, part_mask)

    def propose(self, points: Tensor, valid: Tensor, part_mask: Tensor | None = None) -> Hypotheses:
        """All hypotheses for clouds as of the class."""
        return self.hypotheses_of(self.per_point(points, valid, part_mask))

    def hypotheses_of(self, output: Tensor) -> Hypotheses:
        """What :meth:`per_point` yields [B, N, outputs], read as hypotheses."""
        if self.hypotheses == 1:
            return Hypotheses(output[:, None], torch.zeros_like(output[:, None, :, 0]))
        flows, scores = output.split([self.OUTPUTS * self.hypotheses, self.hypotheses], 2)
        flows = flows.unflatten(2, (self.hypotheses, self.OUTPUTS)).transpose(1, 2)
        return Hypotheses(flows, scores.float().log_softmax(2).transpose(1, 2))

    def most_probable(self, found: Hypotheses, valid: Tensor, part_mask: Tensor | None) -> Tensor:
        """The flow [B, N, 3] of the most probable hypothesis, see the class."""
        if self.hypotheses == 1:
            return found.flows[:, 0]
        if self.part_mask_input and part_mask is not None:
            best = found.of_clouds(part_mask & valid).argmax(1)[:, None].expand_as(valid)
        else:
            best = found.log_probabilities.argmax(1)
        places = best[:, None, :, None].expand(-1, 1, -1, self.OUTPUTS)
        return found.flows.gather(1, places).squeeze(1)

    @torch.no_grad()
    def predict(self, points: Cloud, part_mask: object = None) -> Cloud:
        """The flow of a cloud of any size, in evaluation mode; of several hypotheses the most probable.

        A cloud of more than 1200 points is dealt out at random (always alike) into clouds of at most as many, and each
        point's flow is the one that its own gets. Of more than 19,200 points (:data:`LARGEST`) as many are drawn
        (always alike), and each other point's flow is that of the nearest of them on its side of the mask.

        Args:
            points: [N, 3] m, z up: an array of any kind of numbers, strides and byte order, a structured array with
                x, y and z, nested lists, or a tensor on any device. Points that are not finite count as missing, and
                so do those that are a thousand times as far away as the others (``near_origin``).
            part_mask: [N], the points on the part to open; needed if the network was trained with nothing else.
                bool, 0 and 1, one id with -1 for the rest, or scores from 0 to 1
                (:func:`~fb3d_rl.perception.arrays.as_mask`).

        Returns:
            [N, 3] f32: a tensor on the device of ``points`` if that is one, else an array; largest norm about 1, 0
            where a point is missing.

        Raises:
            UserError: a shape is another, the mask is missing, or one of the two holds something else.
        """
        cloud, mask = self._checked(points, part_mask)
        flows, log_probabilities = self._spread(cloud, mask)
        valid = cloud.isfinite().all(1)
        shown = None if part_mask is None else mask[None]
        flow = self.most_probable(Hypotheses(flows[None], log_probabilities[None]), valid[None], shown)
        return _as_given(flow[0], points)

    @torch.no_grad()
    def predict_all(self, points: Cloud, part_mask: object = None) -> tuple[Cloud, Cloud]:
        """All hypotheses for a cloud of any size, the most probable first.

        Args:
            points: as of :meth:`predict`.
            part_mask: as of :meth:`predict`. With a mask the probabilities are those of the marked part, else of all
                points that are predicted to move (flow above a tenth).

        Returns:
            Flows [K, N, 3] and their probabilities [K], which add up to 1.

        Raises:
            UserError: as :meth:`predict`.
        """
        cloud, mask = self._checked(points, part_mask)
        flows, log_probabilities = self._spread(cloud, mask)
        about = mask if part_mask is not None else (flows.norm(dim=2) > 0.1).any(0)
        about = about & cloud.isfinite().all(1)
        probabilities = Hypotheses(flows[None], log_probabilities[None]).of_clouds(about[None])[0]
        order = probabilities.argsort(descending=True, stable=True)
        return _as_given(flows[order], points), _as_given(probabilities[order], points)

    def _checked(self, points: object, part_mask: object) -> tuple[Tensor, Tensor]:
        """The cloud [N, 3] f32, NaN where a point is missing, and the mask [N] on the network's device."""
        cloud = as_points(points)
        if part_mask is None and needs_mask(self):
            raise UserError("This network was trained with the mask of the part to open: give part_mask, [N] bool.")
        mask = torch.ones(len(cloud), dtype=torch.bool) if part_mask is None else as_mask(part_mask, len(cloud))
        cloud, _ = near_origin(cloud)
        device = next(self.parameters()).device
        return cloud.to(device), mask.to(device)

    def _spread(self, cloud: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        """As :meth:`_dealt`, of a cloud of more than LARGEST points by way of as many of them."""
        valid = cloud.isfinite().all(1)
        rows = valid.nonzero().flatten()
        if len(rows) <= LARGEST:
            return self._dealt(cloud, mask)
        drawn = draw(len(rows), LARGEST).to(cloud.device)
        kept = rows[drawn]
        found = self._dealt(cloud[kept], mask[kept])
        near = nearest(cloud[rows], cloud[kept], mask[rows], mask[kept]).to(cloud.device)
        near[drawn] = torch.arange(LARGEST, device=cloud.device)
        flows = cloud.new_zeros(self.hypotheses, len(cloud), 3)
        log_probabilities = cloud.new_full((self.hypotheses, len(cloud)), -math.log(self.hypotheses))
        flows[:, rows], log_probabilities[:, rows] = (x[:, near] for x in found)
        return flows, log_probabilities

    def _dealt(self, cloud: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        """Flows [K, N, 3] and log-probabilities [K, N] of a cloud of any size, dealt out into clouds of POINTS."""
        valid = cloud.isfinite().all(1)
        flows = cloud.new_zeros(self.hypotheses, len(cloud), 3)
        log_probabilities = cloud.new_full((self.hypotheses, len(cloud)), -math.log(self.hypotheses))
        rows = valid.nonzero().flatten()
        if not len(rows):
            return flows, log_probabilities
        clouds = -(-len(rows) // POINTS)
        size = -(-len(rows) // clouds)
        dealt = rows
        if clouds > 1:
            dealt = rows[torch.randperm(len(rows), generator=torch.Generator().manual_seed(0)).to(cloud.device)]
        # Filled up to whole clouds with padding.
        places = torch.nn.functional.pad(dealt, (0, clouds * size - len(rows))).view(clouds, size)
        real = torch.arange(clouds * size, device=cloud.device).view(clouds, size) < len(rows)
        training = self.training
        self.eval()
        try:
            found = self.propose(cloud[places], real, mask[places] & real)
        finally:
            self.train(training)
        flows[:, places[real]] = found.flows.transpose(0, 1)[:, real]
        log_probabilities[:, places[real]] = found.log_probabilities.transpose(0, 1)[:, real]
        return flows, log_probabilities

    @classmethod
    def from_pretrained(cls, path: str | Path = "pretrained") -> ArtFlowNet:
        """As :meth:`CloudNetwork.from_pretrained`; "pretrained" is the network that this project publishes."""
        return super().from_pretrained(PRETRAINED if str(path) == "pretrained" else path)


def _as_given(found: Tensor, points: Cloud) -> Cloud:
    """``found`` of the kind of ``points``, and on its device."""
    if isinstance(points, Tensor):
        return found.to(points.device)
    return found.cpu().numpy()


def reads_mask(net: nn.Module) -> bool:
    """Whether a network was trained with the mask of the part to open; one that does not say so was."""
    return bool(getattr(net, "part_mask_input", True))


def needs_mask(net: nn.Module) -> bool:
    """Whether a network cannot do without the mask of the part to open."""
    return reads_mask(net) and not getattr(net, "mask_optional", False)


def proposes_several(net: nn.Module) -> TypeGuard[ArtFlowNet]:
    """Whether a network proposes several flows for each cloud."""
    return isinstance(net, ArtFlowNet) and net.hypotheses > 1


def artflownet_module(net: nn.Module, proposals: bool = False, masked: bool = True) -> TensorDictModule:
    """Read the observation's points, valid and, if the network was trained with it, part_mask; write ("prediction",
    "flow"), what the network answers; of several hypotheses the most probable.

    Args:
        net: the network.
        proposals: whether all hypotheses are written, too, if there are several: ("prediction", "flows") [B, K, N, 3]
            and ("prediction", "log_probabilities") [B, K, N].
        masked: whether a network that reads the mask is given it; one with ``mask_optional`` does without.
    """
    mask = ["part_mask"] if masked and reads_mask(net) else []
    keys = [("observation", key) for key in ("points", "valid", *mask)]
    module, names = net, ["flow"]
    if proposals and proposes_several(net):
        module, names = _Proposals(net), ["flow", "flows", "log_probabilities"]
    return TensorDictModule(module, in_keys=keys, out_keys=[("prediction", name) for name in names])


class _Proposals(nn.Module):
    """An :class:`ArtFlowNet` that answers with its most probable flow and all its hypotheses."""

    def __init__(self, net: ArtFlowNet) -> None:
        super().__init__()
        self.net = net

    def forward(self, points: Tensor, valid: Tensor, part_mask: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
        found = self.net.propose(points, valid, part_mask)
        return self.net.most_probable(found, valid, part_mask), found.flows, found.log_probabilities
