"""The frames in a report: the worst of each kind with position and reason; every flag has its reason in words."""

from __future__ import annotations

import numpy as np
import pytest

from beamline.monitor.check import Flag, Level
from beamline.monitor.checks import CHECKS
from beamline.reconstruct.scan_facts import reasons, reference_images, worst_frames
from beamline.storage.flag_legend import TODAY, FrameFlags, mark_of
from tests.beamline.array_source import ArraySource

ONE, TWO = CHECKS[0].name, CHECKS[1].name
REGION = (1, 3, 40, 90)


def flags() -> FrameFlags:
    """30 frames: the first check warns of 5 to 20, with a score that rises; the second raises an alarm in 10 and 11."""
    marks = []
    for row in range(30):
        said = [Flag(ONE, Level.WARN, row, 0.1 * row, 0.0, "")] if 5 <= row <= 20 else []
        said += [Flag(TWO, Level.ALARM, row, -3.0 - row, 0.0, "", REGION)] if row in (10, 11) else []
        marks.append(mark_of(said))
    return FrameFlags.of_marks(marks)


def source() -> ArraySource:
    rng = np.random.default_rng(0)
    return ArraySource(rng.integers(0, 999, (30, 6, 600)).astype(np.uint16), [0] * 30, np.radians(np.arange(30.0)))


def test_every_flag_has_its_frames_its_worst_score_and_its_meaning() -> None:
    one, two = TODAY[:2]
    assert reasons(flags()) == [
        f"Alarm ({two.name}): frames 10-11, worst -14 {two.unit} in frame 11: {two.meaning}.",
        f"Warn ({one.name}): frames 5-20, worst 2 {one.unit} in frame 20: {one.meaning}.",
    ]
    unknown = FrameFlags(flags().bits, TODAY, np.full((30, len(CHECKS)), np.nan, np.float32), flags().regions)
    assert reasons(unknown)[0] == f"Alarm ({two.name}): frames 10-11: {two.meaning}."


@pytest.mark.parametrize(("most", "rows"), [(2, [11, 20]), (3, [11, 17, 20]), (30, [5, 8, 11, 14, 17, 20])])
def test_the_worst_of_each_kind_come_first(most: int, rows: list[int]) -> None:
    found = worst_frames(source(), flags(), most)
    assert [frame.title for frame in found] == [f"frame {row}, projection, {row:.1f}°" for row in rows]
    (worst,) = [frame for frame in found if "frame 11," in frame.title]
    assert worst.colour == "tab:red" and worst.regions == [(REGION, "tab:red")]
    assert worst.reasons == [f"{ONE} warn 1.1", f"{TWO} alarm -14"]
    assert worst.image.shape == (2, 200) and worst.extent == (6, 600)


def test_means_of_darks_and_flats_and_how_the_beam_changed() -> None:
    frames = np.repeat([10, 12, 110, 112, 60, 60, 70], 6 * 600).reshape(7, 6, 600)
    scan = ArraySource(frames.astype(np.uint16), [2, 2, 1, 1, 0, 0, 1], np.zeros(7))
    found = reference_images(scan)
    levels = {title: (image.shape, float(image.min()), float(image.max())) for title, image in found.items()}
    assert levels == {
        "dark (counts)": ((2, 200), 11, 11),
        "flats (counts)": ((2, 200), 111, 111),
        "last flats (counts)": ((2, 200), 70, 70),
        "last flats / first": ((2, 200), pytest.approx(0.59), pytest.approx(0.59)),
    }
    assert reference_images(source()) == {}
