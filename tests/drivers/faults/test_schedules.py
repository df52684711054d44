"""Random schedules (seeded) of failing ports, unplugged cameras, lost pulses, pauses and stops.

Every scan ends in a named state, as safe as its dead ports allow, without a thread, and with a file that says the
truth.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from beamline.core.errors import DataError, ScanStopped
from beamline.core.stop import Cause, ScanAborted, StopRequest
from beamline.features.files.validate import validate
from beamline.scan.control import State
from beamline.scan.ledger import LedgerError
from beamline.scan.moves import SAFE, UNSAFE
from beamline.storage.readers.open import SourceOptions
from drivers.base.errors import DeviceError
from drivers.base.frame import FrameKind
from tests.drivers.faults.rig import DARKS, FLATS, KINDS, VIEWS, Rig, Scanned

RigOf = Callable[[str], Rig]
REQUESTS = 400  # more than a scan without a fault makes
FIRST_VIEW = DARKS + FLATS
ENDS: dict[type[Exception], State] = {ScanAborted: State.ABORTED, ScanStopped: State.STOPPED}


def scheduled(rig_of: RigOf, runs: Path, seed: int) -> State | None:
    """Returns the state in which the run ended; None: it never began."""
    rng = np.random.default_rng(seed)
    rig = rig_of(list(KINDS)[int(rng.integers(len(KINDS)))])
    stop, threads = StopRequest(), set(threading.enumerate())
    pulled, frames = list[bool](), FIRST_VIEW + VIEWS

    def pull() -> None:
        pulled.append(True)
        rig.cable.pull()

    def drop_in(acts: list[Callable[[], object]], share: float) -> None:
        """Before a request, or after a frame, by chance."""
        for act in acts:
            if rng.random() < share:
                at_request = rng.random() < 0.5
                where = rig.cable.at_request if at_request else rig.at_frame
                where[int(rng.integers(REQUESTS if at_request else frames))] = act

    drop_in([pull], 0.6)
    if rng.random() < 0.4:  # after some more requests that fail
        first = min(rig.cable.at_request, default=int(rng.integers(REQUESTS)))
        rig.cable.at_request[first + 1 + int(rng.integers(6))] = rig.cable.plug
    drop_in([lambda: rig.world.fault("unplugged")], 0.3)
    drop_in([stop.stop, stop.abort], 0.2)
    drop_in([lambda: rig.pause.pause(), lambda: rig.pause.hold(Cause.BACKLOG, "a slow disk")], 0.6)
    drop_in([lambda: rig.pause.no_beam("no beam", rig.clock.now() - rng.uniform(0, 0.4))], 0.3)
    drop_in([rig.go_on], 0.2)
    happens = [pull, rig.cable.plug, lambda: rig.world.fault("unplugged"), stop.stop, stop.abort]
    for _ in range(rng.integers(0, 4)):
        rig.in_pause.append(happens[int(rng.integers(5))] if rng.random() < 0.3 else lambda: None)
    if rng.random() < 0.3:
        rig.trigger_cable.lost = {int(k) for k in rng.choice(VIEWS, 2, replace=False)}

    mode = f"scan.mode={'step' if rng.random() < 0.3 else 'fly'}"
    scanned = rig.scan(runs, mode, stop=stop)
    error = scanned.error
    assert error is None or isinstance(error, DeviceError | DataError | ScanStopped), (seed, error)
    assert rig.world.live == 0, f"{seed}: the camera's library is still open"
    late = set(threading.enumerate()) - threads
    for thread in late:
        thread.join(60)
    assert not any(thread.is_alive() for thread in late), seed
    if scanned.folder is None:
        assert error is not None and not rig.moving and not rig.shutter_open, (seed, error)
        return None
    states = [event.data["state"] for event in scanned.of("state")]
    expected = State.DONE if error is None else ENDS.get(type(error), State.FAILED)
    assert states[-1] == expected, (seed, states, error)
    said = [event.data["message"] for event in scanned.of("state") if event.data["state"] == State.FINISHING]
    if said == [SAFE]:
        assert not rig.moving and not rig.shutter_open, f"{seed}: it says that it is safe"
    else:
        assert said == [UNSAFE] and pulled, (seed, said, error)
    assert_true(scanned, seed)
    return State(states[-1])


def assert_true(scanned: Scanned, seed: int) -> None:
    """The file is readable, its rows have their own angles, and it does not pass for a whole scan unless it is one."""
    assert scanned.folder is not None
    rows, error = scanned.rows(), scanned.error
    views = rows[FrameKind.PROJECTION]
    assert len(views) == len(set(views)), seed
    done = scanned.of("scan_done")[0].data
    missing = {index - FIRST_VIEW for index in done["missing"]}
    assert not missing & set(views), seed
    whole = set(views) == set(range(VIEWS))
    if error is None:
        assert whole and scanned.status() == "complete", seed
    elif isinstance(error, LedgerError):
        assert set(views) | missing == set(range(VIEWS)), seed
    assert (scanned.status() == "complete") == (error is None), seed
    findings = {finding.severity for finding in validate(SourceOptions(scanned.folder / "scan.h5"))}
    if not whole:
        assert findings & {"error", "warning"}, f"{seed}: it validates, with {len(views)} of {VIEWS} views"


def test_a_few_schedules(rig_of: RigOf, tmp_path: Path) -> None:
    assert {scheduled(rig_of, tmp_path / str(seed), seed) for seed in range(2)} - {None}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("first", "last"), [(8, 16), *(pytest.param(*seeds, marks=pytest.mark.long) for seeds in ((2, 8), (16, 42)))]
)
def test_many_schedules(rig_of: RigOf, tmp_path: Path, first: int, last: int) -> None:
    ends = [scheduled(rig_of, tmp_path / str(seed), seed) for seed in range(first, last)]
    assert {State.DONE, State.STOPPED, State.FAILED} <= set(ends)
