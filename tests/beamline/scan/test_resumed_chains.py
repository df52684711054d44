"""However the parts of a run ended, its joined file has the frames of all of them, or is refused and can be made."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Sequence
from pathlib import Path

import h5py
import numpy as np
import pytest
from click.testing import CliRunner

from beamline.cli.main import main
from beamline.core.errors import BeamlineError, DataError
from beamline.core.events import Event
from beamline.core.files import parts_of
from beamline.core.stop import StopRequest
from beamline.scan.resume import ResumableRun, open_for_resume, recover_run
from beamline.scan.run import run_scan
from beamline.storage import parts
from beamline.storage.archive import archive
from beamline.storage.describe import describe
from beamline.storage.hdf5 import open_hdf5
from beamline.storage.parts import JOINED, is_joined
from beamline.storage.readers.open import open_scan
from beamline.storage.recover import QUIET
from beamline.storage.rules.validate import validate
from beamline.storage.writers import layout
from beamline.storage.writers.nxtomo import NXtomoWriter
from drivers.errors import DeviceError
from drivers.frame import FrameKind
from tests.beamline.fakes import FakeInstrument, Faults
from tests.beamline.ran import small

FIRST = 5  # 3 darks and 2 flats
VIEWS = 12
START, DARKS, VIEW, END = 0, 2, FIRST + 2, FIRST + 4  # frames of a part, at which it ends


class Chain:
    """A run whose parts end one after the other; `end` takes the next part, which ends so at a frame."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.folder, self.patch = folder, monkeypatch
        self.config = small("scan.flats.at=both")

    @property
    def run(self) -> Path:
        (run,) = self.folder.iterdir()
        return run

    def take(self, instrument: FakeInstrument, stop: StopRequest, at_start: bool = False) -> None:
        """The run's next part, whatever it ends with."""
        started = (lambda event: stop.stop() if event.event == "run_started" else None) if at_start else None
        sinks = [] if started is None else [started]
        devices = instrument.connected()
        if not self.folder.exists():
            run_scan(self.config, self.folder, sinks, stop, instrument=devices)
            return
        instrument.clock.sleep(1000.0 * len(parts_of(self.run)))
        with open_for_resume(self.run) as series:
            run_scan(series.config, series, sinks, stop, instrument=devices)

    def end(self, how: str, at: int) -> None:
        getattr(self, f"_{how}")(at)
        for part in self.run.rglob("scan.h5"):  # all of this was a while ago
            when = part.stat().st_mtime - 2 * QUIET
            os.utime(part, (when, when))

    def _stopped(self, at: int, abort: bool = False) -> None:
        stop = StopRequest()
        act = stop.abort if abort else stop.stop
        instrument = FakeInstrument(on_frame=lambda n: act() if n == at else None)
        with pytest.raises(BeamlineError):
            self.take(instrument, stop, at_start=at == START)

    def _aborted(self, at: int) -> None:
        self._stopped(at, abort=True)

    def _failed(self, at: int) -> None:
        """A device fails."""
        with pytest.raises(DeviceError):
            self.take(FakeInstrument(Faults(errors={at: 99})), StopRequest())

    def _killed(self, at: int) -> None:
        """As kill -9 leaves it: the newest part marked as being written, the joined file as it was."""

        def die(writer: NXtomoWriter, *_: object) -> None:
            shutil.copy(writer.path, writer.path.with_name("died.h5"))
            close(writer)

        close = NXtomoWriter.close
        with self.patch.context() as patch, self._joined_stays():
            patch.setattr(NXtomoWriter, "close", die)
            self._aborted(at)
        part = parts_of(self.run)[-1]
        (part / "died.h5").replace(part / "scan.h5")

    def _full(self, at: int) -> None:
        """The disk takes no frame from one on; its file is never closed, as in a process that has ended since."""

        def write(table: layout.Rows, row: int, *given: object) -> None:
            if row == at:
                raise OSError(errno.ENOSPC, "No space left on device")
            usual(table, row, *given)  # type: ignore[arg-type]

        usual = layout.Rows.write
        with self.patch.context() as patch:
            patch.setattr(layout.Rows, "write", write)
            with pytest.raises(DataError, match="No space left"):
                self.take(FakeInstrument(), StopRequest())
        part = parts_of(self.run)[-1] / "scan.h5"
        shutil.copy(part, part.with_name("died.h5"))
        part.with_name("died.h5").replace(part)

    def _unjoined(self, at: int) -> None:
        """As kill -9 leaves it while the parts are joined."""
        with self._joined_stays():
            self._aborted(at)

    def _unjoined_whole(self, at: int) -> None:
        with self._joined_stays():
            self.take(FakeInstrument(), StopRequest())

    def _joined_stays(self) -> _Stays:
        return _Stays(self.run / JOINED if self.folder.exists() else None)


