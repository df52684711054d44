"""Bands: every row once, whatever the threads, and errors come through."""

from __future__ import annotations

import threading

import numba
import pytest

from simulators.pixels import bands


@pytest.mark.parametrize("threads", [1, 2, 3, 7])
@pytest.mark.parametrize("shape", [(1, 100_000), (5, 100_000), (1000, 100), (3, 4)])
def test_every_row_is_done_once(monkeypatch: pytest.MonkeyPatch, threads: int, shape: tuple[int, int]) -> None:
    monkeypatch.setattr(numba.config, "NUMBA_NUM_THREADS", threads)
    rows: list[int] = []
    bands.share_rows(lambda first, end: rows.extend(range(first, end)), shape)
    assert sorted(rows) == list(range(shape[0]))


def test_small_frames_stay_in_their_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(numba.config, "NUMBA_NUM_THREADS", 2)
    seen: list[threading.Thread] = []
    bands.share_rows(lambda first, end: seen.append(threading.current_thread()), (64, 64))
    assert seen == [threading.current_thread()]
    bands.share_rows(lambda first, end: seen.append(threading.current_thread()), (2048, 64))
    assert threading.current_thread() not in seen[1:]


def test_an_error_comes_through(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(numba.config, "NUMBA_NUM_THREADS", 2)
    with pytest.raises(ZeroDivisionError):
        bands.share_rows(lambda first, end: 1 // 0, (1000, 1000))
