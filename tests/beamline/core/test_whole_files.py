"""Files are written completely or not at all: if the disk fails, an older file stays unchanged."""

import errno
import subprocess
import sys
from pathlib import Path

import pytest

from beamline.core import files
from beamline.core.errors import DataError
from beamline.core.files import atomic_file, write_whole
from tests.messages import refused


def test_what_the_disk_refuses_late_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As where writes are delayed: only fsync tells."""

    def fsync(handle: int) -> None:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr("os.fsync", fsync)
    with refused(DataError):
        write_whole(tmp_path / "page.html", "a page")
    with refused(DataError), atomic_file(tmp_path / "folder") as partial:
        (partial / "below").mkdir(parents=True)
        (partial / "below" / "chunk").write_bytes(b"1")
    assert not list(tmp_path.iterdir())


def test_what_is_read_back_is_compared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "table.csv"
    write_whole(path, "old")
    monkeypatch.setattr(files, "bring_to_disk", lambda partial: partial.write_bytes(b"nex"))
    with refused(DataError):
        write_whole(path, "new", replace=True)
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


def test_what_a_killed_program_left_is_removed_by_the_next_that_writes_there(tmp_path: Path) -> None:
    path, code = tmp_path / "volume.h5", "\n".join(
        (
            "import os, sys, pathlib, beamline.core.files as files",
            "with files.atomic_file(pathlib.Path(sys.argv[1])) as partial:",
            "    partial.write_bytes(b'half')",
            "    if sys.argv[2] == 'dies': os._exit(9)",
            "    print(flush=True), input()",
        )
    )  # fmt: skip
    subprocess.run([sys.executable, "-c", code, path, "dies"], check=False)
    elsewhere, other = (tmp_path / f".{name}.00000000-1-abcd.partial" for name in ("volume.h5", "volume.h5.csv"))
    for kept in (elsewhere, other):
        kept.touch()
    with subprocess.Popen(
        [sys.executable, "-c", code, path, "lives"], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        assert process.stdout is not None and process.stdout.readline()
        (alive,) = {entry for entry in tmp_path.iterdir() if f"-{process.pid}-" in entry.name}
        with atomic_file(path) as partial:
            assert {*tmp_path.iterdir()} == {elsewhere, other, alive}
            partial.write_bytes(b"whole")
        process.kill()
    assert path.read_bytes() == b"whole"


def test_a_link_to_what_is_not_there_is_never_replaced(tmp_path: Path) -> None:
    """As to a disk that is not mounted; the links of a folder on the way count, too."""
    (tmp_path / "link").symlink_to("away/out")
    for path in (tmp_path / "link", tmp_path / "link" / "below" / "out.h5"):
        for replace in (False, True):
            with refused(DataError):
                write_whole(path, "new", replace=replace)
    with refused(DataError), atomic_file(tmp_path / "late") as partial:
        partial.write_text("new")
        (tmp_path / "late").symlink_to("away/out")  # made while the file was written
    assert {*tmp_path.iterdir()} == {tmp_path / "link", tmp_path / "late"}
