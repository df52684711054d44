"""Small scans for tests to write, read and damage."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pytest

from beamline.monitor.digest import digest
from beamline.storage.writers.nxtomo import NXtomoWriter, ScanInfo
from drivers.base.frame import Frame, FrameKind
from tests.clock import SteppedClock

SHAPE = (12, 16)
EPOCH = 1.8e9  # s; a day in January 2027


@pytest.fixture
def clock() -> SteppedClock:
    return SteppedClock(EPOCH)


INFO = ScanInfo(
    sample="battery",
    title="a test",
    pixel_size_mm=0.0046,
    energy_kev=25.0,
    distance_mm=100.0,
    exposure=0.05,
    period=0.12,
    axis_col=7.25,
    plan='{"views": 9}',
    config="sample: {name: battery}\n",
    devices={"stage": {"model": "PM16C", "counts_per_turn": 360000, "speed": 1.5}},
)


def scan_frames(rng: np.random.Generator, n_darks: int = 2, n_flats: int = 3, n_views: int = 9) -> list[Frame]:
    """Darks near 100, flats near 1000 and projections below that over half a turn, as a camera would give them."""
    kinds = [FrameKind.DARK] * n_darks + [FrameKind.FLAT] * n_flats + [FrameKind.PROJECTION] * n_views
    frames = []
    for i, kind in enumerate(kinds):
        trigger = i if kind is FrameKind.DARK else i - n_darks if kind is FrameKind.FLAT else i - n_darks - n_flats
        frames.append(
            Frame(
                counts=rng.poisson({0: 600, 1: 1000, 2: 100}[int(kind)], SHAPE).astype(np.uint16),
                kind=kind,
                index=i,
                trigger=trigger,
                framestamp=trigger,
                angle=np.pi * trigger / max(n_views - 1, 1) if kind is FrameKind.PROJECTION else np.nan,
                time=EPOCH + 0.12 * i,
                exposure=0.05,
            )
        )
    return frames


def written(path: Path, frames: Iterable[Frame], info: ScanInfo = INFO) -> Path:
    """A complete scan of these frames."""
    with NXtomoWriter(path, info, SHAPE, clock=SteppedClock(EPOCH)) as writer:
        append(writer, *frames)
    return path


def append(writer: NXtomoWriter, *frames: Frame) -> None:
    for frame in frames:
        writer.append(frame, digest(frame.counts))


@pytest.fixture
def writer(tmp_path: Path, clock: SteppedClock) -> NXtomoWriter:
    """Of a new scan, s.h5."""
    return NXtomoWriter(tmp_path / "s.h5", INFO, SHAPE, clock=clock)


@pytest.fixture
def frames() -> list[Frame]:
    return scan_frames(np.random.default_rng(20261120))


@pytest.fixture(scope="session")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file of `frames`, of which tests have copies."""
    return written(tmp_path_factory.mktemp("good") / "scan.h5", scan_frames(np.random.default_rng(20261120)))


@pytest.fixture
def path(good: Path, tmp_path: Path) -> Path:
    """The file of `frames`."""
    return Path(shutil.copyfile(good, tmp_path / "scan.h5"))


@pytest.fixture
def write(tmp_path: Path) -> Callable[[list[Frame]], Path]:
    """Write frames to a new, complete scan and give its path."""

    def write(frames: list[Frame], name: str = "scan.h5") -> Path:
        return written(tmp_path / name, frames)

    return write
