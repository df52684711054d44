"""A run leaves one folder with a readable file and complete logs, however it ends, and reports in time."""

import errno
import io
import json
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from beamline.config.load import load
from beamline.core.errors import DataError
from beamline.core.events import Event
from beamline.monitor.check import Flag
from beamline.monitor.digest import FrameDigest
from beamline.scan import measurement
from beamline.scan import run as run_module
from beamline.scan.control import State
from beamline.scan.run import run_scan
from beamline.storage.writers.nxtomo import NXtomoWriter
from drivers.base.errors import DeviceError
from drivers.base.frame import Frame
from tests.beamline import fakes
from tests.beamline.fakes import COUNT, FakeInstrument
from tests.beamline.ran import Ran, small


@pytest.mark.parametrize("mode", ["fly", "step"])
def test_a_run_from_trigger_to_file(tmp_path: Path, mode: str) -> None:
    ran = Ran(tmp_path, FakeInstrument(), f"scan.mode={mode}")
    ran.assert_good_file(3 + 2 + 12 + 2, "complete")
    ran.assert_safe()
    assert ran.result.path == ran.folder / "scan.h5"
    assert (ran.result.n_frames, ran.result.missing, ran.result.flags) == (19, (), {})
    assert ran.result.bytes == ran.result.path.stat().st_size
    names = {"config.resolved.yaml", "events.jsonl", "scan.h5", "state.json", "user.log"}
    assert {p.name for p in ran.folder.iterdir()} == names
    assert ran.folder.name.endswith("_battery")
    assert load(ran.folder / "config.resolved.yaml", environment={}) == small(f"scan.mode={mode}")
    assert "close" not in ran.instrument.log  # whoever brings the devices closes them
    with h5py.File(ran.folder / "scan.h5") as file:
        plan = json.loads(file["entry/record/plan"][()])
        assert plan["scheme"] == "fixed"
        np.testing.assert_allclose(plan["angles_deg"], np.arange(0, 180, 15))
        assert file["entry/instrument/devices/camera/model"][()] == b"fake camera"
        log = file["entry/frame_log"]
        assert list(log["trigger"]) == [0, 1, 2, 0, 1, *range(12), 0, 1]
        assert np.all(np.diff(log["time"][()]) > 0)
        assert not np.any(log["flags"])


def test_the_story_is_told_in_order_and_twice_over(tmp_path: Path) -> None:
    ran = Ran(tmp_path, FakeInstrument())
    names = [event.event for event in ran.events if event.event != "frame"]
    block = ["block_started", "block_done"]
    begun, done = block
    taken = [begun, "state", done] * 2 + [begun, "state", "state", done] + [begun, "state", done]
    assert names == ["state", "run_started", *taken, "state", "scan_done", "state", "done"]
    darks, flats, taxi, views = State.DARKS, State.FLATS, State.TAXI, State.ACQUIRING
    assert ran.states == [State.PREPARING, darks, flats, taxi, views, flats, State.FINISHING, State.DONE]
    frames = ran.of("frame")
    assert frames[-1].data["n"] == frames[-1].data["of"] == 19
    assert frames[-1].data["eta_s"] == 0
    lines = (ran.folder / "events.jsonl").read_text(encoding="utf-8").splitlines()
    assert [json.loads(line)["event"] for line in lines] == [event.event for event in ran.events]
    log = (ran.folder / "user.log").read_text(encoding="utf-8")
    assert "Taking 12 projection frames (fly, exposure 0.02 s)" in log
    assert "Scan complete: 19 frames" in log


def failing_writer(at: int, failure: Exception) -> type[NXtomoWriter]:
    class Full(NXtomoWriter):
        def append(self, frame: Frame, digest: FrameDigest, flags: Sequence[Flag] = ()) -> None:
            if frame.index == at:
                raise failure
            super().append(frame, digest, flags)

    return Full


@pytest.mark.parametrize(
    "failure",
    [DataError("the disk is full. The first 8 frames are safe in scan.h5."), OSError(errno.ENOSPC, "No space left")],
)
def test_a_full_disk_stops_the_scan_and_keeps_what_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failure: Exception
) -> None:
    monkeypatch.setattr(measurement, "NXtomoWriter", failing_writer(8, failure))
    ran = Ran(tmp_path, FakeInstrument(), "scan.angles.views=200", "scan.period_s=0.05")
    assert isinstance(ran.error, DataError)
    assert re.search(r"first 8 frames are safe in .*scan\.h5", str(ran.error))
    ran.assert_good_file(8, "failed")
    ran.assert_safe()
    assert ran.instrument.stage.position() == pytest.approx(100 * COUNT)  # the devices are well: back to the start
    assert ran.of("failed")[0].data["exit_code"] == 5


def test_logs_on_a_full_disk_do_not_hide_why_the_run_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A text file writes what it still holds when it is closed, and then it is closed in vain."""

    class FullLog(io.StringIO):
        def flush(self) -> None:
            raise OSError(errno.ENOSPC, "No space left")

        def close(self) -> None:
            raise OSError(errno.ENOSPC, "No space left")

    usual = Path.open

    def opened(path: Path, mode: str = "r", *args: object, **kwargs: object) -> object:
        return FullLog() if path.suffix in (".jsonl", ".log") else usual(path, mode, *args, **kwargs)  # type: ignore[call-overload]

    monkeypatch.setattr(Path, "open", opened)
    monkeypatch.setattr(measurement, "NXtomoWriter", failing_writer(8, DataError("the first 8 frames are safe.")))
    ran = Ran(tmp_path, FakeInstrument())
    assert str(ran.error) == "the first 8 frames are safe."
    ran.assert_good_file(8, "failed")


def test_a_folder_that_takes_no_file_is_named_before_anything_moves(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    ran = Ran(tmp_path, instrument := FakeInstrument())
    assert isinstance(ran.error, DataError)
    assert re.search(
        rf"{re.escape(str(ran.folder))} cannot be written to \(No space.*Nothing was moved", str(ran.error)
    )
    assert not instrument.is_open


def test_an_interpreter_interrupt_closes_the_file_too(tmp_path: Path) -> None:
    def interrupt(number: int) -> None:
        if number == 10:
            raise KeyboardInterrupt

    ran = Ran(tmp_path, FakeInstrument(on_frame=interrupt))
    assert isinstance(ran.error, KeyboardInterrupt)
    ran.assert_good_file(10, "failed")
    ran.assert_safe()


def test_a_device_that_cannot_be_let_go_is_told_and_the_file_is_good(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail() -> None:
        raise DeviceError("stage", "its port does not close")

    instrument = replace(FakeInstrument().connected(), close=fail)
    monkeypatch.setattr(run_module, "connect", lambda config, clock, ask, check_stop: instrument)
    events: list[Event] = []
    with pytest.raises(DeviceError, match="does not close"):
        run_scan(small(), tmp_path, [events.append])
    done = [event.data for event in events if event.event == "scan_done"]
    assert [(data["status"], data["n_frames"]) for data in done] == [("complete", 19)]


def test_what_a_device_said_of_the_time_before_is_a_warning(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    said = {"model": "m", "found_at_opening": "displaced while at rest (WM)"}
    monkeypatch.setattr(fakes.Stage, "describe", lambda stage: said)
    ran = Ran(tmp_path, FakeInstrument())
    (warning,) = ran.of("warning")
    assert (
        warning.data["message"] == "stage: this program found the device in this state: displaced while at rest (WM)."
    )
