"""Checks of single frames: saturated pixels, repeated images, triggers, darks that are not dark, no beam."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from beamline.monitor.check import Flag, Level, Policy, ScanContext
from beamline.monitor.checks import CHECKS, bitmask
from beamline.monitor.digest import digest
from beamline.monitor.frames import DarkCheck, LostCheck, LostState
from drivers.base.frame import Frame, FrameKind
from tests.beamline.monitor.blobs import Blobs

SATURATION, PIXELS = 65535, 64 * 96


def burn(frames: list[Frame], n: int) -> list[Frame]:
    """n pixels at the end of their range, in bright surroundings."""
    for frame in frames:
        frame.counts[:4] = SATURATION - 5000
        frame.counts.ravel()[:n] = SATURATION
    return frames


@pytest.mark.parametrize(("n", "level"), [(3, Level.WARN), (6, Level.WARN), (7, Level.ALARM), (3000, Level.ALARM)])
def test_saturated_pixels_are_flagged(fake: Any, n: int, level: Level) -> None:
    flags = fake.of("saturation", fake.references() + burn(fake.views(1), n))
    assert len(flags) == 1
    assert flags[0].level is level
    assert flags[0].score == pytest.approx(n / PIXELS)
    assert "exposure" in flags[0].advice


def zingers(frames: list[Frame]) -> list[Frame]:
    for at in (7, 30, 55, 80):
        frames[-2].counts[20:22, at] = SATURATION
    return frames


@pytest.mark.parametrize(
    ("frames", "found"),
    [
        (lambda fake: fake.references() + burn(fake.views(2), 2), 0),  # a pixel or two
        (lambda fake: zingers(fake.references() + fake.views(3)), 0),
        (lambda fake: burn(fake.references() + fake.views(2), 100), 0),  # hot without light, too
        (lambda fake: fake.darks() + burn(fake.flats(2), 50), 2),
    ],
    ids=["few", "zingers", "hot", "flats"],
)
def test_only_light_that_is_too_much_is_an_exposure_too_long(fake: Any, frames: Any, found: int) -> None:
    assert len(fake.of("saturation", frames(fake))) == found


@pytest.mark.parametrize("share", [0.25, 1.0])
def test_views_after_saturated_ones_are_not_taken_for_dim(fake: Any, share: float) -> None:
    frames = fake.references() + fake.views(24)
    row = len(frames) - 12
    for frame in frames[row : row + 4]:
        frame.counts[: int(share * len(frame.counts))] = SATURATION
    assert {flag.frame for flag in fake.flags(frames) if flag.level is Level.ALARM} == set(range(row, row + 4))


def test_a_repeated_buffer_is_flagged_each_time_and_counted(fake: Any) -> None:
    frames = fake.references() + fake.views(6)
    frames[13] = replace(frames[13], counts=frames[12].counts.copy())
    frames[14] = replace(frames[14], counts=frames[12].counts.copy())
    frames[15] = replace(frames[15], counts=frames[12].counts.copy())
    frames[15].counts[5, 5] += 1  # another frame
    flags = fake.of("stuck", frames)
    assert [(f.frame, f.score, f.level) for f in flags] == [(13, 1, Level.ALARM), (14, 2, Level.ALARM)]
    assert "delivers the same image again" in flags[0].advice


def test_darks_without_noise_are_all_equal_and_say_nothing(fake: Any) -> None:
    darks = [replace(frame, counts=np.full_like(frame.counts, 200)) for frame in fake.darks(3)]
    assert fake.of("stuck", darks) == []


def test_views_of_a_single_value_are_stuck_all_the_same(fake: Any) -> None:
    references = fake.references()
    views = [replace(frame, counts=np.full_like(frame.counts, 5000)) for frame in fake.views(4)]
    assert [(f.frame, f.score) for f in fake.of("stuck", references + views)] == [(11, 1), (12, 2), (13, 3)]


def test_frames_of_a_view_without_noise_are_alike_and_views_are_not(fake: Any) -> None:
    """Of a scene without noise with several frames a view; a camera's darks are never of one value."""
    plain = [replace(frame, counts=np.full_like(frame.counts, 200)) for frame in fake.darks(3)]
    flat = fake.flats(1)[0]  # of a beam that is not even
    flats = [replace(flat, index=i) for i in range(3)]
    assert fake.of("stuck", plain + flats) == []
    assert [f.score for f in fake.of("stuck", fake.darks(3) + flats)] == [1, 2]
    views = fake.views(6)
    of_two = [replace(views[i // 2], index=i) for i in range(6)]
    assert fake.of("stuck", plain + of_two) == []
    assert [f.score for f in fake.of("stuck", fake.darks(3) + of_two)] == [1, 1, 1]
    turned = [replace(frame, counts=views[0].counts) for frame in views]  # the stage turns, and the image stays
    assert [f.score for f in fake.of("stuck", plain + turned)] == [1, 2, 3, 4, 5]


PERIOD = 0.1  # of the fake scan


@pytest.mark.parametrize(("shift", "views"), [(0.2, []), (-0.2, []), (0.3, [4, 5]), (-0.3, [4, 5])])
def test_a_frame_off_its_time(fake: Any, shift: float, views: list[int]) -> None:
    frames = fake.views(8)
    frames[4] = replace(frames[4], time=frames[4].time + shift * PERIOD)
    flags = fake.of("timing", frames)
    assert [f.frame for f in flags] == views
    if flags:
        assert flags[0].score == pytest.approx(shift)
        assert flags[0].level is Level.WARN


def test_a_missing_trigger_is_told_and_is_no_fault_of_the_frame_after_it(fake: Any) -> None:
    frames = fake.views(8)
    del frames[3:5]
    flags = fake.of("timing", frames)
    assert [(f.frame, f.score, f.level) for f in flags] == [(5, 2, Level.INFO)]
    assert bitmask(flags) == 0  # a reconstruction uses it: before, it left the good view out, too


@pytest.mark.parametrize(("armed_anew", "found"), [(False, 1), (True, 0)])
def test_a_wait_before_the_camera_was_armed_anew_is_no_finding(fake: Any, armed_anew: bool, found: int) -> None:
    """As between two passes, or after a pause: the camera counts from 0 again."""
    frames = [replace(f, time=f.time + 30 * (f.trigger >= 4)) for f in fake.views(8)]
    if armed_anew:
        frames[4:] = [replace(f, framestamp=f.trigger - 4) for f in frames[4:]]
    assert len(fake.of("timing", frames)) == found


def test_a_pass_that_is_taken_again_is_looked_at_and_views_repeated_alone_are_not(fake: Any) -> None:
    """Triggers 2 and 3 have no frame at first; the pass is then flown again, where 5 comes late and 6 not at all."""
    once = fake.views(8)
    again = [replace(f, index=6 + i, time=f.time + 30) for i, f in enumerate(once)]
    again[5] = replace(again[5], time=again[5].time + 0.3 * PERIOD)
    del once[2:4], again[6]
    late = [replace(again[i], time=60 + 2 * i, framestamp=i, replaces=-1) for i in (2, 3)]
    late[1] = replace(late[1], trigger=6)
    flags = fake.of("timing", once + again + late)
    assert [(f.score, f.level) for f in flags] == [(2, Level.INFO), (pytest.approx(0.3), Level.WARN), (1, Level.INFO)]


def test_triggers_whose_views_are_stored_are_not_missing(fake: Any) -> None:
    frames = fake.views(8)
    del frames[3:5]
    assert fake.of("timing", frames, stored=frozenset({3, 4})) == []
    assert [f.score for f in fake.of("timing", frames, stored=frozenset({4, 6}))] == [1]


@pytest.mark.parametrize(("drift", "found"), [(4, 0), (-4, 0), (6, 2), (-20, 2)])
def test_drifting_darks(fake: Any, drift: float, found: int) -> None:
    late = [replace(f, counts=(f.counts.astype(int) + drift).astype("uint16")) for f in fake.darks(2)]
    flags = fake.of("dark", fake.references() + late)
    assert len(flags) == found
    for flag in flags:
        assert flag.level is Level.WARN
        assert flag.score == pytest.approx(drift, abs=1)


def small_darks(n: int, rng: np.random.Generator) -> list[Frame]:
    """Darks of 32 x 48 pixels around 200 counts: one pixel of 30 000 counts moves their mean by 19."""
    return [
        Frame(rng.normal(200, 4, (32, 48)).round().astype(np.uint16), FrameKind.DARK, i, i, i, np.nan, 1000.0 + i, 0.05)
        for i in range(n)
    ]


def flags_of(frames: list[Frame], preview_bin: int) -> list[Flag]:
    state, found = DarkCheck().start(), []
    for frame in frames:
        look = DarkCheck().look(state, frame, digest(frame.counts, 65535, preview_bin), ScanContext(65535, 32 * 48))
        state = look.state
        found += [] if look.flag is None else [look.flag]
    return found


@pytest.mark.parametrize("preview_bin", [1, 4, 16])
@pytest.mark.parametrize("hit", [0, 3])
def test_a_zinger_in_a_small_dark_is_no_drift(rng: np.random.Generator, preview_bin: int, hit: int) -> None:
    frames = small_darks(6, rng)
    frames[hit].counts[11, 17] = 30_000
    assert abs(float(frames[3].counts.mean()) - float(frames[0].counts.mean())) > 15
    assert flags_of(frames, preview_bin) == []


@pytest.mark.parametrize("preview_bin", [4, 16])
def test_light_on_a_part_of_the_dark_is_still_seen(rng: np.random.Generator, preview_bin: int) -> None:
    frames = small_darks(6, rng)
    frames[4].counts[:, :16] += 40  # a third of the frame
    (flag,) = flags_of(frames, preview_bin)
    assert (flag.frame, flag.level) == (4, Level.WARN)
    assert 5 < flag.score < 40 / 3


def lost(scan: Blobs) -> list[Flag]:
    return scan.flags([LostCheck()])


@pytest.mark.parametrize("left", [0.0, 0.4])
def test_every_view_without_light_is_flagged_and_none_after(left: float) -> None:
    flags = lost(Blobs(40, counts=lambda view, light: light * (left if 20 <= view < 33 else 1.0)))
    assert [flag.frame for flag in flags] == list(range(30, 43))
    assert all(flag.level is Level.ALARM for flag in flags)
    assert flags[0].score == pytest.approx(1 - left, abs=0.05)


def test_a_view_of_one_value_was_never_written() -> None:
    dark = ScanContext(np.inf, 64, None, 0.1, light_left=0.0)
    for image, said in (
        (np.zeros((8, 8)), "every pixel of this frame has the same value"),
        (100 + np.eye(8), "the beam is lost (100% of the intensity"),
    ):
        counts = image.astype(np.uint16)
        frame = Frame(counts, FrameKind.PROJECTION, 7, 7, 7, 0.0, 0.0, 1.0)
        flag = LostCheck().look(LostState(), frame, digest(counts), dark).flag
        assert flag is not None and flag.level is Level.ALARM and said in flag.advice


def test_it_alone_ends_a_scan() -> None:
    assert [check.name for check in CHECKS if check.policy is not Policy.LOG] == ["lost"]
