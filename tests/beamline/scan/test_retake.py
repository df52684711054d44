"""Projections with an alarm are repeated after the last one: limited in number, once, at their angles."""

from pathlib import Path
from tempfile import TemporaryDirectory

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beamline.core.errors import ScanStopped
from beamline.core.stop import StopRequest
from beamline.features.files.validate import describe, validate
from beamline.projections.replay import judged_flags
from beamline.projections.usable_views import usable_views
from beamline.scan.resume import open_for_resume
from beamline.storage.readers.open import open_scan
from beamline.storage.rules.evidence import ScanEvidence
from drivers.base.frame import FrameKind
from tests.beamline.fakes import COUNT, FakeInstrument, Faults, decode
from tests.beamline.ran import Ran
from tests.slow_cases import others_slow

WORDS = ("monitor.retake=true", "monitor.retake_share=0.5", "scan.angles.views=16", "scan.settle_s=0")
FIRST, N = 5, 16  # the first view's row; 3 darks and 2 flats before, 2 flats after
MIDDLE = {"fly": 11.25 / 0.5 * 0.02 / 2, "step": 0.0}  # degrees turned in half an exposure


def retakes(ran: Ran) -> int:
    return sum(event.data["message"].startswith("Taking ") for event in ran.of("state"))


@pytest.mark.parametrize("mode", others_slow(["fly", "step"]))
@settings(max_examples=3, deadline=None)
@given(repeats=st.sets(st.integers(FIRST + 1, FIRST + N - 1), min_size=1, max_size=14))
def test_each_view_with_an_alarm_is_taken_again_at_its_angle(mode: str, repeats: set[int]) -> None:
    with TemporaryDirectory() as folder:
        ran = Ran(Path(folder), FakeInstrument(Faults(repeats=repeats)), *WORDS, f"scan.mode={mode}")
        n = min(len(repeats), N // 2)
        assert (ran.result.retaken, ran.result.n_frames) == (n, 23 + n)
        assert ran.result.alarmed_frames == len(repeats) - n
        assert retakes(ran) == 1 and len(ran.warnings) == (len(repeats) > n)
        assert ran.of("frame")[-1].data["n"] == ran.of("frame")[-1].data["of"] == 23 + n
        ran.assert_safe()
        with open_scan(ran.result.path) as source:
            frames = list(source.frames())
            again = [frame for frame in frames if frame.replaces >= 0]
            assert [frame.index for frame in again] == list(range(FIRST + N, FIRST + N + n))  # before the last flats
            assert {frame.replaces for frame in again} <= repeats
            for frame in again:
                first = frames[frame.replaces]
                assert (first.kind, frame.kind) == (FrameKind.INVALID, FrameKind.PROJECTION)
                assert frame.angle == pytest.approx(first.angle, abs=COUNT)
                stood = decode(frame.counts)[0] * COUNT
                assert np.degrees(stood - frame.angle) == pytest.approx(MIDDLE[mode], abs=0.01)
            views = usable_views(ScanEvidence(source), use_flags=True).frames
            left = repeats - {frame.replaces for frame in again}
            assert views.size == N - len(left)
            steps = np.degrees(source.table.angles[views]) / 11.25
            assert np.unique(np.rint(steps)).size == views.size and np.abs(steps - np.rint(steps)).max() < 0.002
            # The same checks over the file find the same: a view taken again is no late trigger.
            flags, judged = source.table.flags, judged_flags(source)
            assert flags is not None
            np.testing.assert_array_equal(judged.alarmed, flags.alarmed)


def test_file_info_and_validate_count_them(tmp_path: Path) -> None:
    ran = Ran(tmp_path, FakeInstrument(Faults(repeats={8, 9, 20})), *WORDS)
    path = ran.result.path
    facts = describe(path)
    assert (facts["retaken_views"], facts["alarmed_frames"]) == (3, 3)
    assert facts["kinds"] == {"projection": 16, "flat": 4, "dark": 3, "invalid": 3}
    assert (facts["first_angle_deg"], facts["last_angle_deg"]) == (0, pytest.approx(168.75, abs=0.01))
    (found,) = [finding for finding in validate(path) if finding.rule == "flags"]
    assert found.severity == "info"
    assert "Taken again: 3 projections; the first attempts (frames 8-9, 20) are not used." in found.message
    with h5py.File(path) as file:
        assert list(file["entry/frame_log/replaces"][FIRST + N :]) == [8, 9, 20, -1, -1]
        assert list(file["entry/frame_log/trigger"][FIRST + N : FIRST + N + 3]) == [16, 17, 18]
        assert file["exchange/data"].shape[0] == 16
        theta = file["exchange/theta"][()]
        assert np.sort(theta) == pytest.approx(np.arange(16) * 11.25, abs=0.02)
        # The pixels of both are there: those of a repeated frame are the ones of the frame before.
        data = file["entry/instrument/detector/data"]
        assert np.array_equal(data[8], data[7]) and not np.array_equal(data[21], data[8])


@pytest.mark.parametrize(("words", "repeats"), [(("scan.angles.views=16",), {8}), (WORDS, set())])
def test_nothing_is_taken_again_unless_it_was_asked_for_and_has_an_alarm(
    tmp_path: Path, words: tuple[str, ...], repeats: set[int]
) -> None:
    ran = Ran(tmp_path, FakeInstrument(Faults(repeats=repeats)), *words)
    assert (ran.result.retaken, ran.result.alarmed_frames, ran.result.n_frames) == (0, len(repeats), 23)
    assert retakes(ran) == 0


def test_one_attempt_is_made(tmp_path: Path) -> None:
    """Frame 8 shows the one before; of the two taken again, the second one shows the first, and has an alarm, too."""
    ran = Ran(tmp_path, FakeInstrument(Faults(repeats={8, 9, FIRST + N + 1})), *WORDS)
    assert (ran.result.retaken, ran.result.alarmed_frames) == (2, 1)
    (found,) = [finding for finding in validate(ran.result.path) if finding.rule == "flags"]
    assert found.severity == "warning"
    said = "In a reconstruction (--flags use): Of 16 projections, 1 has an alarm and is left out"
    assert f"Other frames with an alarm: 22. {said}" in found.message


def test_a_stop_ends_it_and_the_views_not_reached_stay_as_they_were(tmp_path: Path) -> None:
    stop = StopRequest()
    instrument = FakeInstrument(Faults(repeats={8, 10, 12, 14}), at={FIRST + N + 1: stop.stop})
    ran = Ran(tmp_path, instrument, *WORDS, stop=stop)
    assert type(ran.error) is ScanStopped
    assert "Stopped after 16 of 16 projections" in str(ran.error)
    ran.assert_safe()
    with open_scan(ran.folder / "scan.h5") as source:
        assert source.finished
        again = [frame.replaces for frame in source.frames() if frame.replaces >= 0]
        assert again == [8, 10, 12][: len(again)] and len(again) in (2, 3)
        left = [row for row in (8, 10, 12, 14) if row not in again]
        flags = source.table.flags
        assert flags is not None and (source.table.kinds[left] == FrameKind.PROJECTION).all()
        assert flags.alarmed[left].all()
    with open_for_resume(ran.folder) as series:
        assert series.retaken == len(again)  # which count in the dose and the share of the run


def test_a_frame_lost_again_costs_nothing(tmp_path: Path) -> None:
    ran = Ran(tmp_path, FakeInstrument(Faults(repeats={8, 10}, lost={FIRST + N})), *WORDS)
    assert (ran.result.retaken, ran.result.missing, ran.result.alarmed_frames) == (1, (), 1)
    assert "Frames 8: the exposure was repeated, but the camera again delivered no frame" in ran.warnings[0]
    with open_scan(ran.result.path) as source:
        assert source.table.kinds[8] == FrameKind.PROJECTION and source.table.kinds[10] == FrameKind.INVALID


@pytest.mark.parametrize("mode", others_slow(["fly", "step"]))
def test_a_view_that_gave_no_frame_is_taken_again_under_its_trigger(tmp_path: Path, mode: str) -> None:
    """The view after it is good, and not taken again."""
    ran = Ran(tmp_path, FakeInstrument(Faults(lost={FIRST + 3})), *WORDS, f"scan.mode={mode}")
    assert (ran.result.retaken, ran.result.missing) == (1, ())
    with open_scan(ran.result.path) as source:
        again = FIRST + N - 1
        assert source.table.kinds[again] == FrameKind.PROJECTION
        assert np.degrees(source.table.angles[again]) == pytest.approx(3 * 11.25, abs=0.01)
        views = usable_views(ScanEvidence(source), use_flags=True).frames
        assert views.size == N and again in views
    with h5py.File(ran.result.path) as file:
        assert (file["entry/frame_log/trigger"][again], file["entry/frame_log/replaces"][again]) == (3, -1)
    assert [finding for finding in validate(ran.result.path) if finding.severity != "info"] == []
