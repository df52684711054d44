"""A run of the fake instrument and all its files, for tests of the run and of processes next to it."""

import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from functools import cache
from pathlib import Path

import h5py
import pytest

from beamline.config.load import Config, config_folder, load
from beamline.core.events import Event
from beamline.core.run_result import RunResult
from beamline.core.stop import StopRequest
from beamline.scan.run import run_scan
from beamline.storage.readers.open import open_scan
from beamline.storage.run_record import RecordFile, RunRecord
from beamline.storage.writer_lock import QUIET
from beamline.storage.writers.nxtomo import NXtomoWriter
from tests.beamline.fakes import FakeInstrument, Faults, assert_true

SMALL = (
    "scan.angles.views=12",
    "scan.period_s=0.5",
    "scan.exposure_s=0.02",
    "scan.darks.count=3",
    "scan.flats.count=2",
    "scan.flats.at=both",
    "recon.live=false",
)


@cache
def small(*overrides: str) -> Config:
    """A small configuration, read once."""
    return load(config_folder() / "simulated.yaml", [*SMALL, *overrides], environment={})


class Ran:
    """A run and all its files."""

    def __init__(
        self,
        runs: Path,
        instrument: FakeInstrument,
        *overrides: str,
        stop: StopRequest | None = None,
        live: Callable[[Path, Path], Sequence[str]] | None = None,
        heard: Callable[[Event], None] = lambda event: None,
    ) -> None:
        self.events: list[Event] = []
        self._result: RunResult | None = None
        self.error: BaseException | None = None
        self.instrument, self._runs = instrument, runs
        try:
            devices = instrument.connected()
            self._result = run_scan(
                small(*overrides), runs, [self.events.append, heard], stop, live=live, instrument=devices
            )
        except BaseException as error:
            self.error = error

    @property
    def result(self) -> RunResult:
        """The result of the run; if it failed, its error is raised."""
        if self.error is not None:
            raise self.error
        assert self._result is not None
        return self._result

    @property
    def folder(self) -> Path:
        return next(self._runs.iterdir())

    def of(self, name: str) -> list[Event]:
        return [event for event in self.events if event.event == name]

    @property
    def warnings(self) -> list[str]:
        return [event.data["message"] for event in self.of("warning")]

    @property
    def states(self) -> list[str]:
        return [event.data["state"] for event in self.of("state")]

    def assert_good_file(self, n: int, status: str, missing: Sequence[int] = ()) -> None:
        """Assert that the file has `n` rows, each with the angle that the fake camera wrote into its pixels, and no
        others."""
        with open_scan(self.folder / "scan.h5") as source:
            assert source.finished
            frames = list(source.frames())
            assert len(frames) == len(source.table.kinds) == n
            assert_true(frames)
        with h5py.File(self.folder / "scan.h5") as file:
            progress = file["entry/progress"]
            assert progress["status"][()].decode() == status
            assert list(progress["missing_triggers"]) == list(missing)
            assert progress["frames_committed"][()] == n

    def assert_safe(self) -> None:
        assert not self.instrument.is_open
        assert not self.instrument.camera.armed
        assert not self.instrument.stage.moving()


@contextmanager
def killed(patch: pytest.MonkeyPatch) -> Iterator[None]:
    """Files of a scan in this context are left as after kill -9 some time ago: marked as being written, no last
    state."""
    died, close, put = list[Path](), NXtomoWriter.close, RecordFile.put

    def put_none_of_an_end(file: RecordFile, record: RunRecord) -> None:
        if not record.over:
            put(file, record)

    def die(writer: NXtomoWriter, *_: object) -> None:
        died.append(writer.path)
        shutil.copy(writer.path, writer.path.with_name("died.h5"))
        close(writer)

    with patch.context() as within:
        within.setattr(NXtomoWriter, "close", die)
        within.setattr(RecordFile, "put", put_none_of_an_end)
        yield
    for path in died:
        path.with_name("died.h5").replace(path)
        when = path.stat().st_mtime - 2 * QUIET
        os.utime(path, (when, when))


def ended_run(runs: Path, how: str, *overrides: str, at: int) -> Path:
    """The folder of a run that was stopped, aborted or killed at a frame, or lost three projections from there on.

    The lost ones are two neighbours and the last of twelve.
    """
    if how == "lossy":
        faults = Faults(lost={at}, ignored={at + 1, 16})
        return Ran(runs, FakeInstrument(faults), *overrides).folder
    stop = StopRequest()
    instrument = FakeInstrument(at={at: stop.stop if how == "stopped" else stop.abort})
    with pytest.MonkeyPatch.context() as patch, killed(patch) if how == "killed" else nullcontext():
        return Ran(runs, instrument, *overrides, stop=stop).folder
