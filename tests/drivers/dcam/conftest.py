"""The fake DCAM library, compiled for the session, and the hand that plays the world outside it."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.dcam.camera import DcamCamera
from drivers.protocols import CameraSettings, TriggerSource

SENSOR = (48, 72)
SOURCE = Path(__file__).parent / "fake_dcam.c"


def _build(folder: Path) -> Path:
    compiler = shutil.which("gcc")
    if compiler is None or sys.platform == "win32":
        pytest.skip("no gcc here to compile the fake DCAM library with")
    library = folder / "libfakedcam.so"
    flags = ("-std=gnu11", "-Wall", "-Wextra", "-Werror", "-O1", "-shared", "-fPIC", "-pthread")
    subprocess.run([compiler, *flags, str(SOURCE), "-o", str(library), "-lm"], check=True)
    return library


@pytest.fixture(scope="session")
def fake_library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Path of the compiled library; skips where there is no compiler."""
    return _build(tmp_path_factory.mktemp("fakedcam"))


class World:
    """Fires triggers at the fake camera and breaks things. The camera's clock starts at 1000 s."""

    def __init__(self, library: Path) -> None:
        self.path = library
        self._fake = ctypes.CDLL(str(library))
        self._fake.fakedcam_pulse.argtypes = (ctypes.c_double, ctypes.c_double)
        self._fake.fakedcam_override.argtypes = (ctypes.c_int32, ctypes.c_double)
        self._fake.fakedcam_preset.argtypes = (ctypes.c_int32, ctypes.c_double)
        self._fake.fakedcam_value.restype = ctypes.c_double
        self._time = 1000.0
        self.reset()

    def reset(self, rows: int = SENSOR[0], cols: int = SENSOR[1], devices: int = 1) -> None:
        self._fake.fakedcam_reset(devices, rows, cols)

    def fault(self, name: str, value: int = 1) -> None:
        assert self._fake.fakedcam_fault(name.encode(), value), f"the fake knows no fault {name!r}"

    def override(self, property_id: int, value: float) -> None:
        assert self._fake.fakedcam_override(property_id, value)

    def preset(self, property_id: int, value: float) -> None:
        assert self._fake.fakedcam_preset(property_id, value)

    def value(self, property_id: int) -> float:
        return self._fake.fakedcam_value(property_id)

    def pulse(self, after: float = 0.1, width: float = 0.001) -> bool:
        """One pulse, `after` s after the one before; whether an exposure began."""
        self._time += after
        return bool(self._fake.fakedcam_pulse(self._time, width))

    def pulses(self, n: int, period: float = 0.1) -> int:
        """n pulses; how many began an exposure."""
        return sum(self.pulse(period) for _ in range(n))

    def stop(self) -> None:
        self._fake.fakedcam_stop()

    @property
    def live(self) -> int:
        """Sessions, cameras, wait handles and rings that are open."""
        return self._fake.fakedcam_live()

    @property
    def waiters(self) -> int:
        return self._fake.fakedcam_waiters()

    def layout(self) -> dict[str, tuple[int, list[int]]]:
        """C's sizeof and offsets of every structure."""
        text = ctypes.create_string_buffer(4096)
        self._fake.fakedcam_layout(text, len(text))
        rows = [line.split() for line in text.value.decode().strip().splitlines()]
        return {name: (int(size), [int(offset) for offset in offsets]) for name, size, *offsets in rows}

    @staticmethod
    def pattern(stamp: int, roi: tuple[int, int, int, int] = (0, 0, *SENSOR), binning: int = 1) -> NDArray[np.uint16]:
        """What the fake's frame number `stamp` shows, from the rule in fake_camera.h."""
        row0, col0, rows, cols = roi
        row, col = np.ogrid[row0 : row0 + rows : binning, col0 : col0 + cols : binning]
        return ((stamp % 16) * 4096 + (row % 64) * 64 + col % 64).astype(np.uint16)


@pytest.fixture
def world(fake_library: Path) -> World:
    return World(fake_library)


@pytest.fixture
def camera(world: World) -> Iterator[DcamCamera]:
    """A camera on external triggers; everything that it opened must be closed at the end."""
    camera = DcamCamera(world.path)
    camera.configure(CameraSettings(0.001, TriggerSource.EXTERNAL))
    yield camera
    camera.close()
    assert world.live == 0
