"""The archive of compiled kernels: current, whole, and no more than a saving of time."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from recon.compiled import ROOT
from recon.compiled.archive import archive_of, fresh_members, member, read_sources, source_files, unpack, write_archive
from recon.compiled.level import level_for, processor_flags

ARCHIVE = archive_of(sys.version_info[:2])
KERNEL = """
from numba import njit
from helper import FACTOR

@njit(cache=True)
def scaled(x):
    return FACTOR * x
"""
FILES = {"scaled.scaled-5.py311.nbi": b"index", "scaled.scaled-5.py311.0123.nbc": b"code" * 100}


def _project(root: Path) -> Path:
    """A package with a kernel and what it imports, and its archive."""
    (root / "package").mkdir()
    (root / "package/scaled.py").write_text(KERNEL.replace("helper", "package.helper"), encoding="utf-8")
    (root / "package/helper.py").write_text("FACTOR = 2\n", encoding="utf-8")
    archive = root / "kernels.zip"
    write_archive(archive, {"package.scaled": FILES}, root)
    return archive


def _unpacked(root: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in (root / "package").glob("__pycache__/*")}


@pytest.mark.skipif(not ARCHIVE.is_file(), reason="no archive for this Python")
def test_the_archive_is_current() -> None:
    """Else these kernels compile for every user: rebuild it with  python -m recon.compiled."""
    stale = set(read_sources(ARCHIVE)) - set(fresh_members(ARCHIVE, ROOT))
    assert not stale, "edited since the archive was made: python -m recon.compiled"


def test_the_archive_names_what_kernels_are_compiled_from() -> None:
    sources = source_files("recon.kernels.cpu.voxelize", ROOT)
    assert {f"recon/kernels/cpu/{name}.py" for name in ("voxelize", "footprints", "lanes")} <= set(sources)
    assert "recon/base/kernel.py" in sources


def test_kernels_are_unpacked_beside_their_module(tmp_path: Path) -> None:
    archive = _project(tmp_path)
    unpack(archive, tmp_path)
    assert _unpacked(tmp_path) == FILES
    (tmp_path / "package/__pycache__/scaled.scaled-5.py311.nbi").write_bytes(b"what numba added")
    unpack(archive, tmp_path)
    assert _unpacked(tmp_path)["scaled.scaled-5.py311.nbi"] == b"what numba added"  # once


@pytest.mark.parametrize("edited", ["scaled.py", "helper.py"])
def test_an_edited_source_leaves_its_kernels_packed(tmp_path: Path, edited: str) -> None:
    archive = _project(tmp_path)
    with (tmp_path / "package" / edited).open("a", encoding="utf-8") as file:
        file.write("# edited\n")
    assert not list(fresh_members(archive, tmp_path))
    unpack(archive, tmp_path)
    assert not _unpacked(tmp_path)


def test_the_same_kernels_make_the_same_archive(tmp_path: Path) -> None:
    archive = _project(tmp_path)
    again = tmp_path / "again.zip"
    write_archive(again, {"package.scaled": dict(reversed(FILES.items()))}, tmp_path)
    assert again.read_bytes() == archive.read_bytes()
    assert member(archive, "package.scaled") == FILES


def test_a_damaged_archive_is_a_miss(tmp_path: Path) -> None:
    """Wherever it is damaged, nothing fails and no half of a file is left."""
    archive = _project(tmp_path)
    whole = archive.read_bytes()
    for at in range(0, len(whole), 7):
        for damaged in (whole[:at], whole[:at] + bytes([whole[at] ^ 0xFF]) + whole[at + 1 :]):
            archive.write_bytes(damaged)
            (tmp_path / "__pycache__/kernels.unpacked").unlink(missing_ok=True)
            unpack(archive, tmp_path)
            assert _unpacked(tmp_path).items() <= FILES.items()
            for path in (tmp_path / "package").glob("__pycache__/*"):
                path.unlink()


def test_a_missing_archive_and_a_folder_that_cannot_be_written_are_a_miss(tmp_path: Path) -> None:
    archive = _project(tmp_path)
    (tmp_path / "package/__pycache__").write_text("a file where the folder would be", encoding="utf-8")
    unpack(archive, tmp_path)
    archive.unlink()
    unpack(archive, tmp_path)


@pytest.mark.slow
@pytest.mark.skipif(not ARCHIVE.is_file() or level_for({}, processor_flags()) is None, reason="nothing is carried")
def test_a_carried_kernel_is_not_compiled(tmp_path: Path) -> None:
    """In a copy of the project where nothing was compiled; an edited kernel is, and nothing else."""
    run = """
import numpy as np
from recon.kernels.cpu.adam import add_lengths
from recon.warm_up import counted
compiled = []
with counted(compiled.append):
    add_lengths(np.ones((1, 2), np.float32), 1.0, np.zeros(1, np.float32))
print(len(compiled))
"""
    for package in ("recon", "drivers"):
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__"))
    plain = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_")}

    def compiled() -> int:
        words, environment = [sys.executable, "-c", run], plain | {"PYTHONPATH": str(tmp_path)}
        done = subprocess.run(words, env=environment, cwd=tmp_path, capture_output=True, text=True, check=True)
        return int(done.stdout)

    assert compiled() == 0
    with (tmp_path / "recon/kernels/cpu/adam.py").open("a", encoding="utf-8") as file:
        file.write("# edited\n")
    assert compiled() > 0
    assert compiled() == 0
