"""A run of the fake instrument and everything that it left, for tests of the run and of what runs beside it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
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
from drivers.base.frame import FrameKind
from tests.beamline.fakes import COUNT, FakeInstrument, decode

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
    """A value, read once."""
    return load(config_folder() / "simulated.yaml", [*SMALL, *overrides], environment={})


class Ran:
    """A run and everything it left."""

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
        self.result: RunResult | None = None
        self.error: BaseException | None = None
        self.instrument = instrument
        try:
            devices = instrument.connected()
            self.result = run_scan(
                small(*overrides), runs, [self.events.append, heard], stop, live=live, instrument=devices
            )
        except BaseException as error:
            self.error = error
        folders = list(runs.iterdir()) if runs.exists() else []
        self.folder = folders[0] if folders else None

    def of(self, name: str) -> list[Event]:
        return [event for event in self.events if event.event == name]

    @property
    def states(self) -> list[str]:
        return [event.data["state"] for event in self.of("state")]

    def assert_good_file(self, n: int, status: str, missing: Sequence[int] = ()) -> None:
        """`n` rows, each with the angle that the fake camera wrote into its pixels, and nothing else."""
        assert self.folder is not None
        with open_scan(self.folder / "scan.h5") as source:
            assert source.finished
            frames = list(source.frames())
            assert len(frames) == len(source.image_key) == n
            for frame in frames:
                count, is_open, is_in, _ = decode(frame.counts)
                assert is_open is (frame.kind is not FrameKind.DARK)
                assert is_in is (frame.kind is not FrameKind.FLAT)
                if frame.kind is not FrameKind.INVALID:
                    assert frame.angle == pytest.approx(count * COUNT, abs=COUNT)
        with h5py.File(self.folder / "scan.h5") as file:
            progress = file["entry/progress"]
            assert progress["status"][()].decode() == status
            assert list(progress["missing_triggers"]) == list(missing)
            assert progress["frames_committed"][()] == n

    def assert_safe(self) -> None:
        assert not self.instrument.is_open
        assert not self.instrument.camera.armed
        assert not self.instrument.stage.moving()
