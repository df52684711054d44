"""If a terminal or disk accepts no output, no command ends, and no exit code of a command that writes files changes."""

import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from tests.beamline.cli.small_scan import SCAN
from tests.beamline.scans import write_exchange

FULL = Path("/dev/full")
POSIX = pytest.mark.skipif(not FULL.exists(), reason="the system has no device that is always full")


def _run(folder: Path, redirected: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    words = shlex.join([sys.executable, "-m", "beamline.cli.main", *arguments])
    return subprocess.run(
        ["bash", "-c", f"{words} {redirected}"], cwd=folder, capture_output=True, text=True, timeout=200
    )


@POSIX
def test_what_is_printed_to_a_full_disk_is_an_error_of_the_disk(folder: Path) -> None:
    done = _run(folder, "> /dev/full", "info", "scan.h5")
    assert done.returncode == 5
    assert done.stderr == "beamline: the output on stdout is incomplete (No space left on device).\n"


@POSIX
@pytest.mark.slow
@pytest.mark.parametrize("redirected", [pytest.param("> /dev/full 2>&1", marks=pytest.mark.long), ">&- 2>&- <&-"])
def test_a_command_that_leaves_a_file_ends_as_ever(tmp_path: Path, redirected: str) -> None:
    write_exchange(tmp_path / "scan.h5", SCAN)
    assert _run(tmp_path, redirected, "ingest", "scan.h5", "out.h5").returncode == 0
    assert _run(tmp_path, redirected, "ingest", "scan.h5", "out.h5").returncode == 5  # it is there
    assert _run(tmp_path, "", "validate", "--deep", "out.h5").returncode == 0  # and nothing was printed into it


@POSIX
@pytest.mark.slow
def test_a_reader_that_wants_no_more_is_no_error(folder: Path) -> None:
    done = _run(folder, "| head -c 1; exit ${PIPESTATUS[0]}", "config", "schema")
    assert (done.returncode, done.stderr) == (0, "")


@POSIX
@pytest.mark.parametrize(("option", "told"), [("--json", ""), ("--no-json", "of a library\n")])
def test_what_a_library_prints_is_not_among_the_results(tmp_path: Path, option: str, told: str) -> None:
    """C's stdout is flushed at the end of the process where it is a pipe."""
    printed = (
        "import ctypes, sys; from beamline.cli.main import guard_streams; guard_streams(); c = ctypes.CDLL(None); "
        "c.printf(b'of a library\\n'); print('{}')"
    )
    done = subprocess.run([sys.executable, "-c", printed, option], capture_output=True, text=True, cwd=tmp_path)
    assert (done.stdout, done.stderr, done.returncode) == ("{}\n", told, 0)


NAME = os.fsdecode(b"\x1b[2J\x07\xff\xe2\x80\xaea.h5")


@pytest.mark.slow
@POSIX
@pytest.mark.parametrize("words", [["info", NAME], ["recon", NAME, "-o", NAME]], ids=str)
def test_a_name_acts_on_no_terminal_whoever_prints_it(tmp_path: Path, words: list[str]) -> None:
    (tmp_path / NAME).touch()
    done = subprocess.run([sys.executable, "-m", "beamline.cli.main", *words], capture_output=True, cwd=tmp_path)
    assert done.returncode in (2, 5), done.stderr
    output = (done.stdout + done.stderr).decode()
    assert output.replace("\n", "").isprintable() and "a.h5" in output
