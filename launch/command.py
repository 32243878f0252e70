"""What the launch scripts share: compose the configuration, check it, and turn every user error into one sentence."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # errors come here as exceptions, in place of Hydra's own printout
os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")  # TorchRL tells about every memory map

import hydra
import run_folder
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from fb3d_rl.config import ArtFlowNetConfig, EvaluateConfig, ImitationConfig, TrainConfig, ViewConfig, validate
from fb3d_rl.contract import UserError

CONF = str(Path(__file__).resolve().parents[1] / "conf")
SCHEMAS: dict[str, type[TrainConfig | EvaluateConfig | ViewConfig]] = {
    "train": TrainConfig,
    "evaluate": EvaluateConfig,
    "view": ViewConfig,
}

ALGOS = {"artflownet": ArtFlowNetConfig, "imitation": ImitationConfig}


def main(name: str, task: Callable[[Any, Path], Any], keeps: bool = True) -> None:
    """Run ``task(config, run folder)`` with conf/<name>.yaml and the overrides of the command line.

    With ``keeps=False`` nothing is kept of a run: hydra.run.dir is no folder of its own, and nothing is written there.

    Exit codes: 0, or 2 with one sentence on stderr for whatever the user can mend.
    """
    schemas = {**SCHEMAS, **{f"algo/{kind}": node for kind, node in ALGOS.items()}}
    ConfigStore.instance().store(name=f"{name}_schema", node=SCHEMAS[name])
    for kind, node in ALGOS.items():
        ConfigStore.instance().store(group="algo", name=f"{kind}_schema", node=node)

    @hydra.main(version_base="1.3", config_path=CONF, config_name=name)
    def job(raw: DictConfig) -> None:
        out = Path(HydraConfig.get().runtime.output_dir)
        with _one_sentence():
            if not keeps:
                cfg: Any = OmegaConf.to_object(raw)
                validate(cfg)
                task(cfg, out)
                return
            fresh = run_folder.is_new(out)
            try:
                with run_folder.locked(out):
                    cfg = OmegaConf.to_object(run_folder.configuration(raw, name, out, schemas))
                    validate(cfg)
                    task(cfg, out)
            except UserError:
                # A run that never began leaves no folder.
                if fresh and out.is_dir() and run_folder.is_new(out, run_folder.CONFIG):
                    shutil.rmtree(out)
                raise

    with _one_sentence():
        job()


@contextmanager
def _one_sentence() -> Iterator[None]:
    """Turn an error that the user can mend into one sentence; inside the job, before Hydra adds words of its own."""
    try:
        yield
    except UserError as error:
        fail(str(error))
    except (HydraException, OmegaConfBaseException) as error:
        fail(_sentence(error))
    except OSError as error:
        if error.filename is None:
            raise
        fail(f"{error.filename} cannot be written or read ({error.strerror}); choose another folder: hydra.run.dir=DIR")
    except KeyboardInterrupt:
        fail("interrupted; a folder with a checkpoint.pt or rows.csv goes on with: resume=true hydra.run.dir=FOLDER")


def fail(sentence: str) -> None:
    """Say what is wrong on stderr and end with exit code 2."""
    print(f"error: {' '.join(sentence.split())}", file=sys.stderr)
    sys.exit(2)


def _sentence(error: BaseException) -> str:
    """Hydra's and OmegaConf's messages span lines, of which the first says what and a later one where."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    where = next((line.removeprefix("full_key: ") for line in lines if line.startswith("full_key: ")), "")
    cause = error.__cause__
    detail = str(cause).splitlines()[0] if cause is not None and str(cause) else ""
    choices = "; write several values as a list: key=[a,b]" if "Ambiguous value" in str(error) else ""
    if "Available options" in str(error):
        choices = "; choose from " + ", ".join(lines[2 : lines.index("Config search path:")])
    text = " ".join(part for part in (lines[0] if lines else type(error).__name__, detail) if part) + choices
    return f"{text} (key {where}; see conf/)" if where and where not in text else f"{text} (see conf/)"
