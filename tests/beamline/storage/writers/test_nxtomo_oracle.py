"""nabu (ESRF, extra "oracle") reads our scans: its validation, corrected projections and axis agree with ours.

A slice needs its kernels: CUDA, or OpenCL with pyvkfft. It has none for a processor alone.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import recon
from beamline.features.files.ingest import ingest
from beamline.monitor.digest import digest
from beamline.projections.prepare import prepare_projections
from beamline.projections.selection import Selection
from beamline.projections.views import select
from beamline.storage.parts import join
from beamline.storage.readers.open import open_scan
from beamline.storage.recover import recover
from beamline.storage.writer_lock import QUIET
from beamline.storage.writers.nxtomo import NXtomoWriter, ScanInfo
from drivers.base.clock import SystemClock
from drivers.base.frame import Frame, FrameKind

analyzer = pytest.importorskip("nabu.resources.dataset_analyzer")
estimators = pytest.importorskip("nabu.pipeline.estimators")
flatfield = pytest.importorskip("nabu.preproc.flatfield")
scans = pytest.importorskip("tomoscan.esrf.scan.nxtomoscan")
validator = pytest.importorskip("tomoscan.validator")

pytestmark = pytest.mark.filterwarnings("default")  # of libraries that are not ours

F64 = NDArray[np.float64]
SHAPE, AXIS, PITCH = (24, 128), 66.3, 0.005
DARK, BEAM = 100.0, 40000.0
BALLS = ((-18.0, 9.0, 14.0, 8.0), (22.0, -6.0, 9.0, 15.0), (4.0, 25.0, 11.0, 12.0), (-5.0, -27.0, 8.0, 5.0))
"""x, y, radius and height (z) in pixels; the middle of the frame is at 12."""

AXIS_APART = 0.05
"""Pixels by which the axis that nabu finds may be off that of ours; the worst of these methods was off by 0.026."""
WIDE_AXIS_APART = 0.15
"""The same, of a full turn about an axis beside the middle, and off the truth; it was off by 0.08."""
VIEWS_APART = 0.02
"""Line integrals: nabu takes the median of three flats, of 1 % noise, and we their mean."""


@dataclass(frozen=True)
class Balls:
    """Balls seen by exact chords, [view, row, col], over these angles in radians."""

    angles: F64
    axis: float = AXIS

    def views(self) -> F64:
        fine = (np.arange(4) + 0.5) / 4 - 0.5
        u = (np.arange(SHAPE[1])[:, None] + fine - self.axis)[None, None]
        rows = np.arange(SHAPE[0])[None, :, None, None]
        total = np.zeros((self.angles.size, *SHAPE))
        for x, y, radius, z in BALLS:
            centre = (x * np.cos(self.angles) + y * np.sin(self.angles))[:, None, None, None]
            total += 2 * np.sqrt(np.clip(radius**2 - (u - centre) ** 2 - (rows - z) ** 2, 0, None)).mean(axis=3)
        return 0.02 * total

    def frames(self) -> list[Frame]:
        """Three darks, three flats, the views, with the noise of photons."""
        rng = np.random.default_rng(0)
        light = BEAM * (1 + 0.2 * np.cos(np.arange(SHAPE[1]) / 9))
        means = [np.zeros(SHAPE)] * 3 + [np.broadcast_to(light, SHAPE)] * 3 + list(light * np.exp(-self.views()))
        kinds = [FrameKind.DARK] * 3 + [FrameKind.FLAT] * 3 + [FrameKind.PROJECTION] * self.angles.size
        triggers = [*range(3), *range(3), *range(self.angles.size)]
        angles = [0.0] * 6 + self.angles.tolist()
        return [
            Frame((rng.poisson(mean) + DARK).astype(np.uint16), kind, i, trigger, i, angle, 1.8e9 + 0.1 * i, 0.05)
            for i, (mean, kind, trigger, angle) in enumerate(zip(means, kinds, triggers, angles, strict=True))
        ]

    def info(self) -> ScanInfo:
        none = {"count": 3, "at": "start"}
        plan = {"darks": none, "flats": none, "angles_deg": np.degrees(self.angles).tolist()}
        return ScanInfo(
            "balls", pixel_size_mm=PITCH, energy_kev=25.0, distance_mm=100.0, axis_col=self.axis, plan=json.dumps(plan)
        )


HALF = Balls(np.linspace(0, np.pi, 121))
FULL = Balls(np.linspace(0, 2 * np.pi, 240, endpoint=False), axis=96.4)


def _write(path: Path, balls: Balls, frames: list[Frame], dies: bool = False) -> Path:
    with NXtomoWriter(path, balls.info(), SHAPE, clock=SystemClock()) as writer:
        for i, frame in enumerate(frames):
            writer.append(replace(frame, index=i), digest(frame.counts))
        if dies:
            died = path.with_name("died.h5")
            shutil.copy(path, died)
            os.utime(died, (died.stat().st_mtime - 2 * QUIET,) * 2)
    return died if dies else path


def _complete(folder: Path, balls: Balls) -> Path:
    return _write(folder / "scan.h5", balls, balls.frames())


def _joined(folder: Path, balls: Balls) -> Path:
    frames = balls.frames()
    parts = [_write(folder / "a.h5", balls, frames[:50]), _write(folder / "b.h5", balls, frames[:6] + frames[50:])]
    join(parts, folder / "joined.h5")
    return folder / "joined.h5"


def _recovered(folder: Path, balls: Balls) -> Path:
    path = _write(folder / "scan.h5", balls, balls.frames(), dies=True)
    recover(path)
    return path


def _ingested(folder: Path, balls: Balls) -> Path:
    ingest(_complete(folder, balls), folder / "ingested.h5")
    return folder / "ingested.h5"


@pytest.mark.parametrize("made", [_complete, _joined, _recovered])
def test_tomoscan_and_nabu_take_our_scans(tmp_path: Path, made: Callable[[Path, Balls], Path]) -> None:
    path = made(tmp_path, HALF)
    scan = scans.NXtomoScan(str(path), "/entry")
    checks = validator.ReconstructionValidator(
        scan, check_phase_retrieval=True, check_values=True, check_vds=True, check_dark=True, check_flat=True
    )
    assert checks.is_valid(), checks.checkup()
    assert scan.nexus_version == 1.5
    np.testing.assert_array_equal(scan.image_key, scan.image_key_control)

    theirs = analyzer.analyze_dataset(str(path))
    assert (theirs.kind, theirs.n_angles, theirs.radio_dims) == ("nx", HALF.angles.size, SHAPE[::-1])
    assert theirs.pixel_size == pytest.approx(1000 * PITCH)
    np.testing.assert_allclose(theirs.rotation_angles, HALF.angles, atol=1e-6)
    assert len(theirs.flats) > 0
    assert (theirs.energy, theirs.distance, theirs.is_halftomo) == (25.0, 0.1, False)


def test_an_ingested_scan_is_taken_too(tmp_path: Path) -> None:
    theirs = analyzer.analyze_dataset(str(_ingested(tmp_path, HALF)))
    assert (theirs.kind, theirs.n_angles, theirs.is_halftomo) == ("nx", HALF.angles.size, False)
    assert len(theirs.flats) > 0


def test_views_and_axis_of_nabu_are_ours(tmp_path: Path) -> None:
    path = _complete(tmp_path, HALF)
    with open_scan(path) as source:
        ours = prepare_projections(select(source, Selection()), lambda _: None)
    theirs = analyzer.analyze_dataset(str(path))
    rows = np.array(theirs.get_frames_indices("projections"))
    views = np.array([theirs.get_frame(row) for row in rows], np.float32)
    flatfield.FlatField(views.shape, theirs.flats, theirs.darks, radios_indices=rows).normalize_radios(views)
    assert np.abs(-np.log(views) - ours.seen.data).max() < VIEWS_APART
    assert abs(ours.origin.axis_col - AXIS) < AXIS_APART
    for method in ("centered", "octave-accurate", "sliding-window"):
        assert abs(estimators.estimate_cor(method, theirs) - ours.origin.axis_col) < AXIS_APART, method


def test_a_full_turn_beside_the_middle_is_half_a_field_of_view(tmp_path: Path) -> None:
    path = _complete(tmp_path, FULL)
    theirs = analyzer.analyze_dataset(str(path))
    assert theirs.is_halftomo
    with open_scan(path) as source:
        views = prepare_projections(select(source, Selection()), lambda _: None).seen.data
    ours = recon.find_axis(views, FULL.angles).value
    found = estimators.estimate_cor("sliding-window", theirs, cor_options={"side": "right"})
    assert abs(found - FULL.axis) < WIDE_AXIS_APART
    assert abs(found - ours) < WIDE_AXIS_APART
