"""The page reads what is in a scan file, also while the file grows."""

import json
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from beamline.monitor.check import Flag, Level
from beamline.monitor.checks import CHECKS
from beamline.monitor.digest import digest
from beamline.page.recording import Recording
from beamline.page.shown_scan import ShownScan
from beamline.page.tiles import TileRegion
from beamline.storage.readers.open import open_scan
from beamline.storage.writers import layout
from beamline.storage.writers.nxtomo import NXtomoWriter, ScanInfo
from drivers.base.clock import SystemClock
from tests.beamline.scans import TwoCylinders, frames_of, write_flagged

SCAN = TwoCylinders()
WHOLE = TileRegion(0, 4, 0, 40)


@pytest.fixture
def recording(tmp_path: Path) -> Iterator[Recording]:
    with closing(Recording(write_flagged(tmp_path / "scan.h5", frames_of(SCAN), {}))) as recording:
        yield recording


def test_a_view_over_the_flats_is_the_transmission(recording: Recording) -> None:
    values, region, factor = recording.picture(10, WHOLE, corrected=True)
    assert (region, factor) == (WHOLE, 1)
    np.testing.assert_allclose(values, np.exp(-SCAN.line_integrals()[6]), atol=2e-4)


def test_behind_slits_there_is_no_value_and_the_window_is_that_of_the_light(tmp_path: Path) -> None:
    """A ratio of noise there made the greys of a frame reach from -22 to 22."""
    noise, frames = np.random.default_rng(0), []
    for frame in frames_of(SCAN):
        counts = frame.counts.copy()
        counts[[0, 3]] = 100 + noise.integers(-2, 3, (2, 40))
        frames.append(replace(frame, counts=counts))
    with closing(Recording(write_flagged(tmp_path / "slits.h5", frames, {}))) as recording:
        values, *_ = recording.picture(10, WHOLE, corrected=True)
        assert np.isnan(values[[0, 3]]).all()
        np.testing.assert_allclose(values[1:3], np.exp(-SCAN.line_integrals()[6, 1:3]), atol=2e-4)
    with closing(ShownScan(open_scan(tmp_path / "slits.h5"))) as shown:
        assert np.isnan(shown.stack.cut(0, 3, WHOLE).values[[0, 3]]).all()
        low, high = shown.stack.facts()["window"]
        assert 0 < low < high < 1.2


def test_without_correction_a_view_is_counts(recording: Recording) -> None:
    values, *_ = recording.picture(10, TileRegion(1, 3, 5, 20), corrected=False)
    np.testing.assert_array_equal(values, SCAN.counts()[6, 1:3, 5:20])


def test_the_sinogram_is_a_row_of_the_views_alone(recording: Recording) -> None:
    lines, views, factor = recording.sinogram(2, first=14)
    assert (factor, views.tolist()) == (1, list(range(14, 4 + SCAN.angles.size)))
    np.testing.assert_array_equal(lines, SCAN.counts()[10:, 2])


def test_a_region_s_trace_is_its_mean_in_each_frame(recording: Recording) -> None:
    frames = frames_of(SCAN)
    trace = recording.trace(TileRegion(0, 4, 8, 16), first=3)
    np.testing.assert_allclose(
        np.array(trace, float), [frame.counts[:, 8:16].mean() for frame in frames[3:]], rtol=1e-5
    )


def test_numbers_that_json_has_not_are_none(tmp_path: Path) -> None:
    path = write_flagged(tmp_path / "scan.h5", frames_of(SCAN), {})
    with h5py.File(path, "r+") as file:
        file[layout.TIME][-1], file[layout.AXIS_COL] = np.inf, np.nan
        file["/entry/digest/preview"][5] = np.nan
    recording = Recording(path)
    answers = recording.facts(), recording.columns(0), recording.trace(WHOLE, 5)
    newest = recording.progress().newest
    recording.close()
    json.dumps(answers, allow_nan=False)
    assert (answers[0]["axis_col"], answers[1]["time"][-1], answers[2][0], newest) == (None, None, None, None)


def test_flags_have_score_level_and_region(tmp_path: Path) -> None:
    flag = Flag(CHECKS[0].name, Level.ALARM, 12, 0.5, 0.1, "", region=(0, 2, 5, 9))
    recording = Recording(write_flagged(tmp_path / "scan.h5", frames_of(SCAN), {7: Level.WARN}, flags=[flag]))
    found = recording.flags()
    recording.close()
    assert found == [
        {"frame": 7, "check": CHECKS[0].name, "alarm": False, "score": 1.0, "region": None},
        {"frame": 12, "check": CHECKS[0].name, "alarm": True, "score": 0.5, "region": [0, 2, 5, 9]},
    ]


def test_a_growing_file_shows_each_frame_as_it_is_committed(tmp_path: Path) -> None:
    frames = frames_of(SCAN)
    with NXtomoWriter(tmp_path / "scan.h5", ScanInfo("s"), SCAN.shape, clock=SystemClock()) as writer:
        recording = Recording(tmp_path / "scan.h5")
        for frame in frames:
            writer.append(frame, digest(frame.counts))
            assert recording.progress().frames == frame.index + 1
            np.testing.assert_array_equal(
                recording.picture(frame.index, WHOLE, corrected=False)[0], frame.counts.astype(np.float32)
            )
        assert len(recording.columns(3)["kind"]) == len(frames) - 3
        assert recording.progress().status == "running"
        recording.close()
