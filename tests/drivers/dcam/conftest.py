"""Fixtures for tests of the DCAM driver: the fake library, its environment, a camera."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from drivers.base.protocols import CameraSettings, TriggerSource
from drivers.dcam.camera import DcamCamera
from tests.drivers.dcam.fake import READY_MADE, World, build


@pytest.fixture(scope="session")
def fake_library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Path of the compiled library; skips where there is no compiler."""
    ready_made = os.environ.get(READY_MADE)
    return Path(ready_made) if ready_made else build(tmp_path_factory.mktemp("fakedcam"))


@pytest.fixture
def world(fake_library: Path) -> World:
    return World(fake_library)


@pytest.fixture
def camera(world: World) -> Iterator[DcamCamera]:
    """A camera on external triggers; everything that it opened must be closed at the end."""
    camera = world.connect()
    camera.configure(CameraSettings(0.001, TriggerSource.EXTERNAL))
    yield camera
    camera.close()
    assert world.live == 0
