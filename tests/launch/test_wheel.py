"""The wheel alone, in an environment without this checkout, from another folder."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

from fb3d_rl.cli import COMMANDS

ROOT = Path(__file__).resolve().parents[2]


def run(*words: object, cwd: Path, timeout: float = 280) -> subprocess.CompletedProcess[str]:
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    return subprocess.run(
        [str(word) for word in words], cwd=cwd, env=clean, capture_output=True, text=True, timeout=timeout, check=False
    )


@pytest.fixture(scope="module")
def fb3d(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The console command of a wheel that is installed into a fresh environment; what it depends on is shared."""
    folder = tmp_path_factory.mktemp("wheel")
    tracked = run("git", "ls-files", "-co", "--exclude-standard", cwd=ROOT).stdout.split("\n")
    for name in filter(None, tracked):
        kept = not name.startswith("results/") or name.startswith("results/pretrained")
        if kept and (ROOT / name).is_file():
            (folder / "source" / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, folder / "source" / name)
    pip = (sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check")
    built = run(*pip, "wheel", "--no-deps", "--no-build-isolation", "-w", folder, "./source", cwd=folder)
    assert built.returncode == 0, built.stderr
    shutil.rmtree(folder / "source")
    assert run(sys.executable, "-m", "venv", "--without-pip", folder / "venv", cwd=folder).returncode == 0
    python = folder / "venv" / "bin" / "python"
    (wheel,) = folder.glob("*.whl")
    installed = run(*pip, "--python", python, "install", "--no-deps", wheel, cwd=folder)
    assert installed.returncode == 0, installed.stderr
    site = Path(run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", cwd=folder).stdout.strip())
    (site / "shared.pth").write_text(sysconfig.get_path("purelib") + "\n")  # its own .pth files are not read there
    return folder / "venv" / "bin" / "fb3d"


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.skipif(sys.platform == "win32", reason="names the folders of a Unix environment")
def test_a_wheel_trains_from_any_folder(fb3d: Path, tmp_path: Path) -> None:
    done = run(fb3d, "train", "experiment=smoke", "hydra.run.dir=run", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert {"rows.csv", "summary.json", "report.html"} <= {path.name for path in (tmp_path / "run").iterdir()}
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
    weights = "from fb3d_rl.models.artflownet import ArtFlowNet; print(ArtFlowNet.from_pretrained().part_mask_input)"
    found = run(fb3d.parent / "python", "-c", weights, cwd=tmp_path)
    assert found.stdout.strip() == "True", found.stderr


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.skipif(sys.platform == "win32", reason="names the folders of a Unix environment")
def test_every_command_of_the_wheel_says_what_it_does(fb3d: Path, tmp_path: Path) -> None:
    listed = run(fb3d, "--help", cwd=tmp_path).stdout
    for name in COMMANDS:
        done = run(fb3d, name, "--help", cwd=tmp_path)
        assert done.returncode == 0 and done.stdout, (name, done.stderr)
        assert name in listed
    assert run(fb3d, "--version", cwd=tmp_path).stdout.startswith("fb3d_rl ")


def test_the_commands_are_the_scripts() -> None:
    helpers = {"command", "run_folder"}
    assert set(COMMANDS) == {path.stem for path in (ROOT / "launch").glob("*.py")} - helpers


def test_an_unknown_command_is_named_with_those_that_there_are(tmp_path: Path) -> None:
    done = run(sys.executable, "-c", "from fb3d_rl.cli import main; main()", "dance", cwd=ROOT)
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and "dance" in done.stderr and "train" in done.stderr
