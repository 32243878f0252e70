"""One object in the world, and the one way to observe it."""
