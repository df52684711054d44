"""Camera faults: at each library call, and of frames, triggers and links."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from beamline.scan.ledger import LedgerError
from drivers.dcam.abi import ARGUMENTS, DcamError
from drivers.dcam.codes import Error, Property
from drivers.stages.pm16c.stage import PM16CStage
from tests.drivers.dcam.fake import World
from tests.drivers.faults import table
from tests.drivers.faults.aftermath import (
    assert_at_rest,
    assert_complete,
    assert_kept,
    assert_next_scan_works,
    assert_reported_once,
    assert_speaks,
)
from tests.drivers.faults.rig import DARKS, VIEWS, Rig, Scanned
from tests.slow_cases import others_slow

RigOf = Callable[..., Rig]
ROWS = {row.fault: row for row in table.CAMERA}
AT_CONNECTING = {"dcamapi_init", "dcamdev_open", "dcamwait_open"}
"""Calls that no scan makes once its devices are open."""
AFTER_A_REFUSAL = {"dcamprop_queryvalue"}
"""It only tells which values are legal; the driver's own tests let it fail."""


@pytest.fixture
def rig(rig_of: RigOf) -> Rig:
    return rig_of(table.CAMERA_KIND)


def assert_ends_as(fault: str, scanned: Scanned) -> None:
    assert isinstance(scanned.error, ROWS[fault].error), scanned.error
    assert ROWS[fault].words in str(scanned.error)


def assert_not_begun(rig: Rig, scanned: Scanned, runs: Path) -> None:
    assert scanned.folder is None
    assert_at_rest(rig, scanned)
    assert_next_scan_works(rig, runs)


def assert_lost(rig: Rig, scanned: Scanned, runs: Path, fault: str) -> list[int]:
    """Returns the views that the error names; all others are kept."""
    assert_ends_as(fault, scanned)
    assert isinstance(scanned.error, LedgerError)
    lost = [index - table.FIRST_VIEW for index in scanned.error.missing]
    assert_reported_once(scanned)
    assert_at_rest(rig, scanned)
    assert_kept(scanned, [view for view in range(VIEWS) if view not in lost])
    assert_next_scan_works(rig, runs)
    return lost


def test_every_camera_fault_of_the_table_has_a_test() -> None:
    tested = {
        fault for name in globals() if name.startswith("test_") for fault in name.removeprefix("test_").split("_or_")
    }
    assert {fault.replace(" ", "_") for fault in ROWS} <= tested


def test_camera_absent_at_start(rig: Rig, tmp_path: Path) -> None:
    rig.world.fault("no_camera")
    scanned = rig.scan(tmp_path)
    assert_ends_as("camera absent at start", scanned)
    assert_speaks(scanned.error, "camera")
    assert "Switch the camera on" in str(scanned.error)
    assert_not_begun(rig, scanned, tmp_path)


CALLS = sorted(set(ARGUMENTS) - AT_CONNECTING - AFTER_A_REFUSAL)


