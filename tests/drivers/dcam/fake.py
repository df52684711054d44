"""The fake DCAM library, compiled with gcc, and the object that controls the world around it."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.base.clock import Clock, SystemClock
from drivers.dcam.camera import DcamCamera
from drivers.orca_quest import DcamOptions
from drivers.testing.stages.bench import EmittedPulse

SENSOR = (48, 72)
EXPOSURETIME, TIMING_READOUTTIME = 0x001F0110, 0x00403010
SOURCE = Path(__file__).parent / "fake_dcam.c"
START = 1000.0
READY_MADE = "FAKE_DCAM_LIBRARY"
"""Environment variable with the path of a library that is compiled already, as test_sanitised does it."""

NextPulse = ctypes.CFUNCTYPE(ctypes.c_double, ctypes.c_double)


def compiler() -> str:
    """gcc; skips the test where there is none."""
    found = shutil.which("gcc")
    if found is None or sys.platform == "win32":
        pytest.skip("no gcc here to compile the fake DCAM library with")
    return found


def build(folder: Path, *flags: str) -> Path:
    """The library, compiled into a folder; skips where there is no compiler.

    Raises:
        CalledProcessError: it does not compile with these flags.
    """
    library = folder / "libfakedcam.so"
    strict = ("-std=gnu11", "-Wall", "-Wextra", "-Werror", "-O1", "-shared", "-fPIC", "-pthread")
    command = [compiler(), *strict, *flags, str(SOURCE), "-o", str(library), "-lm"]
    subprocess.run(command, check=True, capture_output=True)
    return library


class VirtualTime:
    """The fake's own time as a Clock: sleeping and waiting for the camera jump."""

    def __init__(self, fake: ctypes.CDLL) -> None:
        self._fake = fake

    def now(self) -> float:
        return self._fake.fakedcam_now()

    def sleep(self, seconds: float) -> None:
        self._fake.fakedcam_sleep(max(seconds, 0.0))


class Pulses(Protocol):
    """A trigger cable."""

    def next_after(self, time: float) -> EmittedPulse | None: ...


class World:
    """Fires triggers at the fake camera and breaks things; it begins anew with every World, in virtual time."""

    def __init__(self, library: Path) -> None:
        self.path = library
        self._fake = fake = ctypes.CDLL(str(library))
        real, integer = ctypes.c_double, ctypes.c_int32
        fake.fakedcam_reset.argtypes = (ctypes.c_int, ctypes.c_int, ctypes.c_int, real)
        fake.fakedcam_pulse.argtypes = fake.fakedcam_sleep.argtypes = (real,)
        fake.fakedcam_override.argtypes = fake.fakedcam_preset.argtypes = (integer, real)
        fake.fakedcam_fail.argtypes = (ctypes.c_char_p, ctypes.c_int, ctypes.c_uint32)
        fake.fakedcam_value.restype = fake.fakedcam_now.restype = real
        fake.fakedcam_cable.argtypes = (NextPulse,)
        self.clock: Clock = VirtualTime(fake)
        self.reset()

    def reset(self, rows: int = SENSOR[0], cols: int = SENSOR[1], real_time: bool = False) -> None:
        self._fake.fakedcam_reset(1, rows, cols, 0.0 if real_time else START)
        self.clock = SystemClock() if real_time else VirtualTime(self._fake)
        self._last = self.clock.now()

    def connect(self, options: DcamOptions | None = None) -> DcamCamera:
        return DcamCamera(self.path, clock=self.clock, options=options)

    def plug(self, line: Pulses) -> None:
        """Connect the trigger input to a stage's output: the fake asks the line what comes next whenever it needs to.

        So pulses that a stage takes back, when it is stopped on the way, never come.
        """

        def next_after(time: float) -> float:
            pulse = line.next_after(time)
            return -1.0 if pulse is None else pulse.time

        self._cable = NextPulse(next_after)  # must live as long as the library may call it
        self._fake.fakedcam_cable(self._cable)

    def fault(self, name: str, value: int = 1) -> None:
        assert self._fake.fakedcam_fault(name.encode(), value), f"the fake knows no fault {name!r}"

    def fail(self, call: str, code: int, nth: int = 1) -> None:
        """The nth call of a function from now on answers with an error code and does nothing."""
        assert self._fake.fakedcam_fail(call.encode(), nth, code)

    def lose(self, *exposures: int) -> None:
        """Exposures by external trigger, counted over the camera's life, that never reach the ring."""
        for number in exposures:
            assert self._fake.fakedcam_lose(number)

    def calls(self, name: str) -> int:
        """How often a function of the library was called."""
        return self._fake.fakedcam_calls(name.encode())

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

    @property
    def exposed(self) -> int:
        """Exposures of the present or last capture."""
        return self._fake.fakedcam_exposed()

    @property
    def delivered(self) -> int:
        """Frames that reached the ring in the present or last capture."""
        return self._fake.fakedcam_delivered()

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
