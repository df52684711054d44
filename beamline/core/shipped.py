"""The installed version, and the configurations and scenes that come with the package."""

from __future__ import annotations

from importlib import metadata
from pathlib import Path


def config_folder() -> Path:
    """The folder of the configurations that come with the package: installed, or beside the packages of a checkout."""
    installed = Path(__file__).parents[1] / "configs"
    return installed if installed.is_dir() else Path(__file__).parents[2] / "configs"


def shipped_scenes() -> dict[str, Path]:
    """The scenes that come with the package, by name."""
    return {path.stem: path for path in sorted((config_folder() / "scenes").glob("*.yaml"))}


def version() -> str:
    """The installed distribution's version; "uninstalled" when run from a bare checkout."""
    try:
        return metadata.version("splatline")
    except metadata.PackageNotFoundError:
        return "uninstalled"
