"""Objects that the tests share: a few procedural ones, made once, and a root of real ones where there is one."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.assets.partnet_mobility import load_object
from fb3d_rl.assets.procedural import generate


@pytest.fixture(scope="session")
def procedural_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with one procedural cabinet, microwave and pot."""
    root = tmp_path_factory.mktemp("procedural")
    generate(root, ["StorageFurniture", "Microwave", "KitchenPot"], 1, seed=0)
    return root


@pytest.fixture(scope="session")
def procedural_objects(procedural_root: Path) -> dict[str, ArticulatedObject]:
    """The objects of ``procedural_root`` by category."""
    loaded = [load_object(folder) for folder in sorted(procedural_root.iterdir())]
    return {obj.category: obj for obj in loaded}


@pytest.fixture(scope="session")
def real_root() -> Path:
    """Folder of PartNet-Mobility objects."""
    root = os.environ.get("FB3D_PARTNET_MOBILITY")
    if not root:
        pytest.skip("FB3D_PARTNET_MOBILITY is unset; set it to the folder of PartNet-Mobility objects")
    return Path(root)
