"""The training loop of ArtFlowNet, checkpoints and the run log."""
