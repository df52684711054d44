"""Changes to a file: none where its disk has no room; wherever they stop, the file is marked and can be ended."""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path
from types import SimpleNamespace

import h5py
import numpy as np
import pytest

from beamline.core.errors import DataError
from beamline.storage import overlay as module
from beamline.storage.overlay import Overlay, PartlyChangedError
from beamline.storage.superblock import superblock
from beamline.storage.writers import layout


@pytest.fixture
def path(tmp_path: Path) -> Path:
    with h5py.File(tmp_path / "s.h5", "w", libver=layout.LIBVER) as file:
        file["a"] = np.arange(3000)
    return tmp_path / "s.h5"


def changed(path: Path) -> tuple[Overlay, bytes]:
    """Values in two pages, and a longer file; and the file as it shall be."""
    overlay = Overlay(path)
    with h5py.File(overlay, "r+", libver=layout.LIBVER) as file:
        file["a"][[1, 2000]] = -1
        file["b"] = np.arange(4000)
    overlay.seek(0, os.SEEK_END)
    n = overlay.tell()
    overlay.seek(0)
    return overlay, overlay.read(n)


def test_what_is_written_is_not_on_the_disk_until_it_is_carried_out(path: Path) -> None:
    before = path.read_bytes()
    overlay, expected = changed(path)
    assert path.read_bytes() == before != expected and overlay.changed
    assert overlay.room == len(expected) - len(before)
    copy = overlay.copy()
    copy.put(100, b"other")
    overlay.carry_out()
    assert path.read_bytes() == expected and not Overlay(path).changed
    assert list(path.parent.iterdir()) == [path]


def test_beyond_its_end_a_file_is_zero(path: Path) -> None:
    n = path.stat().st_size
    overlay = Overlay(path, n + 100)
    overlay.seek(n)
    assert overlay.read(100) == bytes(100)
    overlay.truncate(10)
    assert not overlay.changed  # never shorter than it is


def test_a_disk_without_room_is_refused_with_what_is_needed(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before, (overlay, _) = path.read_bytes(), changed(path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=8000))
    with pytest.raises(DataError, match=r"needs \S+ kB .*Nothing was"):
        overlay.carry_out()
    assert path.read_bytes() == before


@pytest.mark.parametrize("call", [1, 2, 3, 4])
def test_a_disk_that_fails_says_what_became_of_the_file(path: Path, call: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """fsync of what makes the file longer, of the mark, of what changes, of the head."""
    before, (overlay, expected), calls = path.read_bytes(), changed(path), list[int]()

    def fsync(handle: int) -> None:
        calls.append(handle)
        if len(calls) == call:
            raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(module, "to_disk", fsync)
    with pytest.raises(DataError, match="Input/output error") as raised:
        overlay.carry_out()
    now, head = path.read_bytes(), superblock(path)
    assert isinstance(raised.value, PartlyChangedError) == (call > 1) and head is not None and head.intact
    assert (now == before) == (call == 1) and (now == expected) == (call == 4)
    assert head.open_for_writing == head.grows == (call in (2, 3))
    assert call < 3 or now[48:] == expected[48:]
