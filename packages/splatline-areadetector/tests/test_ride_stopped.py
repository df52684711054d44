"""Ctrl-C and SIGTERM during recording and live reconstruction: both take effect within 2 s of an idle core."""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path

import numpy as np
import pytest
from fake_ioc import FakeIoc, array_value
from ridden import RideProgram, stored

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(400),
    pytest.mark.usefixtures("loopback"),
    pytest.mark.skipif(sys.platform == "win32", reason="no test sends Ctrl-C to one program alone there"),
]
WITHIN, LATEST = 2.0, 30.0  # s: each on a free core; by the clock for all, also of a busy machine
SHAPES = {10: (2048, 2048), 50: (64, 96)}  # by frames/s


@contextmanager
def _sending(ioc: FakeIoc, fps: int) -> Iterator[Callable[[], None]]:
    """The views of a rod that turns, in steps of 9°, over and over in a thread: two a second, until the function is
    called."""
    (rows, columns), over, fast = SHAPES[fps], threading.Event(), threading.Event()
    across = np.arange(columns) - columns / 2 - 0.1 * columns * np.cos(np.radians(9 * np.arange(20)))[:, np.newaxis]
    thickness = np.sqrt(np.clip(1 - (across / (0.3 * columns)) ** 2, 0, None))
    lines = (100 + 40000 * np.exp(-thickness)).astype(np.uint16)
    views = [np.broadcast_to(line, (rows, columns)).copy() for line in lines]

    def send() -> None:
        for i in count():
            ioc.post(array_value(views[i % 20], i + 1))
            if over.wait(1 / fps if fast.is_set() else 0.5):
                return

    thread = threading.Thread(target=send)
    thread.start()
    try:
        yield fast.set
    finally:
        over.set()
        thread.join()


def _seconds(reached: Callable[[], bool], ride: RideProgram) -> float:
    """How long it took, in s of a free core: this thread, which takes its share beside the others, tells how slow the
    computer is."""
    begin, own, spun = time.monotonic(), 0.0, 0.0
    while not reached():
        assert time.monotonic() < begin + 60, ride.output
        since, spent = time.monotonic(), time.thread_time()
        while time.thread_time() < spent + 0.002:
            pass
        own, spun = own + time.thread_time() - spent, spun + time.monotonic() - since
        time.sleep(0.02)
    return (time.monotonic() - begin) * (own / spun if spun else 1.0)


@pytest.mark.parametrize(
    ("number", "fps"),
    [
        (signal.SIGINT, 10),
        (signal.SIGTERM, 50),
        pytest.param(signal.SIGTERM, 10, marks=pytest.mark.long),
        pytest.param(signal.SIGINT, 50, marks=pytest.mark.long),
    ],
)
def test_a_stop_closes_the_file_and_a_second_ends_the_ride(tmp_path: Path, fps: int, number: signal.Signals) -> None:
    """The first is answered at once, closes the file, and says how long the live volume is waited for. Ctrl-C then ends
    the ride without it."""
    for name, light in (("darks", 100), ("flats", 40100)):
        np.save(tmp_path / f"{name}.npy", np.full((2, *SHAPES[fps]), light, np.uint16))
    given = [word for name in ("darks", "flats") for word in (f"--{name}", str(tmp_path / f"{name}.npy"))]
    angles = {"from": "plan", "views": 2000, "start_deg": 0, "step_deg": 9}
    with FakeIoc() as ioc, RideProgram(tmp_path, ioc.url, *given, period_s=1 / fps, angles=angles) as ride:
        with _sending(ioc, fps) as full_speed:
            ride.wait_for(lambda: "The live reconstruction is ready" in ride.output)
            before = ride.frames()
            full_speed()
            ride.wait_for(lambda: ride.frames() > before + fps)
            ride.process.send_signal(number)
            begin = time.monotonic()
            answered = _seconds(lambda: "Stopping cleanly" in ride.output, ride)
            closed = answered + _seconds(lambda: "Waiting for the live volume" in ride.output, ride)
            ride.process.send_signal(signal.SIGINT)
            ended = _seconds(lambda: ride.process.poll() is not None, ride)
        print(f"answered after {answered:.2f} s, file closed after {closed:.2f} s; ended {ended:.2f} s after Ctrl-C")
        assert ride.exit_code() == 4 and "Aborting" in ride.output, ride.output
    assert answered < WITHIN and closed < WITHIN and ended < WITHIN and time.monotonic() - begin < LATEST
    (file,) = stored(tmp_path)
    assert file.status == "stopped" and file.ids.tolist() == [-1] * 4 + [*range(1, len(file.ids) - 3)]
