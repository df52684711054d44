"""What is installed: the version, the configurations and scenes of the package, and modules by the names of ours."""

from __future__ import annotations

import os
import sys
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


OWN_PACKAGES = ("drivers", "recon", "simulators")
_MARK = b"splatline"  # in the first line of each one's __init__.py


def package_problem(home: str) -> str:
    """A sentence with advice if Python imports another module by the name of one of this project's packages; "" if not.

    Args:
        home: the folder that holds our packages.
    """
    for name in OWN_PACKAGES:
        ours = os.path.join(home, name, "__init__.py")  # noqa: PTH118 - to load pathlib takes longer than this check
        origin = _origin(name)
        if origin is None:
            return f"splatline is incomplete: Python finds no package {name!r}. {_AGAIN}."
        if origin != ours and os.path.realpath(origin) != os.path.realpath(ours):
            return f"Python finds {name!r} at {origin}, not splatline's at {ours}: {_way_out(origin)}."
        with open(origin, "rb") as file:  # noqa: PTH123
            if _MARK not in file.readline():
                return f"{origin} is not splatline's: {_way_out(origin)}."
    return ""


def _origin(name: str) -> str | None:
    """The file that Python loads for a module, or has loaded; None where it has none."""
    if name in sys.modules:
        return getattr(sys.modules[name], "__file__", None)
    specs = (finder.find_spec(name, None) for finder in sys.meta_path)
    return next((spec.origin for spec in specs if spec is not None), None)


_AGAIN = "Install it again: `pip install --force-reinstall --no-deps splatline`"


def _way_out(origin: str) -> str:
    """What to do about a module that is not ours."""
    if not any(f"{os.sep}{folder}{os.sep}" in origin for folder in ("site-packages", "dist-packages")):
        return "rename that one, or work in another folder"
    return "it belongs to another distribution. Install splatline in a separate environment (python -m venv)"
