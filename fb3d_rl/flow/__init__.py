"""The ground-truth 3D articulation flow, the kinematic tree behind it, and flow metrics: pure batched torch."""
