"""Seeded schedules of faults, pauses, beam losses, stops, aborts: every scan ends by name, safe, with true angles."""

from __future__ import annotations

import numpy as np
import pytest

from beamline.core.errors import InstrumentError
from beamline.core.stop import ScanAborted, ScanStopped, StopRequest
from beamline.plan.plan import Mode, Place
from beamline.scan.ledger import LedgerError
from drivers.errors import DeviceError
from drivers.frame import FrameKind
from tests.beamline.acquired import assert_safe, assert_true_angles
from tests.beamline.fakes import Faults
from tests.beamline.scan.test_acquisition_paused import FIRST, Paused

N = 24
SECONDS = 14.0  # virtual s: longer than any of these scans without pauses


def scheduled(seed: int) -> None:
    rng = np.random.default_rng(seed)

    def some(most: int) -> set[int]:
        return {int(i) for i in FIRST + rng.choice(N, rng.integers(0, most + 1), replace=False)}

    faults = Faults(lost=some(2), ignored=some(2), extra_after=some(1), errors=dict.fromkeys(some(1), 1))
    stop = StopRequest()
    paused = Paused(faults, stop)
    clock, begun = paused.instrument.clock, paused.instrument.clock.now()
    acts = [paused.pause.pause, lambda: paused.pause.no_beam("no beam", clock.now() - rng.uniform(0, 2))]
    planned = [(float(rng.uniform(0, SECONDS)), acts[int(rng.integers(2))]) for _ in range(rng.integers(0, 4))]
    if rng.random() < 0.3:
        planned.append((float(rng.uniform(0, SECONDS)), stop.abort if rng.random() < 0.5 else stop.stop))
    due, sleep = sorted(planned, key=lambda act: act[0]), clock.sleep

    def on_the_way(seconds: float) -> None:
        sleep(seconds)
        while due and clock.now() - begun >= due[0][0]:
            due.pop(0)[1]()

    clock.sleep = on_the_way  # type: ignore[method-assign]
    mode, passes = ((Mode.FLY, 1), (Mode.FLY, 3), (Mode.STEP, 1))[int(rng.integers(3))]
    run = paused.run(N, mode, passes, at=Place.BOTH)
    assert run.error is None or isinstance(
        run.error, LedgerError | ScanStopped | ScanAborted | InstrumentError | DeviceError
    ), seed
    assert_safe(paused.instrument, home=False)
    assert all(paused.at_rest)
    assert_true_angles(run)
    assert [frame.index for frame in run.frames] == list(range(len(run.frames)))
    replaced = {frame.replaces for frame in run.frames}
    views = [f.trigger for f in run.of(FrameKind.PROJECTION) if f.index not in replaced]
    missing = [row - FIRST for row in run.scan.missing if FIRST <= row < FIRST + N]
    assert len(views) == len(set(views)), seed
    assert not set(views) & set(missing), seed
    if run.error is None or isinstance(run.error, LedgerError):
        assert set(views) | set(missing) == set(range(N)), seed


def test_a_few_schedules() -> None:
    for seed in range(10):
        scheduled(seed)


@pytest.mark.slow
@pytest.mark.parametrize("first", range(10, 510, 50))
def test_five_hundred_schedules(first: int) -> None:
    for seed in range(first, first + 50):
        scheduled(seed)
