"""Checks after any fault: one complete error, an instrument at rest, a file, and a working next scan."""

from __future__ import annotations

import re
from pathlib import Path

from beamline.scan.control import State
from beamline.scan.moves import SAFE, UNSAFE
from drivers.base.errors import DeviceError
from drivers.base.frame import FrameKind
from tests.drivers.faults.rig import DARKS, FLATS, VIEWS, Rig, Scanned

PARTS = ("device", "problem", "request", "expected", "advice", "state")


def assert_speaks(error: BaseException | None, device: str, replied: bool = True) -> None:
    """Assert that an error names device, request, reply, expectation, remedy, and what has (not) moved."""
    assert isinstance(error, DeviceError), error
    assert error.device == device
    wanted = (*PARTS, "reply") if replied else PARTS
    silent = [part for part in wanted if not getattr(error, part)]
    assert silent == [], f"no {', '.join(silent)} in: {error}"
    quoted = [repr(getattr(error, part)) for part in ("request", "reply") if part in wanted]
    assert all(part in str(error) for part in quoted)
    assert all(getattr(error, part).rstrip(".") in str(error) for part in PARTS if part != "request")


def assert_reported_once(scanned: Scanned) -> None:
    """Assert that the run fails once, with the words of its error, and that this error is not also a warning."""
    assert scanned.error is not None
    assert [event.data["message"] for event in scanned.of("failed")] == [str(scanned.error)]
    assert str(scanned.error) not in scanned.warnings


def assert_at_rest(rig: Rig, scanned: Scanned) -> None:
    """Assert that the stage stands still, shutter and library are closed, and the run reports a safe state."""
    assert not rig.moving
    assert not rig.shutter_open
    assert rig.world.live == 0
    messages = [event.data["message"] for event in scanned.of("state") if event.data["state"] == State.FINISHING]
    assert messages == ([] if scanned.folder is None else [SAFE])


def assert_known_to_be_unsafe(rig: Rig, scanned: Scanned) -> None:
    """Assert that the run says that it can do nothing, because the line is gone."""
    assert rig.world.live == 0
    messages = [event.data["message"] for event in scanned.of("state") if event.data["state"] == State.FINISHING]
    assert messages == [UNSAFE]
    text = " ".join([*scanned.warnings, str(scanned.error)])
    assert "The device may still be carrying out the earlier request" in text
    if rig.shutter_open:
        assert "shutter: it could not be closed" in text
        assert "before anybody goes near the beam" in text


def assert_kept(scanned: Scanned, views: list[int] | None = None, invalid: int = 0) -> None:
    """Assert a readable file with darks, flats and these projections (None: the first ones, any number)."""
    rows = scanned.rows()
    taken = rows[FrameKind.PROJECTION]
    assert taken == (list(range(len(taken))) if views is None else views)
    assert len(rows[FrameKind.INVALID]) == invalid
    if taken:
        assert (len(rows[FrameKind.DARK]), len(rows[FrameKind.FLAT])) == (DARKS, FLATS)
    done = scanned.of("scan_done")[0].data
    assert done["n_frames"] == sum(map(len, rows.values()))
    assert scanned.status() == "failed"


def assert_complete(scanned: Scanned) -> None:
    assert scanned.error is None, scanned.error
    assert scanned.rows()[FrameKind.PROJECTION] == list(range(VIEWS))
    assert scanned.status() == "complete"


def assert_next_scan_works(rig: Rig, runs: Path, tells: str = "") -> None:
    """Assert that the next scan works in the same process with the same controller and library.

    Args:
        tells: regular expression for what the controller still remembers of the fault. The next scan warns about it,
            the one after does not. "": no scan has a warning.
    """
    rig.clock.sleep(30.0)  # a stage that could not be stopped comes to rest by itself
    rig.repair()
    for words in (tells, "") if tells else ("",):
        scanned = rig.scan(runs)
        assert_complete(scanned)
        if words:
            (warning,) = scanned.warnings
            assert re.fullmatch(rf"stage: this program found the device in this state: {words}\.", warning), warning
        else:
            assert scanned.warnings == []
        assert_at_rest(rig, scanned)
