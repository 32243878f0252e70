"""Puts conf/, launch/ and the published weights into the package of a wheel; all else is in pyproject.toml."""

from __future__ import annotations

import shutil
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

INSIDE = {"conf": "**/*.yaml", "launch": "*.py", "results/pretrained": "*"}


class WithFolders(build_py):
    """Copies the folders that fb3d_rl.places looks for; a checkout has them beside the package."""

    def run(self) -> None:
        super().run()
        if self.editable_mode:
            return
        for folder, pattern in INSIDE.items():
            inside = Path(self.build_lib) / "fb3d_rl" / Path(folder).name
            shutil.rmtree(inside, ignore_errors=True)
            for file in Path(folder).glob(pattern):
                copy = inside / file.relative_to(folder)
                copy.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(file, copy)


setup(cmdclass={"build_py": WithFolders})
