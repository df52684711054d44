"""Workers that reconstruct slabs elsewhere: the feature that provides them."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from beamline.core.errors import ConfigError
from recon.base.registry import in_folders


def cluster() -> Any:
    """The module of the feature: `check_cluster`, `refuse_unusable`, `memory_of_each` and `connected` take its spec.

    Raises:
        ConfigError: this installation has none.
    """
    modules = in_folders("beamline.features", "WORKERS")
    if "cluster" not in modules:
        raise ConfigError("--cluster: this installation has no workers. Leave it out. Nothing was started.")
    return import_module(modules["cluster"])
