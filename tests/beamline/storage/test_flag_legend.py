"""The legend in a file gives the check for each flag bit, also for programs with other checks."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from beamline.features.files.ingest import ingest
from beamline.features.files.validate import describe
from beamline.monitor.check import Flag, Level
from beamline.monitor.checks import ALARM_SHIFT, CHECKS, bitmask
from beamline.monitor.digest import digest
from beamline.storage.flag_legend import LEGEND, FlagBit, FrameFlags, counted, read_legend
from beamline.storage.readers.open import open_scan
from beamline.storage.writers.nxtomo import NXtomoWriter, ScanInfo
from drivers.base.frame import Frame, FrameKind
from tests.beamline.storage.conftest import EPOCH
from tests.clock import SteppedClock

NAMES = [check.name for check in CHECKS]
REGION = {"mass": (1, 3, 0, 6)}


@pytest.fixture
def path(tmp_path: Path, rng: np.random.Generator) -> Path:
    """A scan of 4 views: beam flagged in views 1 and 2 (an alarm), mass in view 2."""
    found = [[], [("beam", Level.WARN)], [("beam", Level.ALARM), ("mass", Level.WARN)], [("dark", Level.INFO)]]
    flags = [[Flag(*each, row, 1.5 * row, 0.0, "", REGION.get(each[0])) for each in f] for row, f in enumerate(found)]
    return _written(tmp_path / "s.h5", rng.integers(0, 99, (4, 6)).astype(np.uint16), flags)


def _written(path: Path, counts: np.ndarray, flags: list[list[Flag]]) -> Path:
    """A scan of views alike, with these flags."""
    with NXtomoWriter(path, ScanInfo("s"), (4, 6), clock=SteppedClock(EPOCH)) as writer:
        for row, found in enumerate(flags):
            frame = Frame(counts, FrameKind.PROJECTION, row, 0, 0, 0.0, 1.8e9, 0.1)
            writer.append(frame, digest(counts), found)
    return path


def test_a_scan_holds_name_bits_unit_and_meaning_of_every_check(path: Path) -> None:
    with h5py.File(path) as file:
        legend = file[LEGEND]
        assert list(legend["name"].asstr()[()]) == NAMES
        assert list(legend["unit"].asstr()[()]) == [check.unit for check in CHECKS]
        assert list(legend["meaning"].asstr()[()]) == [check.meaning for check in CHECKS]
        bits = [bitmask([Flag(name, Level.WARN, 0, 1, 0, "")]) for name in NAMES]
        assert [2 ** int(bit) for bit in legend["bit"][()]] == bits
        np.testing.assert_array_equal(legend["alarm_bit"][()] - legend["bit"][()], ALARM_SHIFT)


def test_info_counts_by_the_legend_of_the_file_and_not_the_checks_of_this_program(path: Path) -> None:
    expected = {"beam": {"warn": 1, "alarm": 1}, "mass": {"warn": 1}}
    facts = describe(path)
    assert (facts["flags"], facts["flagged_frames"], facts["alarmed_frames"]) == (expected, 2, 1)
    assert counted(facts["flags"]) == "beam 1 warn 1 alarm, mass 1 warn"
    with h5py.File(path, "r+", libver=("v110", "v110")) as file:
        names = file[f"{LEGEND}/name"]
        names[0] = "a check of a later version"
        found = read_legend(file)[0]
        assert (found.name, found.bit) == ("a check of a later version", 0)
    assert counted(describe(path)["flags"]) == "a check of a later version 1 warn 1 alarm, mass 1 warn"


def test_scores_and_regions_stand_beside_the_bits(path: Path, tmp_path: Path) -> None:
    with open_scan(path) as source, open_scan(ingest(path, tmp_path / "again.h5").path) as again:
        for flags in (source.table.flags, again.table.flags):
            assert flags is not None and flags.scores is not None and flags.regions is not None
            beam, mass = NAMES.index("beam"), NAMES.index("mass")
            np.testing.assert_array_equal(flags.scores[:, beam], [np.nan, 1.5, 3.0, np.nan])
            np.testing.assert_array_equal(flags.scores[:, mass], [np.nan, np.nan, 3.0, np.nan])
            assert np.isfinite(flags.scores).sum() == 3  # an INFO marks no frame
            assert tuple(flags.regions[2, mass]) == REGION["mass"]
            assert (np.delete(flags.regions.reshape(4, -1), 2, axis=0) == -1).all()
            shifted = FrameFlags.joined([None, flags], [2, flags.bits.size])
            assert shifted is not None and shifted.scores is not None
            np.testing.assert_array_equal(shifted.scores[2:], flags.scores)
            assert shifted.of(shifted.alarmed).regions.shape == (1, len(NAMES), 4)
    with h5py.File(path) as file:
        assert file["entry/frame_log/frame_valid"][()].tolist() == [1, 1, 0, 1]
        pixels = file["entry/instrument/detector/data"][()]
    assert len(np.unique(pixels, axis=0)) == 1  # the raw frames are untouched


def test_a_finding_that_needed_several_views_marks_them_all_in_the_file_as_in_memory(tmp_path: Path) -> None:
    """Also a crumb that moves, found three views after the last one that shows it."""
    found: list[list[Flag]] = [[] for _ in range(12)]
    found[5] = [Flag("floater", Level.WARN, 5, 7.0, 4.5, "", (0, 1, 2, 3), first=2)]
    found[6] = [Flag("floater", Level.WARN, 6, 6.0, 4.5, ""), Flag("ghost", Level.ALARM, 6, 0.2, 0.1, "", first=5)]
    found[11] = [Flag("floater", Level.WARN, 9, 8.0, 7.0, "", (0, 2, 4, 6), first=7, from_region=(0, 2, 0, 2))]
    flags = FrameFlags.of_flags(found)
    assert flags.flagged.nonzero()[0].tolist() == [*range(2, 10)] and flags.alarmed.nonzero()[0].tolist() == [5, 6]
    assert flags.counts() == {"floater": {"warn": 8}, "ghost": {"alarm": 2}}
    with h5py.File(_written(tmp_path / "s.h5", np.zeros((4, 6), np.uint16), found)) as file:
        log, at = file["entry/frame_log"], NAMES.index("floater")
        np.testing.assert_array_equal(log["flags"], flags.bits)
        np.testing.assert_array_equal(log["frame_valid"], ~flags.alarmed)
        np.testing.assert_array_equal(log["flag_scores"], flags.scores)
        np.testing.assert_array_equal(log["flag_regions"], flags.regions)
        assert log["flag_regions"][7:10, at].tolist() == [[0, 2, 0, 2], [0, 2, 2, 4], [0, 2, 4, 6]]
        assert log["flag_scores"][9, at] == 8.0


def test_the_legend_is_there_before_the_first_frame(tmp_path: Path) -> None:
    """Nothing can be created while a scan is written, and a follower may read the legend at any time."""
    with NXtomoWriter(tmp_path / "s.h5", ScanInfo("s"), (4, 6), clock=SteppedClock(EPOCH)) as writer:
        assert writer.rows == 0
        code = "import sys, h5py; f = h5py.File(sys.argv[1], swmr=True, locking=False); print(*f[sys.argv[2]].asstr())"
        words = [sys.executable, "-c", code, str(writer.path), f"{LEGEND}/name"]
        assert subprocess.run(words, capture_output=True, text=True, check=True).stdout.split() == NAMES


LEVELS = (Level.WARN, Level.ALARM)


@given(st.lists(st.dictionaries(st.sampled_from(NAMES), st.sampled_from(LEVELS)), max_size=20))
def test_counting_undoes_the_bitmask(found: list[dict[str, Level]]) -> None:
    each = [bitmask(Flag(name, level, 0, 1, 0, "") for name, level in frame.items()) for frame in found]
    n, k = len(each), len(CHECKS)
    nothing = np.full((n, k), np.nan, np.float32), np.full((n, k, 4), -1, np.int32)
    flags = FrameFlags(np.array(each, np.uint64), tuple(FlagBit(check.name, check.bit) for check in CHECKS), *nothing)
    for name in NAMES:
        for level in LEVELS:
            n = sum(frame.get(name) is level for frame in found)
            assert flags.counts().get(name, {}).get(str(level), 0) == n
    assert flags.flagged.tolist() == [bool(frame) for frame in found]
    assert flags.alarmed.tolist() == [Level.ALARM in frame.values() for frame in found]
    after = FrameFlags.joined([None, flags], [3, flags.bits.size])
    assert after is not None and after.alarmed.tolist() == [False] * 3 + flags.alarmed.tolist()
    assert flags.of(flags.alarmed).flagged.all()
