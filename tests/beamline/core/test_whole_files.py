"""Whole files: what the disk refuses, or gives back otherwise, leaves nothing, and the older file untouched."""

from __future__ import annotations

import errno
from pathlib import Path

import pytest

from beamline.core import files
from beamline.core.errors import DataError
from beamline.core.files import whole_file, write_whole


def test_what_the_disk_refuses_late_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As where writes are delayed: only fsync tells."""

    def fsync(handle: int) -> None:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(files, "_fsync", fsync)
    with pytest.raises(DataError, match=r"page.html could not be written .Input/output error.*nothing is left of it"):
        write_whole(tmp_path / "page.html", "a page")
    with pytest.raises(DataError, match="Input/output error"), whole_file(tmp_path / "folder") as partial:
        (partial / "below").mkdir(parents=True)
        (partial / "below" / "chunk").write_bytes(b"1")
    assert not list(tmp_path.iterdir())


def test_what_is_read_back_is_compared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "table.csv"
    write_whole(path, "old")
    monkeypatch.setattr(files, "bring_to_disk", lambda partial: partial.write_bytes(b"nex"))
    with pytest.raises(DataError, match=r"not what was written.*what was there is untouched"):
        write_whole(path, "new", replace=True)
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]
