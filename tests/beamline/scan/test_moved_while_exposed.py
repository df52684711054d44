"""A step scan whose stage is moved after arrival, by anything: no projection has a wrong angle."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from beamline.core.errors import InstrumentError
from beamline.core.events import Event
from beamline.core.run_result import RunResult
from beamline.core.stop import StopRequest
from beamline.features.files.validate import validate
from beamline.features.tuning.align import _blocks
from beamline.features.tuning.tune import take
from beamline.instrument import connect as devices
from beamline.scan.ledger import LedgerError
from beamline.scan.run import run_scan
from drivers.base.clock import Clock
from drivers.base.frame import FrameKind
from drivers.base.protocols import Camera
from simulators.wires.wire import plugged
from tests.beamline.ball_scan import COMMON, STAGES, small
from tests.slow_cases import others_slow

pytestmark = pytest.mark.usefixtures("simulated_zaber")

KINDS = {name: STAGES[name] for name in ("pm16c", "pi_gcs", "zaber")} | {
    "epics": f"{{kind: epics, port: 'sim://epics', {COMMON}}}"
}
WORDS = ("scan.mode=step", "recon.live=false", "scan.darks={count: 2}", "scan.flats={count: 2}", "scan.settle_s=0.1")
VIEWS, MOVED, FIRST = 9, 4, 4  # the view that is moved, and the row of the first one
THREE = 3 * 360_000 // 360  # counts

Disturb = Callable[[Any, Clock, float], None]
"""Acts on the simulated controller of a stage, on its clock, at a time."""


def axis_of(controller: Any) -> Any:
    """The motor behind the wire, whatever the controller is."""
    for path in ("device.axis", "box.sample", "box.axis", "motor"):
        found = controller
        for name in path.split("."):
            found = getattr(found, name, None)
        if found is not None:
            return found
    raise AssertionError(f"{controller} has no axis")


def touched(controller: Any, clock: Clock, now: float) -> None:
    axis_of(controller).disturb(lambda time: THREE if time >= now else 0)


def goes_on(controller: Any, clock: Clock, now: float) -> None:
    axis_of(controller).disturb(lambda time: THREE * min(max(time - now, 0) / 0.05, 1))


def hunts(controller: Any, clock: Clock, now: float) -> None:
    axis_of(controller).disturb(lambda time: THREE * math.sin(7.3 * (time - now)) if time >= now else 0)


def second_client(controller: Any, clock: Clock, now: float) -> None:
    """A move that the status tells of, and that begins with the exposure."""
    axis = axis_of(controller)
    match type(axis).__name__:
        case "SimulatedZaberAxis":
            axis.start(now, axis.position(now) + THREE)
        case "GcsAxis":
            axis.move_to(axis.position() + 3.0)
        case _:
            axis.start(axis.position() + THREE, THREE / 0.5, 20 * THREE)


WAYS: dict[str, Disturb] = {
    "touched": touched,
    "goes on": goes_on,
    "hunts": hunts,
    "second client": second_client,
}


class Nudged:
    """A camera whose software trigger disturbs the stage, from `at` on for `times` exposures: as if in the exposure."""

    def __init__(self, camera: Camera, disturb: Callable[[float], None], clock: Clock, at: int, times: int) -> None:
        self._camera, self._disturb, self._clock = camera, disturb, clock
        self._at, self._end, self._n = at, at + times, -1

    def software_trigger(self) -> None:
        self._n += 1
        if self._at <= self._n < self._end:
            self._disturb(self._clock.now())
        self._camera.software_trigger()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._camera, name)


def nudged(
    instrument: devices.ConnectedDevices, disturb: Disturb, at: int, times: int, stage: Any = None
) -> devices.ConnectedDevices:
    """`stage`: the one that is disturbed; None: the one that turns the sample."""
    stage = stage or instrument.devices.stage
    controller = plugged("sim://" + str(stage.describe()["port"]).rpartition("sim://")[2])
    clock = instrument.clock
    camera: Any = Nudged(instrument.devices.camera, lambda now: disturb(controller, clock, now), clock, at, times)
    return replace(instrument, devices=replace(instrument.devices, camera=camera))


def scanned(
    stage: str, disturb: Disturb, folder: Path, times: int, *words: str
) -> tuple[RunResult | None, BaseException | None, list[Event], Path]:
    settings = small(f"devices.stage={stage}", f"scan.angles={{scheme: fixed, views: {VIEWS}}}", *WORDS, *words)
    events: list[Event] = []
    result, error = None, None
    with devices.connect(settings) as instrument:
        used = nudged(instrument, disturb, FIRST + MOVED, times)
        try:
            result = run_scan(settings, folder, [events.append], StopRequest(), instrument=used)
        except Exception as caught:
            error = caught
    (run,) = folder.iterdir()
    return result, error, events, run / "scan.h5"


@pytest.mark.parametrize(
    ("stage", "disturb"),
    others_slow([(kind, way) for kind in KINDS for way in WAYS if kind == "zaber" or way == "second client"], 2),
)
def test_a_view_during_which_it_is_moved_is_taken_again(stage: str, disturb: str, tmp_path: Path) -> None:
    result, error, events, path = scanned(KINDS[stage], WAYS[disturb], tmp_path, 1)
    assert error is None and result is not None and (result.retaken, result.missing) == (1, ())
    with h5py.File(path) as file:
        key = file["entry/instrument/detector/image_key"][()]
        angles = file["entry/sample/rotation_angle"][()]
        assert list(np.flatnonzero(key == FrameKind.INVALID)) == [FIRST + MOVED]
        assert file["entry/frame_log/replaces"][FIRST + MOVED + 1] == FIRST + MOVED
        assert list(file["entry/frame_log/trigger"][FIRST + MOVED : FIRST + MOVED + 2]) == [MOVED, MOVED]
    assert angles[key == 0] == pytest.approx(np.arange(VIEWS) * 20.0, abs=0.011)
    (said,) = [event.data["message"] for event in events if event.event == "warning"]
    assert said.startswith(
        f"Projection {MOVED}: the frame was exposed while the stage was not at the planned angle of 80.0000°"
    )
    assert [found.rule for found in validate(path) if found.severity == "error"] == []
    assert events[-1].event == "done" and [e for e in events if e.event == "frame"][-1].data["n"] == result.n_frames


@pytest.mark.parametrize(("kind", "disturb"), others_slow(zip(KINDS, WAYS.values(), strict=True), 2))
def test_one_that_is_moved_each_time_is_missing_and_named(kind: str, disturb: Disturb, tmp_path: Path) -> None:
    _, error, _, path = scanned(KINDS[kind], disturb, tmp_path, 3)
    assert isinstance(error, LedgerError) and error.missing == (FIRST + MOVED,)
    missing = "1 of 9 projections is missing: 4 (at 80°). For 1 of the missing projections, the stage was off the"
    assert missing in str(error)
    with h5py.File(path) as file:
        key = file["entry/instrument/detector/image_key"][()]
        assert list(file["entry/progress/missing_triggers"]) == [FIRST + MOVED]
        angles = file["entry/sample/rotation_angle"][()][key == 0]
    assert list(np.flatnonzero(key == FrameKind.INVALID)) == [FIRST + MOVED + k for k in range(3)]
    assert angles == pytest.approx(np.delete(np.arange(VIEWS) * 20.0, MOVED), abs=0.011)


@pytest.mark.parametrize("times", [1, 3])
def test_the_pairs_of_align_are_looked_at_too(times: int) -> None:
    settings = small(*WORDS)
    with devices.connect(settings) as instrument:
        used = nudged(instrument, touched, 8 + 2, times)  # the third view, after 4 darks and 4 flats
        asked = _blocks(0.1, [0.0, math.pi]), settings, used, StopRequest(), lambda event: None
        if times == 3:
            with pytest.raises(InstrumentError, match="For 1 of"):
                take(*asked)
            return
        frames, _ = take(*asked)
    views = [frame.angle for frame in frames if frame.kind is FrameKind.PROJECTION]
    assert np.degrees(views) == pytest.approx([0, 0, 180, 180], abs=0.011)


@pytest.mark.parametrize("kind", others_slow(KINDS))
def test_a_stage_that_stands_is_asked_twice_more_a_view_and_nothing_else_changes(kind: str, tmp_path: Path) -> None:
    result, error, events, _ = scanned(KINDS[kind], touched, tmp_path, 0)
    assert error is None and result is not None and result.n_frames == 4 + VIEWS
    assert not [event for event in events if event.event == "warning"]


MOVER = "devices.sample_mover={{kind: stage, in_deg: 0, out_deg: 12, speed_deg_s: 10, stage: {}}}"
FILTER = "devices.filter={{kind: stage, places: {{none: 0, Cu: 12}}, stage: {}}}"
MOVED_DEVICES = {"sample mover": (MOVER, "sample"), "filter": (FILTER, "filter")}


def motor_of(device: Any) -> Any:
    return (device._motor if hasattr(device, "_motor") else device)._stage


@pytest.mark.parametrize(
    ("kind", "device", "frame"), [("zaber", "sample mover", 2), ("epics", "filter", FIRST + MOVED)]
)
def test_a_device_in_the_beam_that_is_moved_ends_the_scan(kind: str, device: str, frame: int, tmp_path: Path) -> None:
    words, name = MOVED_DEVICES[device]
    settings = small(f"scan.angles={{scheme: fixed, views: {VIEWS}}}", *WORDS, words.format(KINDS[kind]))
    with devices.connect(settings) as instrument:
        used = nudged(instrument, touched, frame, 1, motor_of(getattr(instrument.devices, name)))
        block, first = ("flats", 2) if frame == 2 else ("projections", 4)
        rows = f"frames {first}-{3 if frame == 2 else 12} of the file"
        with pytest.raises(
            InstrumentError, match=rf"{device}:.*is now at.*The device was moved while.*{block} \({rows}\)"
        ):
            run_scan(settings, tmp_path, instrument=used)
    (run,) = tmp_path.iterdir()
    with h5py.File(run / "scan.h5") as file:
        assert file["entry/progress/status"][()] == b"failed"


def within(controller: Any, clock: Clock, now: float) -> None:
    axis_of(controller).disturb(lambda time: 5)


def test_a_motor_within_its_tolerance_of_a_place_is_there(tmp_path: Path) -> None:
    """5 counts off with a tolerance of 10: the file has the filter, and neither motor is moved again."""
    stage, flats = KINDS["pi_gcs"], "scan.flats={count: 2, at: both}"
    settings = small("scan.angles={scheme: fixed, views: 3}", *WORDS, MOVER.format(stage), FILTER.format(stage), flats)
    with devices.connect(settings) as instrument:
        for device in (instrument.devices.sample, instrument.devices.filter):
            port = str(motor_of(device).describe()["port"])
            within(plugged("sim://" + port.rpartition("sim://")[2]), instrument.clock, 0.0)
        mover: Any = instrument.devices.sample
        before = motor_of(mover).position()
        mover.back()
        assert motor_of(mover).position() == before
        assert instrument.devices.filter is not None and instrument.devices.filter.place() == "none"
        result = run_scan(settings, tmp_path, instrument=instrument)
    with h5py.File(result.path) as file:
        assert file["entry/instrument/filter/type"].asstr()[()] == "none"


@pytest.mark.parametrize(("at", "kind"), [(0, "darks"), (FIRST + 2, "projections")])
def test_a_shutter_that_moves_by_itself_ends_the_scan(at: int, kind: str, tmp_path: Path) -> None:
    settings = small(f"scan.angles={{scheme: fixed, views: {VIEWS}}}", *WORDS)
    with devices.connect(settings) as instrument:
        shutter = instrument.devices.shutter

        def by_itself(controller: Any, clock: Clock, now: float) -> None:
            shutter.open() if kind == "darks" else shutter.close()

        used = nudged(instrument, by_itself, at, 1)
        with pytest.raises(InstrumentError, match=rf"but for {kind} it must be"):
            run_scan(settings, tmp_path, instrument=used)
