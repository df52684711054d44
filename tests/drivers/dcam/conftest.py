"""The fake DCAM library, compiled for the session, and the hand that plays the world outside it."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.clock import Clock, SystemClock
from drivers.dcam.camera import DcamCamera
from drivers.protocols import CameraSettings, TriggerSource

SENSOR = (48, 72)
EXPOSURETIME, TIMING_READOUTTIME = 0x001F0110, 0x00403010
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


class VirtualTime:
    """The fake's own time as a Clock: sleeping and waiting for the camera jump."""

    def __init__(self, fake: ctypes.CDLL) -> None:
        self._fake = fake

    def now(self) -> float:
        return self._fake.fakedcam_now()

    def sleep(self, seconds: float) -> None:
        self._fake.fakedcam_sleep(max(seconds, 0.0))


class World:
    """Fires triggers at the fake camera and breaks things; it begins anew with every World, in virtual time."""

    def __init__(self, library: Path) -> None:
        self.path = library
        self._fake = ctypes.CDLL(str(library))
        real, integer = ctypes.c_double, ctypes.c_int32
        self._fake.fakedcam_reset.argtypes = (ctypes.c_int, ctypes.c_int, ctypes.c_int, real)
        self._fake.fakedcam_pulse.argtypes = self._fake.fakedcam_sleep.argtypes = (real,)
        self._fake.fakedcam_override.argtypes = self._fake.fakedcam_preset.argtypes = (integer, real)
        self._fake.fakedcam_value.restype = self._fake.fakedcam_now.restype = real
        self.clock: Clock = VirtualTime(self._fake)
        self.reset()

    def reset(self, rows: int = SENSOR[0], cols: int = SENSOR[1], real_time: bool = False) -> None:
        self._fake.fakedcam_reset(1, rows, cols, 0.0 if real_time else 1000.0)
        self.clock = SystemClock() if real_time else VirtualTime(self._fake)
        self._last = self.clock.now()

    def connect(self, ring_bytes: int = 1 << 30) -> DcamCamera:
        return DcamCamera(self.path, clock=self.clock, ring_bytes=ring_bytes)

    def fault(self, name: str, value: int = 1) -> None:
        assert self._fake.fakedcam_fault(name.encode(), value), f"the fake knows no fault {name!r}"

    def override(self, property_id: int, value: float) -> None:
        assert self._fake.fakedcam_override(property_id, value)

    def preset(self, property_id: int, value: float) -> None:
        assert self._fake.fakedcam_preset(property_id, value)

    def value(self, property_id: int) -> float:
        return self._fake.fakedcam_value(property_id)

    def schedule(self, times: Sequence[float]) -> None:
        """Rising edges on the trigger input, at times on the clock."""
        for time in times:
            assert self._fake.fakedcam_pulse(time)

    def pulse(self, after: float = 0.1) -> bool:
        """A pulse `after` s after the one before (or now), and the time to read it out; whether an exposure began."""
        before = self._fake.fakedcam_exposed()
        self._last = max(self._last + after, self.clock.now())
        self.schedule([self._last])
        done = self._last + self.value(EXPOSURETIME) + self.value(TIMING_READOUTTIME) + 1e-6
        self.clock.sleep(done - self.clock.now())
        return self._fake.fakedcam_exposed() > before

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
    camera = world.connect()
    camera.configure(CameraSettings(0.001, TriggerSource.EXTERNAL))
    yield camera
    camera.close()
    assert world.live == 0
