"""What the tests share: a few procedural objects, a root of real ones where there is one, and configurations."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from omegaconf import OmegaConf

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.assets.partnet_mobility import load_object
from fb3d_rl.assets.procedural import generate
from fb3d_rl.config import ArtFlowNetConfig, EvaluateConfig, ImitationConfig, TrainConfig, ViewConfig, validate


@pytest.fixture(scope="session", autouse=True)
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cache of parsed objects of the tests' own, also for the commands that they run."""
    folder = tmp_path_factory.mktemp("cache")
    os.environ["FB3D_CACHE"] = str(folder)
    return folder


@pytest.fixture
def full_disk() -> Callable[[int], AbstractContextManager[None]]:
    """A disk on which no file can be written beyond so many bytes."""
    resource = pytest.importorskip("resource", reason="needs a limit on the size of files, as Unix has")

    @contextmanager
    def limited(size: int) -> Iterator[None]:
        soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))

    return limited


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


@pytest.fixture(scope="session")
def schemas() -> None:
    """The typed schemas that conf/ names, as the commands register them."""
    store = ConfigStore.instance()
    for name, schema in (("train", TrainConfig), ("evaluate", EvaluateConfig), ("view", ViewConfig)):
        store.store(name=f"{name}_schema", node=schema)
    for kind, algo in (("artflownet", ArtFlowNetConfig), ("imitation", ImitationConfig)):
        store.store(group="algo", name=f"{kind}_schema", node=algo)


@pytest.fixture(scope="session")
def config(schemas: None) -> Callable[[str, list[str]], Any]:
    """Composes and checks conf/<name>.yaml with overrides, as the command of that name does."""

    def composed(name: str, overrides: list[str]) -> TrainConfig | EvaluateConfig | ViewConfig:
        with initialize_config_dir(str(Path(__file__).parents[1] / "conf"), version_base="1.3"):
            cfg = OmegaConf.to_object(compose(name, overrides))
        validate(cfg)
        return cfg

    return composed
