"""Seeded schedules of faults of camera, stage and disk, pauses, beam losses, stops, aborts.

Every scan ends by name, safe, with true angles.
"""

import numpy as np
import pytest

from beamline.core.errors import DataError, InstrumentError, ScanStopped
from beamline.core.stop import Cause, ScanAborted, StopRequest
from beamline.plan.plan import Mode, Place
from beamline.scan.ledger import LedgerError
from drivers.base.errors import DeviceError
from drivers.base.frame import FrameKind
from tests.beamline.acquired import assert_safe
from tests.beamline.fakes import Faults, assert_true
from tests.beamline.scan.test_acquisition_paused import FIRST, Paused

N = 24
SECONDS = 14.0  # virtual s: longer than any of these scans without pauses


def scheduled(seed: int) -> None:
    rng = np.random.default_rng(seed)

    def some(most: int) -> set[int]:
        return {int(i) for i in FIRST + rng.choice(N, rng.integers(0, most + 1), replace=False)}

    rare = rng.random(3) < 0.1
    # A camera that fails once is asked again; one that fails twice is unplugged, and so is a stage that stalls.
    faults = Faults(
        lost=some(2),
        ignored=some(2),
        extra_after=some(1),
        errors=dict.fromkeys(some(1), 2 if rare[0] else 1),
        stall_at=int(rng.integers(0, 18000)) if rare[1] else None,
    )
    stop = StopRequest()
    paused = Paused(faults, stop)

    def full() -> None:
        raise DataError("The disk is full.")

    paused.instrument.at = {int(rng.integers(0, FIRST + N)): full} if rare[2] else {}
    clock, begun = paused.instrument.clock, paused.instrument.clock.now()
    acts = [
        paused.pause.pause,
        lambda: paused.pause.no_beam("no beam", clock.now() - rng.uniform(0, 2)),
        lambda: paused.pause.hold(Cause.BACKLOG, "a slow disk"),
        lambda: paused.pause.release(Cause.BACKLOG),
    ]
    planned = [(float(rng.uniform(0, SECONDS)), acts[int(rng.integers(4))]) for _ in range(rng.integers(0, 5))]
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
        run.error, DataError | ScanStopped | ScanAborted | InstrumentError | DeviceError
    ), seed
    assert_safe(paused.instrument, home=False)
    assert all(paused.at_rest)
    assert_true(run.frames)
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
def test_many_schedules() -> None:
    for seed in range(10, 260):
        scheduled(seed)
