"""The archive of compiled kernels is current and intact, and only saves time."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from recon.compiled import ROOT, archive, level_for, processor_flags
from recon.compiled.archive import (
    ARCHIVE,
    carried,
    fresh_members,
    member,
    read_sources,
    sealed,
    unsealed,
)
from tests.compiled_kernels import source_files, write_archive

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


@pytest.mark.skipif(not ARCHIVE.is_file(), reason="no archive")
def test_the_archive_is_current() -> None:
    """Else these kernels compile for every user: rebuild it with  python -m tests.compiled_kernels."""
    stale = set(read_sources(ARCHIVE)) - set(fresh_members(ARCHIVE, ROOT))
    assert not stale, "edited since the archive was made: python -m tests.compiled_kernels"


def test_the_archive_names_what_kernels_are_compiled_from() -> None:
    sources = source_files("recon.kernels.cpu.voxelize", ROOT)
    assert {f"recon/kernels/cpu/{name}.py" for name in ("voxelize", "footprints", "lanes")} <= set(sources)
    assert "recon/base/kernel.py" in sources


@pytest.mark.parametrize("edited", ["scaled.py", "helper.py"])
def test_an_edited_source_leaves_its_kernels_unused(tmp_path: Path, edited: str) -> None:
    archive = _project(tmp_path)
    with (tmp_path / "package" / edited).open("a", encoding="utf-8") as file:
        file.write("# edited\n")
    assert not list(fresh_members(archive, tmp_path))


def test_the_same_kernels_make_the_same_archive(tmp_path: Path) -> None:
    archive = _project(tmp_path)
    again = tmp_path / "again.zip"
    write_archive(again, {"package.scaled": dict(reversed(FILES.items()))}, tmp_path)
    assert again.read_bytes() == archive.read_bytes()
    assert member(archive, "package.scaled") == FILES


@pytest.fixture
def carrying(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The archive of a project whose kernels are asked for."""
    archive_file = _project(tmp_path)
    monkeypatch.setattr(archive, "ARCHIVE", archive_file)
    monkeypatch.setattr(archive, "ROOT", tmp_path)
    _forget()
    yield archive_file
    _forget()


def _forget() -> None:
    archive.carried.cache_clear()
    archive._carried_modules.cache_clear()


def test_kernels_are_found_by_the_digest_of_their_source(carrying: Path, tmp_path: Path) -> None:
    stamp = hashlib.sha256((tmp_path / "package/scaled.py").read_bytes()).digest()
    assert carried(stamp) == FILES
    assert carried(hashlib.sha256(b"edited").digest()) == {}


def test_a_damaged_archive_is_a_miss(carrying: Path, tmp_path: Path) -> None:
    """Wherever it is damaged, nothing fails, and what is found is right."""
    whole, stamp = carrying.read_bytes(), hashlib.sha256((tmp_path / "package/scaled.py").read_bytes()).digest()
    for at in range(0, len(whole), 7):
        for damaged in (whole[:at], whole[:at] + bytes([whole[at] ^ 0xFF]) + whole[at + 1 :]):
            carrying.write_bytes(damaged)
            _forget()
            assert carried(stamp).items() <= FILES.items()
    carrying.unlink()
    _forget()
    assert carried(stamp) == {}


@pytest.mark.parametrize("at", [0, 50, -1])
def test_a_digest_tells_a_changed_byte(at: int) -> None:
    content = bytearray(sealed(b"object code" * 10))
    assert unsealed(bytes(content)) == b"object code" * 10
    assert unsealed(b"without a digest") == b"without a digest"
    content[at] ^= 1
    with pytest.raises(ValueError, match="digest"):
        unsealed(bytes(content))


KERNELS = """
import os
import sys
import warnings
from pathlib import Path
import recon.compiled
from numba import njit

def scaled(x):
    return 2 * x

def missed():
    kernel = njit(cache=True)(scaled)
    assert kernel(3.0) == 6.0
    return sum(kernel.stats.cache_misses.values())

with warnings.catch_warnings(record=True) as told:
    warnings.simplefilter("always")
    print(missed(), len(told), *(str(each.message) for each in told))
assert "NUMBA_CACHE_LOCATOR_CLASSES" not in os.environ
for path in sorted(Path(sys.argv[0]).with_name("__pycache__").glob("*.nb*")) if sys.argv[1:] else ():
    whole = path.read_bytes()
    for damaged in (b"", bytes(4096), whole[:-60] + bytes([whole[-60] ^ 1]) + whole[-59:]):
        path.write_bytes(damaged)
        print(path.suffix, missed() > 0, missed())
"""


def _run(script: Path, *words: str, **environment: str) -> str:
    plain = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_")}
    own = plain | {"PYTHONPATH": str(ROOT), "HOME": "/proc/nohome"} | environment
    own.pop("XDG_CACHE_HOME", None)
    command = [sys.executable, "-B", str(script), *words]
    done = subprocess.run(command, env=own, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


@pytest.fixture
def kernels(tmp_path: Path) -> Path:
    """A script with a kernel."""
    (tmp_path / "kernels.py").write_text(KERNELS, encoding="utf-8")
    return tmp_path / "kernels.py"


@pytest.mark.slow
def test_without_a_place_to_write_kernels_are_compiled_in_memory_with_one_warning(kernels: Path) -> None:
    (kernels.parent / "__pycache__").write_text("a file where the folder would be", encoding="utf-8")
    said = _run(kernels, NUMBA_CACHE_DIR="/proc/nocache")
    assert said.startswith("1 1 ")
    assert "NUMBA_CACHE_DIR" in said


@pytest.mark.slow
def test_a_damaged_kernel_is_compiled_anew_and_mended(kernels: Path) -> None:
    """An index and code: each one empty, of zeros, or with a changed byte."""
    first, *damaged = _run(kernels, "damage").splitlines()
    assert first == "1 0"
    assert damaged == [f"{suffix} True 0" for suffix in (".nbc", ".nbi") for _ in range(3)]
    assert _run(kernels) == "0 0"


@pytest.mark.slow
@pytest.mark.skipif(not ARCHIVE.is_file() or level_for({}, processor_flags()) is None, reason="nothing is carried")
def test_a_carried_kernel_is_not_compiled(tmp_path: Path) -> None:
    """In a copy of the project where nothing was compiled; an edited kernel is, and nothing else.

    Another Python has another bytecode, and another number in the names of files.
    """
    run = """
import sys
import numpy as np
import recon
from numba.core import caching
key_of, base_of = caching.Cache._index_key, caching.CacheImpl.get_filename_base
if sys.argv[1:]:
    caching.Cache._index_key = lambda *args: (*key_of(*args)[:2], ("", key_of(*args)[2][1]))
    caching.CacheImpl.get_filename_base = lambda *args: base_of(*args).replace(".py3", ".py9")
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

    def compiled(*other: str) -> int:
        words, environment = [sys.executable, "-c", run, *other], plain | {"PYTHONPATH": str(tmp_path)}
        done = subprocess.run(words, env=environment, cwd=tmp_path, capture_output=True, text=True, check=True)
        return int(done.stdout)

    assert compiled() == compiled("another Python") == 0
    with (tmp_path / "recon/kernels/cpu/adam.py").open("a", encoding="utf-8") as file:
        file.write("# edited\n")
    assert compiled() > 0
    assert compiled() == 0
