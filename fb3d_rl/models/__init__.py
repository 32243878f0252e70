"""Networks: PointNet++ and ArtFlowNet."""