@pytest.fixture(scope="module")
def calls_of_a_scan(library: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, int]:
    """Of each kind, from the moment when all devices are open, in a scan without a fault."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        world = World(library)
        rig = Rig(world, monkeypatch, table.CAMERA_KIND)
        before: list[dict[str, int]] = []
        rig.after_connecting = lambda: before.append({call: world.calls(call) for call in CALLS})
        assert_complete(rig.scan(tmp_path_factory.mktemp("runs")))
        return {call: world.calls(call) - before[0][call] for call in CALLS}


@pytest.mark.parametrize("call", others_slow(CALLS, 3))
def test_an_error_of_the_library(rig: Rig, call: str, calls_of_a_scan: dict[str, int], tmp_path: Path) -> None:
    """Of one call the first of a scan, of the next a middle one, of the third the last (the driver's own tests let each
    fail): the scan ends with that error; or, where it came while frames were waited for, it is reported and nothing is
    lost, or what is lost is named."""
    n = calls_of_a_scan[call]
    assert n > 0
    nth = (1, (n + 1) // 2, n)[CALLS.index(call) % 3]
    rig.after_connecting = lambda: rig.world.fail(call, Error.FAILREADCAMERA, nth)
    scanned = rig.scan(tmp_path)
    reports = [message for message in scanned.warnings if "FAILREADCAMERA" in message]
    if scanned.error is None or isinstance(scanned.error, LedgerError):
        assert len(reports) == 1 and call in reports[0]
        assert_complete(scanned) if scanned.error is None else assert_reported_once(scanned)
    else:
        assert_ends_as("an error of the library", scanned)
        assert isinstance(scanned.error, DcamError)
        assert scanned.error.code == Error.FAILREADCAMERA
        assert scanned.error.request.split()[0] == call
        assert_speaks(scanned.error, "camera")
        assert reports == []
    assert_at_rest(rig, scanned)
    assert_next_scan_works(rig, tmp_path)


@pytest.mark.parametrize("call", sorted(AT_CONNECTING))
def test_an_error_of_the_library_at_connecting(rig: Rig, call: str, tmp_path: Path) -> None:
    rig.world.fail(call, Error.FAILREADCAMERA)
    scanned = rig.scan(tmp_path)
    assert_speaks(scanned.error, "camera")
    assert_not_begun(rig, scanned, tmp_path)


def test_frame_lost_in_the_camera_or_slow_link(rig: Rig, tmp_path: Path) -> None:
    """The scan names them, and that the link may be too slow."""
    rig.world.lose(3, 7)
    scanned = rig.scan(tmp_path)
    assert_ends_as("slow link", scanned)
    assert assert_lost(rig, scanned, tmp_path, "frame lost in the camera") == [3, 7]
    assert "delivered by the camera: 2 frames" in str(scanned.error)


def test_ring_overrun(rig_of: RigOf, tmp_path: Path) -> None:
    """A ring of two frames, and a computer that does nothing for four and a half periods after view 4."""
    rig = rig_of(table.CAMERA_KIND, sensor=(512, 512))
    rig.at_frame[table.FIRST_VIEW + 4] = lambda: rig.clock.sleep(0.45)
    scanned = rig.scan(tmp_path)
    (warning,) = scanned.warnings
    assert re.search(r"the ring buffer of 2 frames was overrun and \d frames are lost", warning)
    lost = assert_lost(rig, scanned, tmp_path, "ring overrun")
    assert lost == list(range(5, 5 + len(lost))) and 2 <= len(lost) <= 4


def test_camera_unplugged(rig: Rig, tmp_path: Path) -> None:
    rig.world.fault("unplug_at", 5)
    scanned = rig.scan(tmp_path)
    assert_ends_as("camera unplugged", scanned)
    assert_speaks(scanned.error, "camera")
    assert_reported_once(scanned)
    assert_at_rest(rig, scanned)
    assert_kept(scanned)
    assert_next_scan_works(rig, tmp_path)


def test_triggers_planned_too_fast(rig: Rig, tmp_path: Path) -> None:
    scanned = rig.scan(tmp_path, "scan.period_s=0.005", "scan.angles.span_deg=1")
    assert_ends_as("triggers planned too fast", scanned)
    assert "nothing was started" in str(scanned.error)
    assert_not_begun(rig, scanned, tmp_path)


def test_triggers_too_fast(rig: Rig, tmp_path: Path) -> None:
    """It needs longer than it reports, and silently ignores every second pulse."""
    reported = rig.world.value(Property.TIMING_MINTRIGGERINTERVAL)
    rig.at_frame[0] = lambda: rig.world.override(Property.TIMING_MINTRIGGERINTERVAL, 0.15)
    scanned = rig.scan(tmp_path)
    assert "A longer period_s gives the camera more time" in str(scanned.error)
    rig.world.override(Property.TIMING_MINTRIGGERINTERVAL, reported)
    assert assert_lost(rig, scanned, tmp_path, "triggers too fast") == list(range(1, VIEWS, 2))


def test_triggers_that_the_camera_reports_as_too_fast(rig: Rig, tmp_path: Path) -> None:
    rig.at_frame[table.FIRST_VIEW] = lambda: rig.world.fail("dcamwait_start", Error.TOOFREQUENTTRIGGER)
    scanned = rig.scan(tmp_path)
    assert_complete(scanned)  # nothing was lost, but somebody should know
    (warning,) = scanned.warnings
    assert re.search(r"TOOFREQUENTTRIGGER.*Turn the stage more slowly", warning)
    assert_next_scan_works(rig, tmp_path)


@pytest.mark.parametrize("when", ["before the scan", "between darks and flats"])
def test_setting_refused(rig: Rig, when: str, tmp_path: Path) -> None:
    def refuse() -> None:
        rig.world.fault("refuse", Property.EXPOSURETIME)

    if when == "before the scan":
        rig.after_connecting = refuse
    else:
        rig.at_frame[DARKS - 1] = refuse
    scanned = rig.scan(tmp_path)
    assert_ends_as("setting refused", scanned)
    assert_speaks(scanned.error, "camera")
    assert_at_rest(rig, scanned)
    if when == "before the scan":
        assert scanned.folder is None
    else:
        assert_reported_once(scanned)
        assert_kept(scanned, [])
    assert_next_scan_works(rig, tmp_path)


def test_a_camera_that_says_that_its_link_is_slow_makes_the_plan_be_refused(rig: Rig, tmp_path: Path) -> None:
    rig.world.override(Property.INTERNAL_FRAMEINTERVAL, 0.5)
    scanned = rig.scan(tmp_path)
    assert_ends_as("triggers planned too fast", scanned)
    rig.world.override(Property.INTERNAL_FRAMEINTERVAL, 0.01)
    assert_not_begun(rig, scanned, tmp_path)


def test_the_camera_captures_before_the_stage_is_armed_and_until_it_is_disarmed(
    rig: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A pulse that comes before the camera is ready is lost without a word."""
    capturing: dict[str, list[bool]] = {"arm": [], "disarm": []}

    def spied(call: str) -> None:
        real = getattr(PM16CStage, call)

        def spy(*arguments: object) -> object:
            capturing[call].append(rig.world.calls("dcamcap_start") - rig.world.calls("dcamcap_stop") == 1)
            return real(*arguments)

        monkeypatch.setattr(PM16CStage, call, spy)

    for call in capturing:
        spied(call)
    passes = f"scan.angles={{scheme: interlaced, views: {VIEWS}, passes: 3, start_deg: 60, span_deg: {VIEWS}}}"
    assert rig.scan(tmp_path, passes).error is None
    assert capturing["arm"] == capturing["disarm"][:3] == [True] * 3
