"""CPU time of the monitor per frame of 2304 x 4096 pixels; pytest -m bench -s tests/bench/test_monitor_cost.py.

All in processor time of one core, medians, and as ratios to one pass over the same bytes in the same run: the sum of
the pixels, which does nothing but read them.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from beamline.monitor import watch
from beamline.monitor.check import ScanContext
from beamline.monitor.checks import CHECKS
from beamline.monitor.digest import FrameDigest, digest
from drivers.base.frame import Frame
from tests.beamline.monitor.blobs import COLS, ROWS, Blobs

SHAPE, BIN = (2304, 4096), 8  # as in configs/instrument.yaml
WARM, VIEWS = 40, 60
FULL = 20_000


def _frames(n: int) -> list[tuple[Frame, FrameDigest]]:
    """Darks, flats and views of a turning sample whose previews have the size of a large frame's; no pixels."""
    scale = SHAPE[0] // BIN // ROWS, SHAPE[1] // BIN // COLS
    counts = np.broadcast_to(np.uint16(0), SHAPE)
    frames = []
    for frame, found in Blobs(n, step=np.pi / 1800).frames():
        preview = np.kron(found.preview, np.ones(scale, np.float32))
        seen = replace(found, preview=preview, peaks=preview + 3 * np.sqrt(preview))
        frames.append((replace(frame, counts=counts), seen))
    return frames


def _processor_ms(call: Callable[[], object], repeats: int = 15) -> float:
    call()
    times = []
    for _ in range(repeats):
        begin = time.process_time()
        call()
        times.append((time.process_time() - begin) * 1e3)
    return float(np.median(times))


def _looks(checks: tuple[object, ...]) -> float:
    """ms a view of all checks together, when all have what they need."""
    monitor, times = watch.start(ScanContext(65535, SHAPE[0] * SHAPE[1], 0.1), checks), list[float]()  # type: ignore[arg-type]
    for frame, found in _frames(WARM + VIEWS):
        begin = time.process_time()
        monitor, _ = watch.look(monitor, frame, found)
        times.append((time.process_time() - begin) * 1e3)
    return float(np.median(times[-VIEWS:]))


@pytest.mark.bench
def test_a_frame_of_2304_x_4096(capsys: pytest.CaptureFixture[str]) -> None:
    image = (200 + np.random.default_rng(0).poisson(FULL / 4, SHAPE)).astype(np.uint16)
    assert _frames(1)[-1][1].preview.shape == digest(image, 65535, BIN).preview.shape
    one_pass = _processor_ms(lambda: image.sum(dtype=np.uint64))
    whole = _processor_ms(lambda: digest(image, 65535, BIN))
    every, none = _looks(CHECKS), _looks(())
    with capsys.disabled():
        print(f"\n{SHAPE[0]} x {SHAPE[1]} pixels, preview of {BIN} x {BIN}; one pass {one_pass:.1f} ms")
        for name, ms in (("digest", whole), ("all checks", every), ("digest and checks", whole + every)):
            print(f"| {name} | {ms:.2f} ms | {ms / one_pass:.2f} passes |")
        print(f"| what all checks share | {none:.2f} ms |")
        for check in CHECKS:
            print(f"| {check.name} | {_looks((check,)) - none:.2f} ms |")
