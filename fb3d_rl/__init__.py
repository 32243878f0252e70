"""fb3d_rl: teach a floating suction gripper to open articulated objects it has never seen.

``fb3d_rl.plan`` makes a ``fb3d_rl.Plan`` of a cloud, ``fb3d_rl.read_cloud`` reads one (docs/library.md).
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fb3d_rl.perception.files import read_cloud as read_cloud
    from fb3d_rl.predict.plan import Plan as Plan
    from fb3d_rl.predict.plan import plan as plan

__version__ = "0.1.0"

_PLACES = {"plan": "fb3d_rl.predict.plan", "Plan": "fb3d_rl.predict.plan", "read_cloud": "fb3d_rl.perception.files"}


def __getattr__(name: str) -> Any:
    """What is imported when it is first asked for: PyTorch takes seconds."""
    if name not in _PLACES:
        raise AttributeError(f"module 'fb3d_rl' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_PLACES[name]), name)
