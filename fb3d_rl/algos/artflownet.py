"""algo=artflownet: the paper's network."""

from __future__ import annotations

from fb3d_rl.algos.flow_network import FlowNetwork
from fb3d_rl.models.artflownet import ArtFlowNet

ALGORITHM = FlowNetwork(ArtFlowNet)
