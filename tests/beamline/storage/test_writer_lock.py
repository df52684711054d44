"""The lock of a program on the file that it writes."""

from __future__ import annotations

import os
import threading
import time
from pathlib import Path

import pytest

from beamline.storage.writer_lock import QUIET, WriterLock, WriterWatch, abandoned, held


def test_a_file_is_held_until_its_lock_is_released_and_an_exclusive_one_is_refused_at_once(tmp_path: Path) -> None:
    (tmp_path / "a").touch()
    assert not held(tmp_path / "a")
    lock = WriterLock(tmp_path / "a")
    assert held(tmp_path / "a")
    with pytest.raises(OSError):
        WriterLock(tmp_path / "a", exclusive=True)
    lock.release()
    assert not held(tmp_path / "a") and not held(tmp_path / "none")


def test_a_writer_gets_its_lock_though_somebody_asks_whether_it_is_held(tmp_path: Path) -> None:
    """`held` takes the lock for a moment."""
    (tmp_path / "a").touch()
    asking = WriterLock(tmp_path / "a", exclusive=True)
    threading.Timer(0.03, asking.release).start()
    lock = WriterLock(tmp_path / "a")
    assert held(tmp_path / "a")
    lock.release()
    assert not held(tmp_path / "a")


def test_a_writer_that_gives_up_its_lock_is_gone_at_once_unless_it_finished(tmp_path: Path) -> None:
    (tmp_path / "a").touch()
    lock = WriterLock(tmp_path / "a")
    watch = WriterWatch(tmp_path / "a", 0.0, patience=10.0)
    assert not any(watch.lost(now, False, lambda: False) for now in (5.0, 50.0, 500.0))  # it waits, and has the lock
    lock.release()
    assert not watch.lost(502.0, False, lambda: True)
    ended = "is no longer being written, because the program that wrote it has ended"
    assert watch.lost(502.5, False, lambda: False) == ended


def test_a_writer_without_a_lock_is_gone_when_no_frame_comes(tmp_path: Path) -> None:
    (tmp_path / "a").touch()
    watch = WriterWatch(tmp_path / "a", 0.0, patience=10.0)
    assert not watch.lost(9.0, True, lambda: False) and not watch.lost(18.0, False, lambda: False)
    assert watch.lost(19.5, False, lambda: False) == "has not grown for 10 s"


def test_a_file_is_abandoned_when_it_is_quiet_and_not_held(tmp_path: Path) -> None:
    (tmp_path / "a").touch()
    assert not abandoned(tmp_path / "a")
    os.utime(tmp_path / "a", (time.time() - 2 * QUIET,) * 2)
    assert abandoned(tmp_path / "a")
    lock = WriterLock(tmp_path / "a")
    assert not abandoned(tmp_path / "a")
    lock.release()
