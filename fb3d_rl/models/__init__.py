"""Networks: PointNet++, ArtFlowNet and those of the baselines."""
