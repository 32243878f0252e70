"""One object that stands in the world, and the one way in which it is observed."""
