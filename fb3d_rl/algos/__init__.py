"""One readable training loop each."""
