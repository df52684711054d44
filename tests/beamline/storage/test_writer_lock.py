"""The lock of a program on the file that it writes."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

from beamline.storage.writer_lock import WriterLock, held


def test_a_file_is_held_until_its_lock_is_released(tmp_path: Path) -> None:
    (tmp_path / "a").touch()
    assert not held(tmp_path / "a")
    lock = WriterLock(tmp_path / "a")
    assert held(tmp_path / "a")
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


def test_an_exclusive_lock_is_refused_at_once(tmp_path: Path) -> None:
    (tmp_path / "a").touch()
    lock = WriterLock(tmp_path / "a")
    with pytest.raises(OSError):
        WriterLock(tmp_path / "a", exclusive=True)
    lock.release()
