"""`beamline ride` stores each frame with its angle, or reports those it does not know, whatever the frame numbers
do."""

from __future__ import annotations

import re
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_ioc import TOMOSCAN, FakeIoc, array_value, counts_of
from ridden import Stored, Told, config_of, ride_along, stored

from beamline.core.errors import ConfigError, ScanStopped
from beamline.core.stop import StopRequest
from beamline.scan.ledger import LedgerError

pytestmark = pytest.mark.usefixtures("loopback")
WORDS = {0: "data", 1: "data_white", 2: "data_dark"}
KINDS: dict[str, Any] = {
    "kinds": "HDF5FrameLocation",
    "darks": {"count": 5, "at": "start"},
    "flats": {"count": 5, "at": "both"},
}


def _pixels(kind: int, i: int) -> Any:
    """Of frame i of a kind, whatever its number."""
    return counts_of(1000 * (kind + 1) + i) + np.uint16((10_000, 20_000, 0)[kind])


def _rows(kind: int, triggers: Iterable[int], first: int, step: int = 1, word: str | None = "") -> list[Any]:
    """Frames of a kind with numbers from `first` on: (kind, trigger, number, attributes)."""
    told = f"/exchange/{WORDS[kind]}" if word == "" else word
    return [(kind, i, first + step * n, {"HDF5FrameLocation": told}) for n, i in enumerate(triggers)]


def _send(
    ioc: FakeIoc, rows: Iterable[Any], period: float = 0.02, begin: float | None = None, stated: float = 0.0
) -> None:
    """Send frames, one each `period` s. `begin`: the time that the first one states, each later one `stated` s later;
    None: the time at which it is sent."""
    for n, (kind, i, number, attributes) in enumerate(rows):
        seconds = None if begin is None else begin + n * stated
        ioc.post(array_value(_pixels(kind, i), number, attributes, seconds))
        time.sleep(period)


def _wrong(file: Stored, views: int = 20, step: float = 9.0) -> list[tuple[int, float]]:
    """The true trigger and the stored angle of views whose pixels are of another angle, in a file without others."""
    true = {_pixels(0, i).tobytes(): i for i in range(views)}
    rows = [(true.get(file.counts[row].tobytes(), -1), float(file.degrees[row])) for row in file.of(0)]
    return [(i, angle) for i, angle in rows if i < 0 or not np.isclose(angle, step * i)]


def _views(file: Stored) -> list[int]:
    return [int(i) for i in file.triggers[file.of(0)]]


def _ridden(folder: Path, rows: list[Any], stop_after: float | None = None, **ride: Any) -> tuple[Told, list[Stored]]:
    def scan(stop: StopRequest) -> None:
        _send(ioc, rows)
        if stop_after is not None:
            time.sleep(stop_after)
            stop.stop("the test waits no longer")

    with FakeIoc() as ioc:
        told = ride_along(config_of(folder, ioc.url, **ride), folder, scan)
    return told, stored(folder)


BEFORE = [*_rows(2, range(5), 1), *_rows(1, range(5), 6)]
SCAN = [*BEFORE, *_rows(0, range(20), 11), *_rows(1, range(5, 10), 31)]


