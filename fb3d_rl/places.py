"""Where files lie that belong to the package but are no modules: beside it in a checkout, inside it in a wheel."""

from __future__ import annotations

from pathlib import Path


def folder(name: str) -> Path:
    """The folder conf, launch or pretrained (the published weights)."""
    package = Path(__file__).resolve().parent
    inside = package / name
    if inside.is_dir():
        return inside
    return package.parent / ("results/pretrained" if name == "pretrained" else name)
