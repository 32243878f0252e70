"""Policies: TensorDict in, TensorDict out; none of them knows the environment."""