@pytest.mark.parametrize("lost", [0, 1])
@pytest.mark.parametrize("pause", [0.0, 1.0])
def test_a_camera_that_ran_free_before_the_projections(tmp_path: Path, pause: float, lost: int) -> None:
    """Its count goes on: only the rise since it stood says what is lost. Without a pause the first that came counts."""

    def scan(stop: StopRequest) -> None:
        for n in range(1, 30 + 60 + 1):
            if n == 31:
                time.sleep(pause)
                ioc.tomoscan(ScanStatus="Collecting projections")
                time.sleep(0.05)
            if not 31 <= n < 31 + lost:
                ioc.post(array_value(counts_of(n), n))
            ioc.put({"cam1:NumImagesCounter_RBV": float(n)})
            time.sleep(0.04)
        ioc.tomoscan(ScanStatus="Scan complete")

    with FakeIoc(camera=True) as ioc:
        views = {"NumAngles": 60.0, "RotationStep": 3.0, "RotationStart": 0.0}
        ioc.tomoscan(**{**TOMOSCAN, "NumDarkFields": 0.0, "NumFlatFields": 0.0, **views})
        angles = {"from": "tomoscan", "prefix": "pva://T:TomoScan:"}
        told = ride_along(config_of(tmp_path, ioc.url, angles, camera="pva://T:cam1:"), tmp_path, scan)
    (file,) = stored(tmp_path)
    said = f"{told.error}{told.warnings}"
    if lost and not pause:
        assert file.ids.tolist() == [*range(32, 91)] and "Frame 32 counts as the first" in said
        assert "the missing frame may be the first" in said
    else:
        assert np.allclose(file.degrees, 3.0 * (file.ids - 31)) and file.missing == [*range(lost)]
        assert (told.error is None) is (lost == 0) and "counts as the first" not in said


def test_a_ride_that_subscribes_late_says_that_it_may_be_the_first_that_are_missing(tmp_path: Path) -> None:
    """Also where the server restarts meanwhile, in both files, and at a stop."""
    with FakeIoc() as ioc:
        _send(ioc, _rows(0, range(5), 1))  # before the ride subscribes
        before = time.time()  # the IOC's times are exact, however late this process sends
        ioc.post(array_value(_pixels(0, 5), 6, seconds=before))

        def scan(stop: StopRequest) -> None:
            _send(ioc, _rows(0, range(6, 12), 7), begin=before + 0.5, stated=0.5)
            _send(ioc, _rows(0, range(13, 16), 1), begin=before + 4.0, stated=0.1)  # the numbers begin anew
            time.sleep(2.5)
            stop.stop("the test waits no longer")

        told = ride_along(config_of(tmp_path, ioc.url), tmp_path, scan)
    one, other = stored(tmp_path)
    assert isinstance(told.error, ScanStopped) and _views(one) == [*range(6)] and _views(other) == [0, 1, 2]
    assert len(re.findall(r"Frame \d+ counts as the first projection", told.warnings)) == 2
    assert "the missing 17 frames may be the first" in str(told.error)


def test_neighbours_that_are_exchanged_are_stored_in_one_file(tmp_path: Path) -> None:
    """As areaDetector counts in DisorderedArrays; also the first and the last two, and across blocks."""
    rows = list(SCAN)
    for i in (0, 4, 9, 15, 20, 28, 33):
        rows[i], rows[i + 1] = rows[i + 1], rows[i]
    told, (file,) = _ridden(tmp_path, rows, **KINDS)
    assert told.error is None and not told.warnings and not _wrong(file)
    assert file.kinds.tolist() == [2] * 5 + [1] * 5 + [0] * 20 + [1] * 5 and _views(file) == [*range(20)]


def test_a_first_dark_that_was_lost_shifts_kinds_by_order_which_is_said(tmp_path: Path) -> None:
    """The ride waits for the last frame of the plan until a stop, long after the last that came."""
    rows: list[Any] = [(k, i, n, {}) for k, i, n, _ in SCAN[1:]]
    told, (file,) = _ridden(tmp_path, rows, stop_after=2.0, **{**KINDS, "kinds": None})
    assert file.kinds.tolist() == [2] * 5 + [1] * 5 + [0] * 20 + [1] * 4 and len(_wrong(file)) == 20
    assert (
        "1 of 5 flats is missing: 4. The number of the first projection is not known, so the missing frame may be the "
        in (said := str(told.error))
    )
    assert (
        "the first and last frames of each block are stored as frames of the neighbouring block (dark, flat or "
        "projection), and all angles "
        "are 9° larger than stated. Set ride.kinds" in said
    )


def _renumbered(numbers: Iterable[int], words: bool = True) -> list[Any]:
    return [(k, i, n, a if words else {}) for (k, i, _, a), n in zip(SCAN, numbers, strict=True)]


