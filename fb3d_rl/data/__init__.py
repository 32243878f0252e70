"""Flow samples: drawn from objects without a simulator, kept in TensorDict memory maps."""
