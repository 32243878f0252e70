"""What the launch scripts share: compose the configuration, check it, and turn every user error into one sentence."""

from __future__ import annotations

import os
import shutil
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # errors come here as exceptions, in place of Hydra's own printout
os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")  # TorchRL logs every memory map

import hydra
import run_folder
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from fb3d_rl import config, interrupt
from fb3d_rl.errors import Interrupted, UserError, of_disk
from fb3d_rl.places import folder

CONF = str(folder("conf"))

# Hydra copies its sources of configurations, and with them all schemas, each time it looks at a group, a hundred times
# for --help: two thirds of its time. Schemas are not changed after they are stored.
setattr(ConfigStore, "__deepcopy__", lambda store, memo: store)  # noqa: B010, mypy knows no such method


def main(name: str, task: Callable[[Any, Path], Any], keeps: bool = True) -> None:
    """Run ``task(config, run folder)`` with conf/<name>.yaml and the overrides of the command line.

    With ``keeps=False`` a run has no folder of its own, and nothing is written to hydra.run.dir.

    Exit codes: 0, or 2 with one sentence on stderr for an error that the user can fix. A job of a sweep (-m) that fails
    does not stop the others: it is named when it fails and at the end, and the exit code is 2.
    """
    process = os.getpid()
    failed: dict[str, str] = {}  # what is wrong with jobs of a sweep
    jobs: list[str] = []  # all of them
    for (group, entry), node in config.schemas(name).items():
        ConfigStore.instance().store(group=group, name=entry, node=node)

    @hydra.main(version_base="1.3", config_path=CONF, config_name=name)
    def job(raw: DictConfig) -> None:
        hydra_config = HydraConfig.get()
        if hydra_config.mode != RunMode.MULTIRUN:
            _run(raw, name, task, keeps)
            return
        common = {word.lower() for word in sys.argv}
        swept = [word for word in hydra_config.overrides.task if word.lower() not in common]
        jobs.append(f"job {hydra_config.job.num} ({' '.join(swept)})")
        try:
            _run(raw, name, task, keeps, f"{jobs[-1]}: ")
        except _Failed as end:
            if os.getpid() != process:  # a launcher of processes passes exceptions on
                raise UserError(end.sentence) from None
            failed[jobs[-1]] = end.sentence
        except Exception as error:  # noqa: BLE001, a fault of the program must not stop the other jobs
            if os.getpid() != process:
                raise
            traceback.print_exc()
            failed[jobs[-1]] = f"{type(error).__name__}: {error}"

    try:
        with _one_sentence():
            job()
    finally:
        if {"--help", "-h"} & {*sys.argv}:  # beneath Hydra's
            print(config.help_of(name))
    if failed:
        print(f"error: {len(failed)} of {len(jobs)} jobs failed:", file=sys.stderr)
        for name, sentence in failed.items():
            print(f"  {name}: {sentence}", file=sys.stderr)
        sys.exit(2)


def _run(raw: DictConfig, name: str, task: Callable[[Any, Path], Any], keeps: bool, where: str = "") -> None:
    """Run the task with what Hydra composed, as :func:`main` says; ``where`` is put before an error's sentence."""
    out = Path(HydraConfig.get().runtime.output_dir)
    with _one_sentence(where):
        if not keeps:
            task(config.configured(OmegaConf.to_object(raw)), out)
            return
        with run_folder.locked(out):
            fresh = run_folder.is_new(out)
            try:
                composed = OmegaConf.to_object(run_folder.configuration(raw, name, out))
                task(config.configured(composed), out)
            except UserError:
                # A run that never began leaves no folder; only the process with the lock may remove it.
                if fresh and out.is_dir() and run_folder.is_new(out, run_folder.CONFIG):
                    shutil.rmtree(out)
                raise


def report(out: Path) -> None:
    """Write the report of a finished run, and say where its results are."""
    from fb3d_rl.report.run_page import write_report

    path = write_report(out)
    print(f"results: {out}\nreport:  {path}")
    if (videos := out / "videos").is_dir():
        print(f"videos:  {videos}")


class _Failed(SystemExit):
    """Ends the process, or this job of a sweep, after its error was printed."""

    def __init__(self, sentence: str) -> None:
        super().__init__(2)
        self.sentence = sentence


@contextmanager
def _one_sentence(where: str = "") -> Iterator[None]:
    """Turn an error that the user can fix into one sentence; inside the job, before Hydra adds its own message."""

    def failure(sentence: str) -> _Failed:
        sentence = " ".join(sentence.split())
        print(f"error: {where}{sentence}", file=sys.stderr)
        return _Failed(sentence)

    try:
        yield
    except Interrupted as error:
        sys.exit(failure(str(error)).code)  # the whole sweep
    except (Exception, KeyboardInterrupt) as error:
        if interrupt.caused(error):
            hint = "a folder with a checkpoint.pt or rows.csv goes on with: resume=true hydra.run.dir=FOLDER"
            sys.exit(failure(f"interrupted; {hint}").code)
        if isinstance(error, UserError):
            raise failure(str(error)) from error
        if isinstance(error, HydraException | OmegaConfBaseException):
            raise failure(_sentence(error)) from error
        if isinstance(error, OSError) and (sentence := of_disk(error)) is not None:
            raise failure(f"{sentence}; choose another folder: hydra.run.dir=DIR") from error
        raise


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