@pytest.mark.parametrize(
    ("numbers", "by_order", "words"),
    [
        ([*range(1, 6), *range(1, 6), *range(1, 21), *range(1, 6)], True, ""),
        ([*range(1, 6), *range(1, 6), *range(1, 21), *range(1, 6)], False, ""),
        ([*range(0, 5), *range(0, 5), *range(0, 20), *range(0, 5)], True, ""),
        ([(65515 + i - 1) % 65535 + 1 for i in range(35)], False, ""),
        ([(65515 + i) % 65536 for i in range(35)], True, ""),
        ([5 * i + 5 for i in range(35)], False, "rise by 5, because a plugin averages 5 frames"),
        ([5 * i + 5 for i in range(35)], True, "rise by 5, because a plugin averages 5 frames"),
    ],
)
def test_numbers_of_acquisitions_of_16_bits_and_of_a_plugin_that_averages(
    tmp_path: Path, numbers: list[int], by_order: bool, words: str
) -> None:
    settings = {**KINDS, "kinds": None} if by_order else KINDS
    told, (file,) = _ridden(tmp_path, _renumbered(numbers, words=not by_order), **settings)
    assert told.error is None and not _wrong(file) and len(_views(file)) == 20
    assert file.kinds.tolist() == [2] * 5 + [1] * 5 + [0] * 20 + [1] * 5
    assert words in told.warnings and bool(words) is bool(told.warnings)


def test_a_number_that_never_changes_is_refused(tmp_path: Path) -> None:
    told, files = _ridden(tmp_path, [(k, i, 0, {}) for k, i, *_ in SCAN])
    assert isinstance(told.error, ConfigError) and not files
    assert "uniqueId stays at 0 while the pixels change" in str(told.error)


@pytest.mark.parametrize("word", [None, "", "gone"])
def test_a_kind_that_is_not_told_for_three_frames_does_not_begin_the_angles_again(
    tmp_path: Path, word: str | None
) -> None:
    rows = [(k, i, n, {} if word == "gone" else {"HDF5FrameLocation": word or " "}) if 16 < n < 20 else (k, i, n, a)
            for k, i, n, a in SCAN]  # fmt: skip
    told, (file,) = _ridden(tmp_path, rows, **KINDS)
    assert told.error is None and not _wrong(file) and _views(file) == [*range(20)]


@pytest.mark.parametrize("odd", [0, 14, 17])
def test_one_frame_of_another_size_is_named_and_the_rest_stays(tmp_path: Path, odd: int) -> None:
    def scan(stop: StopRequest) -> None:
        for n, (kind, i, number, attributes) in enumerate(SCAN):
            pixels = counts_of(1, (8, 24)) if n == odd else _pixels(kind, i)
            ioc.post(array_value(pixels, number, attributes))
            time.sleep(0.02)

    with FakeIoc() as ioc:
        told = ride_along(config_of(tmp_path, ioc.url, **KINDS), tmp_path, scan)
    (file,) = stored(tmp_path)
    assert isinstance(told.error, LedgerError) and not _wrong(file)
    assert f"Frame {odd + 1} is " in told.warnings + " ".join(told.before) and "another size" in str(told)
    assert len(file.ids) == 34


@pytest.mark.parametrize("restarts", [False, True])
def test_flats_within_the_projections_by_their_kind(tmp_path: Path, restarts: bool) -> None:
    """What follows has its angles: flats are none of the triggers of the projections."""
    firsts = (1, 1, 1, 1, 1) if restarts else (6, 11, 21, 26, 36)
    parts = [(1, range(5)), (0, range(10)), (1, range(5, 10)), (0, range(10, 20)), (1, range(10, 15))]
    rows = [row for first, (kind, which) in zip(firsts, parts, strict=True) for row in _rows(kind, which, first)]
    told, (file,) = _ridden(tmp_path, rows, **{**KINDS, "darks": {"count": 0}})
    assert told.error is None and not _wrong(file) and _views(file) == [*range(20)]
    assert file.kinds.tolist() == [1] * 5 + [0] * 10 + [1] * 5 + [0] * 10 + [1] * 5
    assert "Darks or flats came between the projections. The projections continue with projection 10" in told.warnings