class _Stays:
    """What is made of a file in the block is undone at its end."""

    def __init__(self, path: Path | None) -> None:
        self.path = path
        self.before = path.read_bytes() if path is not None and path.exists() else None

    def __enter__(self) -> None: ...

    def __exit__(self, *_: object) -> None:
        if self.path is not None:
            self.path.unlink(missing_ok=True)
            if self.before is not None:
                self.path.write_bytes(self.before)


def _frames(run: Path) -> int:
    """Committed frames of all parts."""
    n = 0
    for part in parts_of(run):
        with open_hdf5(part / "scan.h5") as file:
            n += int(file[layout.COMMITTED][()])
    return n


def _assert_whole(joined: Path) -> None:
    with open_scan(joined) as source:
        frames = list(source.frames())
    triggers = [frame.trigger for frame in frames if frame.kind is FrameKind.PROJECTION]
    assert sorted(triggers) == list(range(VIEWS))
    assert [finding.message for finding in validate(joined, lambda done, of: None) if finding.severity == "error"] == []
    assert len(frames) == _frames(joined.parent)


CHAINS: tuple[Sequence[tuple[str, int]], ...] = (
    [("stopped", VIEW)],
    [("aborted", DARKS), ("stopped", VIEW)],
    [("stopped", VIEW), ("stopped", START)],
    [("stopped", VIEW), ("aborted", DARKS), ("aborted", VIEW)],
    [("killed", VIEW), ("killed", VIEW), ("stopped", START)],
    [("killed", VIEW), ("killed", VIEW), ("killed", VIEW)],
    [("killed", DARKS), ("failed", VIEW), ("killed", DARKS)],
    [("failed", VIEW), ("failed", DARKS), ("failed", VIEW)],
    [("full", VIEW), ("stopped", VIEW)],
    [("stopped", VIEW), ("full", VIEW), ("aborted", VIEW)],
    [("stopped", VIEW), ("full", DARKS), ("stopped", START)],
    [("stopped", VIEW), ("unjoined", VIEW), ("stopped", START)],
    [("stopped", VIEW), ("stopped", VIEW), ("unjoined", VIEW)],
    [("stopped", VIEW), ("unjoined_whole", START)],
    [("stopped", VIEW), ("stopped", VIEW), ("unjoined_whole", START)],
    [("aborted", FIRST + VIEWS), ("aborted", START), ("killed", 0)],  # references of the end alone
)


@pytest.mark.parametrize("chain", CHAINS, ids=lambda chain: "-".join(f"{how}{at}" for how, at in chain))
def test_the_joined_file_has_all_frames_or_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, chain: Sequence[tuple[str, int]]
) -> None:
    made = Chain(tmp_path / "runs", monkeypatch)
    for how, at in chain:
        made.end(how, at)
        joined = made.run / JOINED
        if len([part for part in parts_of(made.run) if parts.may_hold_frames(part / "scan.h5")]) < 2:
            assert not joined.exists()
            continue
        if how in ("stopped", "aborted", "failed"):
            assert is_joined(joined)
        try:
            with open_scan(joined) as source:
                assert source.image_key.size == _frames(made.run)
        except DataError as refused:
            assert "recover" in str(refused) or not joined.exists()
    if chain[-1][0] != "unjoined_whole":
        made.take(FakeInstrument(), StopRequest())
    else:
        said = CliRunner().invoke(main, ["scan", "--resume", str(made.run)])
        assert said.exit_code == 0, said.output
    _assert_whole(joined)
