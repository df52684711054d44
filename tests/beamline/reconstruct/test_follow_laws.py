"""Error model of a followed scan: measured once at the end of each pass, from all projections so far."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from beamline.core.events import Event
from beamline.core.recon_events import LawMeasured
from beamline.projections.prepare import prepare_projections
from beamline.projections.selection import Selection
from beamline.projections.views import select
from beamline.reconstruct import live_steps
from beamline.reconstruct.live_fit import ScanFollower
from beamline.reconstruct.live_states import Cursor
from beamline.reconstruct.pipeline import reconstruct_file
from beamline.storage.readers.open import SourceOptions, open_scan
from drivers.base.frame import Frame, FrameKind
from recon.base.error_law import ErrorLaw
from recon.base.geometry import Geometry
from tests.beamline.reconstruct.growing_scan import (
    BRIEF,
    INTERLACED,
    SCAN,
    ScanClock,
    alarms,
    close,
    follower_of,
    options,
    schedule,
)
from tests.beamline.scans import BEAM, frames_of

pytestmark = pytest.mark.usefixtures("one_thread")

FRAMES = frames_of(INTERLACED)  # four references, and three passes of ten views
ENDS = (14, 24, 34)


@dataclass
class Laws:
    """Takes the place of the numerics: what it was asked, and an error that it raises."""

    asked: list[tuple[np.ndarray, Geometry, list[int]]] = field(default_factory=list)
    error: Exception | None = None
    offset: float = 0.0

    def __call__(
        self,
        data: np.ndarray,
        geometry: Geometry,
        sizes: Sequence[int],
        rng: np.random.Generator,
        open_beam: np.ndarray,
    ) -> tuple[ErrorLaw, float]:
        self.asked.append((data, geometry, list(sizes)))
        self.open_beam = open_beam
        if self.error is not None:
            raise self.error
        return ErrorLaw(sizes[-1], 1.5, 0.1, 0.25, self.offset), 0.5 * len(sizes)

    @property
    def sizes(self) -> list[list[int]]:
        return [sizes for _, _, sizes in self.asked]


@pytest.fixture
def laws(monkeypatch: pytest.MonkeyPatch) -> Laws:
    stand_in = Laws()
    monkeypatch.setattr("beamline.reconstruct.pass_laws.measured_law", stand_in)
    return stand_in


@dataclass
class Followed:
    """A scan of a frame a second, and who follows it."""

    clock: ScanClock
    follower: ScanFollower
    events: list[Event]

    def seconds(self, n: float) -> None:
        self.clock.sleep(n)
        self.follower.take_new_frames(False)
        self.follower.measure_law()

    def of(self, name: str) -> list[dict[str, Any]]:
        return [event.data for event in self.events if event.event == name]


@pytest.fixture
def follow(tmp_path: Path) -> Iterator[Callable[..., Followed]]:
    begun: list[Followed] = []

    def begin(
        frames: Sequence[Frame] = FRAMES,
        passes: Sequence[int] = ENDS,
        changes: dict[str, Any] | None = None,
        **how: Any,
    ) -> Followed:
        clock, events = ScanClock(), list[Event]()
        schedule(clock, tmp_path / "scan.h5", list(frames), period=1.0, passes=passes, **how)
        clock.sleep(1.0)
        wanted = options(tmp_path, **(changes or {}))
        begun.append(Followed(clock, follower_of(wanted, clock, events), events))
        return begun[-1]

    yield begin
    for scan in begun:
        scan.follower.source.close()
        close(scan.clock)


def test_one_law_a_pass_of_all_views_until_its_end(laws: Laws, follow: Callable[..., Followed], tmp_path: Path) -> None:
    scan = follow()
    scan.seconds(13)
    assert not laws.asked  # a view is missing
    for n in (1, 1, 9, 10):
        scan.seconds(n)
        scan.seconds(0)
    assert laws.sizes == [[10], [10, 20], [10, 20, 30]]
    events = scan.of("error_law")
    assert [(law["n_views"], law["exponent"], law["noise"], law.get("gained")) for law in events] == [
        (n, 1.5, 0.25, gained) for n, gained in ((10, 0.5), (20, 1.0), (30, 1.5))
    ]
    assert isinstance(scan.events[-1], LawMeasured)
    close(scan.clock)
    with open_scan(tmp_path / "scan.h5") as source:
        whole = prepare_projections(select(source, Selection(axis_col=SCAN.axis_col)), lambda sentence: None)
    for n, (data, geometry, _) in zip((10, 20, 30), laws.asked, strict=True):
        np.testing.assert_allclose(data[: n - 1], whole.seen.data[: n - 1], atol=1e-6)
        assert data[n - 1] == pytest.approx(whole.seen.data[n - 1], abs=0.1)  # provisional
        np.testing.assert_array_equal(geometry.angles, whole.geometry.angles[:n])


def test_a_pass_that_the_next_one_overtakes_is_left_out_and_later_views_have_no_part(
    laws: Laws, follow: Callable[..., Followed]
) -> None:
    follow().seconds(28)
    assert laws.sizes == [[10, 20]] and len(laws.asked[0][0]) == laws.asked[0][1].n_views == 20


def test_a_law_waits_until_every_view_of_its_pass_is_corrected(
    laws: Laws, follow: Callable[..., Followed], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live_steps, "BATCH_VIEWS", 8)
    scan, asked = follow(), []
    for n in (28, 0, 0):
        scan.seconds(n)
        asked.append(len(laws.asked))
    assert asked == [0, 0, 1] and laws.sizes == [[10, 20]]


def _noisy(frames: Sequence[Frame]) -> list[Frame]:
    """The frames after three more flats, with the noise of photons."""
    rng = np.random.default_rng(0)
    order = [*frames[:4], *[frames[2]] * 3, *frames[4:]]
    return [
        replace(frame, counts=rng.poisson(frame.counts).astype(np.uint16), index=i) for i, frame in enumerate(order)
    ]


def test_flats_show_the_noise_of_a_frame(laws: Laws, follow: Callable[..., Followed]) -> None:
    scan = follow(_noisy(FRAMES), (17,))
    scan.seconds(17)
    noise = np.diff(laws.open_beam, axis=0) / np.sqrt(2)
    assert laws.open_beam.shape == (5, *SCAN.shape)
    assert noise.std() == pytest.approx(1 / np.sqrt(BEAM), rel=0.15)


@pytest.mark.slow
def test_the_law_of_a_scan_of_64_views(follow: Callable[..., Followed]) -> None:
    angles = np.pi * np.arange(64) / 64
    scan = replace(SCAN, angles=np.concatenate([angles[::2], angles[1::2]]))
    followed = follow(_noisy(frames_of(scan)), (39, 71))
    followed.seconds(39)
    (none,) = followed.of("error_law")  # too few
    assert (none["n_views"], np.isnan(none["exponent"])) == (
        32,
        True,
    ) and "3 frames of the open beam are needed; got 32 projections and 5 frames" in none["reason"]
    (warning,) = followed.of("warning")
    assert "3 frames of the open beam are needed; got 32 projections and 5 frames" in warning["message"]
    followed.seconds(32)
    _, law = followed.of("error_law")
    assert law["n_views"] == 64 and 0 < law["exponent"] < 1 and 0 <= law["noise"] <= 1 and law["offset"] == 0


@pytest.mark.slow
def test_a_scan_that_does_not_decide_has_no_law(laws: Laws, tmp_path: Path) -> None:
    clock, events = ScanClock(), list[Event]()
    schedule(clock, tmp_path / "scan.h5", FRAMES, pause=1.0)
    reconstruct_file(options(tmp_path, method=BRIEF), events.append, clock)
    assert not laws.asked and events[-1].event == "done"


@pytest.mark.slow
def test_laws_come_while_the_volume_grows(laws: Laws, tmp_path: Path) -> None:
    clock, events = ScanClock(), list[Event]()
    schedule(clock, tmp_path / "scan.h5", FRAMES, period=0.3, pause=2.0, passes=ENDS)
    reconstruct_file(options(tmp_path, method=BRIEF), events.append, clock)
    assert [event.data["n_views"] for event in events if event.event == "error_law"] == [10, 20, 30]


@pytest.mark.parametrize("error", [ValueError("the views show no matter"), MemoryError()])
def test_what_prevents_a_law_is_one_sentence_and_the_fit_goes_on(
    laws: Laws, follow: Callable[..., Followed], error: Exception
) -> None:
    laws.error = error
    scan = follow()
    for n in (14, 10, 10):
        scan.seconds(n)
    (warning,) = scan.of("warning")
    assert len(laws.asked) == 3 and (str(error) or "memory") in warning["message"]
    assert scan.follower.n_views_taken == 30
    assert [(law["n_views"], str(error) in law["reason"]) for law in scan.of("error_law")] == [
        (n, True) for n in (10, 20, 30)
    ]


def test_a_mistake_is_not_taken_for_a_scan_without_a_law(laws: Laws, follow: Callable[..., Followed]) -> None:
    laws.error = ZeroDivisionError()
    with pytest.raises(ZeroDivisionError):
        follow().seconds(14)


def test_views_that_the_fit_leaves_out_have_no_part_and_repeated_angles_stay(
    laws: Laws, follow: Callable[..., Followed]
) -> None:
    """Here rows 6 and 13, which have an alarm, and offset views. The second pass has the angles of the first."""
    views = FRAMES[4:14]
    wide = [replace(frame, kind=FrameKind.OFFSET_VIEW, aside=18.0) for frame in views[:3]]
    order = [*FRAMES[:14], *wide, *views]
    laws.offset = 0.2
    frames = [replace(frame, index=i) for i, frame in enumerate(order)]
    scan = follow(frames, (14, 27), flags=alarms(6, 13), offset_views=True)
    for n in (14, 13):
        scan.seconds(n)
    assert laws.sizes == [[8], [8, 18]]
    angles = np.delete(INTERLACED.angles[:10], (2, 9))
    np.testing.assert_allclose(laws.asked[1][1].angles, [*angles, *INTERLACED.angles[:10]], atol=1e-6)
    shares = [(law["noise"], law["offset"]) for law in scan.of("error_law")]
    assert shares == [(0.25, 0.2), (0.25 / 0.8, 0.0)]  # offset views make known what lies beside the field


def test_the_pass_before_wide_views_is_not_measured_again_and_they_are_among_the_views_of_the_volume(
    laws: Laws, follow: Callable[..., Followed]
) -> None:
    wide = [replace(frame, kind=FrameKind.OFFSET_VIEW, aside=18.0, index=14 + i) for i, frame in enumerate(FRAMES[4:7])]
    scan = follow([*FRAMES[:14], *wide], (14, 17), offset_views=True)
    for n in (14, 3):
        scan.seconds(n)
    assert laws.sizes == [[10], [10, 10]]
    prepared = scan.follower.end().prepared
    assert prepared.geometry.is_centred.tolist() == [True] * 10 + [False] * 3
    np.testing.assert_allclose(prepared.geometry.shifts[:, 0] * prepared.geometry.pixel_pitch, [0] * 10 + [18.0] * 3)
    assert (prepared.origin.n_projections, prepared.centred.geometry.n_views) == (10, 10)


def test_a_view_that_was_taken_again_has_no_part_though_the_fit_has_learnt_it(
    laws: Laws, follow: Callable[..., Followed]
) -> None:
    scan = follow([*FRAMES[:14], replace(FRAMES[5], index=14, replaces=5)], (14, 15))
    for n in (14, 1):
        scan.seconds(n)
    assert laws.sizes == [[10], [9, 10]]
    angles = INTERLACED.angles
    np.testing.assert_allclose(laws.asked[1][1].angles, [angles[0], *angles[2:10], angles[1]], atol=1e-6)


def test_a_selection_of_views_stands_for_all(laws: Laws, follow: Callable[..., Followed]) -> None:
    scan = follow(changes={"selection": Selection(views="every:2", axis_col=SCAN.axis_col)})
    for n in (14, 10):
        scan.seconds(n)
    assert laws.sizes == [[5], [5, 10]]
    assert [(law["number"], law["n_views"]) for law in scan.of("error_law")] == [(1, 5), (2, 10)]


def test_a_pass_without_a_view_that_can_be_used_has_no_law(laws: Laws, follow: Callable[..., Followed]) -> None:
    scan = follow(flags=alarms(*range(4, 14)))
    scan.seconds(14)
    assert not laws.asked
    assert [law["reason"] for law in scan.of("error_law")] == ["none of the projections can be used"]


def test_before_the_axis_is_known_there_is_no_law_and_the_scan_is_told_at_once(
    laws: Laws, follow: Callable[..., Followed]
) -> None:
    scan = follow(passes=(7, 24), changes={"selection": Selection()})
    for n in (7, 1):
        scan.seconds(n)
    (warning,) = scan.of("warning")
    assert "rotation axis" in warning["message"] and not laws.asked
    (none,) = scan.of("error_law")
    assert (none["number"], none["reason"]) == (1, "the rotation axis is not known yet")
    scan.seconds(16)
    assert laws.sizes == [[3, 20]]


def test_where_flats_come_after_the_views_there_is_no_law_and_the_scan_is_told_at_once(
    laws: Laws, follow: Callable[..., Followed]
) -> None:
    """With a known axis. The flats are rows 2 and 3, which come last here."""
    order = [*FRAMES[:2], *FRAMES[4:], *FRAMES[2:4]]
    scan = follow([replace(frame, index=i) for i, frame in enumerate(order)], (12, 22, 32))
    for n in (11, 1, 10):
        scan.seconds(n)
    assert [(law["number"], law["reason"]) for law in scan.of("error_law")] == [
        (n, "darks or flats have not been taken yet") for n in (1, 2)
    ]
    assert len(scan.of("warning")) == 1 and not laws.asked


def test_a_law_waits_for_views_of_its_pass_that_may_show_the_axis(
    laws: Laws, follow: Callable[..., Followed], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The end of a pass is read after the number of frames: the file may have grown in between."""
    scan = follow(changes={"selection": Selection()})
    monkeypatch.setattr(scan.follower, "_cursor", Cursor(frames=13))
    source = scan.follower.source
    source.table = replace(source.table, pass_ends=np.array([14]))
    scan.follower.measure_law()
    assert not scan.of("error_law")


def test_a_resumed_run_has_the_passes_of_all_parts(laws: Laws, follow: Callable[..., Followed], tmp_path: Path) -> None:
    clock = ScanClock()
    schedule(clock, tmp_path / "first.h5", FRAMES[:20], status="stopped", passes=(14,))
    close(clock)
    later = [replace(frame, index=i) for i, frame in enumerate([*FRAMES[:4], *FRAMES[20:]])]
    source = SourceOptions(tmp_path / "scan.h5", earlier=(tmp_path / "first.h5",))
    scan = follow(later, (8, 18), changes={"source": source})
    for n in (1, 8, 10):
        scan.seconds(n)
        scan.seconds(0)
    assert laws.sizes == [[10], [10, 20], [10, 20, 30]]
    np.testing.assert_allclose(laws.asked[-1][1].angles, INTERLACED.angles, atol=1e-6)
