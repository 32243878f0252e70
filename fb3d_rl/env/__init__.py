"""The simulated environment: the ManiSkill task, the floating suction gripper and the TorchRL adapter.

:mod:`fb3d_rl.env.options` needs no simulator; importing :mod:`fb3d_rl.env.task` loads SAPIEN and ManiSkill.
"""

import warnings

warnings.filterwarnings("ignore", message="Failed to find system libvulkan")  # SAPIEN's: most often nothing is rendered
