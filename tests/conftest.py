"""What the tests share: a few procedural objects, a root of real ones where there is one, and configurations."""

from __future__ import annotations

import logging
import multiprocessing
import os
import runpy
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from subprocess import CompletedProcess
from typing import Any, TypeAlias

# Read by torch and numpy when they are imported, here and in what the tests start.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # threads that wait leave the core to others
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ["OMP_NUM_THREADS"] = "1"  # each of pytest's processes has a core

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from omegaconf import OmegaConf

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.assets.partnet_mobility import load_object
from fb3d_rl.config import COMMANDS, EvaluateConfig, TrainConfig, ViewConfig, configured
from fb3d_rl.config import schemas as typed_schemas
from fb3d_rl.procedural import generate

ROOT = Path(__file__).resolve().parents[1]
Launch: TypeAlias = "Callable[..., CompletedProcess[str]]"


@pytest.fixture(autouse=True)
def denormals_as_usual() -> Iterator[None]:
    """Training has denormal numbers rounded to 0 in the whole process, which the next test does not expect."""
    yield
    torch.set_flush_denormal(False)


@pytest.fixture
def two_threads() -> Iterator[None]:
    """Torch computes on two threads, however many it has otherwise."""
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="session")
def launch(tmp_path_factory: pytest.TempPathFactory) -> Launch:
    """Runs a command as ``python launch/<script> <arguments>`` would, in a process that is forked from this one.

    That saves the seconds that the imports take, and with them what they might write; tests/launch starts Python, too.
    """
    folder = tmp_path_factory.mktemp("launch")

    def launched(script: str, *arguments: str, cwd: Path) -> CompletedProcess[str]:
        process = multiprocessing.get_context("fork").Process(target=_run, args=(script, arguments, cwd, folder))
        process.start()
        process.join(120)
        process.kill()  # if it has not ended
        process.join()
        stdout, stderr = ((folder / name).read_text() for name in ("stdout", "stderr"))
        return CompletedProcess([script, *arguments], process.exitcode or 0, stdout, stderr)

    return launched


def _run(script: str, arguments: tuple[str, ...], cwd: Path, folder: Path) -> None:
    """Become the process of a command, whose outputs are files."""
    for number, name in ((1, "stdout"), (2, "stderr")):
        os.dup2(os.open(folder / name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
        setattr(sys, name, open(number, "w", buffering=1))
    logging.getLogger().handlers.clear()  # pytest's
    GlobalHydra.instance().clear()
    os.chdir(cwd)
    sys.argv = [script, *arguments]
    sys.path.insert(0, str(ROOT / "launch"))
    runpy.run_path(str(ROOT / "launch" / script), run_name="__main__")


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
def objects(tmp_path_factory: pytest.TempPathFactory) -> dict[str, ArticulatedObject]:
    """Procedural objects by category: a cabinet with a door and drawers, a table with drawers, an oven, a laptop."""
    root = tmp_path_factory.mktemp("objects")
    categories = ["StorageFurniture", "Table", "Oven", "Laptop"]
    loaded = [load_object(root / name) for name in generate(root, categories, 1, seed=0)]
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
    for command in COMMANDS:
        for (group, name), node in typed_schemas(command).items():
            store.store(group=group, name=name, node=node)


@pytest.fixture(scope="session")
def config(schemas: None) -> Callable[[str, list[str]], Any]:
    """Composes and checks conf/<name>.yaml with overrides, as the command of that name does."""

    def composed(name: str, overrides: list[str]) -> TrainConfig | EvaluateConfig | ViewConfig:
        with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
            composed = compose(name, overrides)
        cfg: TrainConfig | EvaluateConfig | ViewConfig = configured(OmegaConf.to_object(composed))
        return cfg

    return composed
