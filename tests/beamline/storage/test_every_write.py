"""A scan file survives a kill or a disk error at each of its last writes, and at each write of `recover`."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from tests import faulty_disk

pytestmark = [faulty_disk.needed, pytest.mark.slow, pytest.mark.timeout(900)]

Row = dict[str, Any]


def _rows(folder: Path, case: str) -> list[Row]:
    """What every_write.py finds: an object for each fault."""
    command = [sys.executable, "-m", "tests.beamline.storage.every_write", folder, case]
    env = os.environ | faulty_disk.environment(f"{folder}/w/")
    root = Path(__file__).parents[3]
    done = subprocess.run([str(word) for word in command], env=env, cwd=root, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


def _counted(rows: list[Row]) -> Counter[str]:
    return Counter(row["fault"] for row in rows)


def _assert_all_is_there(rows: list[Row]) -> None:
    """Every command takes the file, with every committed frame; recovered once, it is in order, alone in its folder.

    Half of a write within a page, as by a loss of power, may leave the old file beside a new one.
    """
    for row in rows:
        taken = [row[command] for command in ("info", "resume", "recover")]
        assert all(isinstance(n, int) and n >= row["committed"] for n in taken), row
        assert row["after"] == [row["recover"], max(0, row["recover"] - 5)], row
        aside = ["scan.h5.damaged"] if "torn" in row["fault"] else []
        assert row["again"] is False and row["left"] in (["scan.h5"], ["scan.h5", *aside]), row


def _assert_said_in_a_sentence(rows: list[Row]) -> None:
    """A failure is a refusal: no traceback, no crash, nothing from HDF5 on the terminal when the program ends."""
    for row in rows:
        assert not str(row["done"]).startswith(("Traceback", "exit")), row
        assert row["stderr"] == "", row


@pytest.mark.long
def test_a_kill_at_each_of_the_last_writes_of_a_scan_or_a_disk_that_fails_from_one_on(tmp_path: Path) -> None:
    rows = _rows(tmp_path, "close")
    assert _counted(rows) == {"kill": 60, "error from": 25}
    _assert_all_is_there(rows)
    _assert_said_in_a_sentence([row for row in rows if row["fault"] != "kill"])


@pytest.mark.long
def test_recover_is_killed_at_each_write_or_the_disk_fails_there(tmp_path: Path) -> None:
    rows = _rows(tmp_path, "recover")
    writes = _counted(rows)
    assert len(writes) == 4 and len(set(writes.values())) == 1 and writes["kill"] > 8, writes
    _assert_all_is_there(rows)
    _assert_said_in_a_sentence([row for row in rows if not row["fault"].startswith("kill")])


def test_a_file_that_its_file_system_takes_no_longer(tmp_path: Path) -> None:
    """`recover` gives the frames that the writer said are safe, under the same limit, too, then without the view."""
    rows = _rows(tmp_path, "cut")
    failed = [row for row in rows if "recover" in str(row["done"])]
    assert len({row["committed"] for row in failed}) > 6
    for row in failed:
        assert f"first {row['committed']} frames are safe in this file: run `beamline recover`" in row["done"]
        assert row["under"] == row["recover"] == row["committed"], row
    _assert_said_in_a_sentence(rows)
    _assert_all_is_there(rows)
