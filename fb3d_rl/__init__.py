"""fb3d_rl: teach a floating suction gripper to open articulated objects it has never seen."""

__version__ = "0.1.0"
