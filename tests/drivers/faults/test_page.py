"""docs/faults.md has exactly one row for each fault of the table, with the words of its error."""

from __future__ import annotations

import re
from pathlib import Path

from beamline.scan.moves import SAFE, UNSAFE
from tests.drivers.faults.table import WORDS

ROOT = Path(__file__).parents[3]
TEXT = (ROOT / "docs" / "faults.md").read_text(encoding="utf-8")
ROWS = [
    [cell.strip() for cell in line.strip("|").split("|")]
    for line in TEXT.splitlines()
    if line.startswith("|") and not line.startswith(("|---", "| fault |"))
]


def test_rows_are_those_of_the_table() -> None:
    assert [row[0] for row in ROWS] == list(WORDS)


def test_every_row_says_what_is_seen_what_was_done_and_what_to_do() -> None:
    for fault, seen, done, advice in ROWS:
        assert WORDS[fault] in seen, fault
        assert done and advice, fault


def test_what_the_run_says_at_the_end_is_quoted() -> None:
    words = re.sub(r"\s+", " ", TEXT)
    assert SAFE.split(";")[0] in words
    assert UNSAFE.split(";")[0] in words
