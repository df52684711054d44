"""The version that is written to outputs."""

from __future__ import annotations

from importlib import metadata


def version() -> str:
    """The installed distribution's version; "uninstalled" when run from a bare checkout."""
    try:
        return metadata.version("splatline")
    except metadata.PackageNotFoundError:
        return "uninstalled"
