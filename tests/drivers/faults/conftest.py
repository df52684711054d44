"""Fixtures of the fault table: the fake DCAM library, and a rig for each controller."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.drivers.dcam.fake import World, build
from tests.drivers.faults.rig import Rig


@pytest.fixture(scope="session")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Path of the compiled library; the test is skipped if there is no compiler."""
    return build(tmp_path_factory.mktemp("fakedcam"))


@pytest.fixture
def rig_of(library: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Rig]:
    """Function that makes a rig with a controller of a kind, and further arguments of `Rig`."""
    return lambda kind, **settings: Rig(World(library), monkeypatch, kind, **settings)
