"""JSON lines of events keep their names and values: lines recorded from commands before events were classes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from beamline.core.events import KINDS, event_of

LINES = Path(__file__).with_name("event_lines.jsonl").read_text(encoding="utf-8").splitlines()


@pytest.mark.parametrize("line", LINES, ids=lambda line: json.loads(line)["event"])
def test_a_line_that_was_recorded_is_written_as_it_was(line: str) -> None:
    assert json.loads(event_of(json.loads(line)).to_json()) == json.loads(line)


def test_lines_of_nearly_every_kind_were_recorded() -> None:
    rare = {"bench", "bench_started", "check", "enough"}  # minutes of work, or a goal that a short scan does not reach
    assert KINDS.keys() - {json.loads(line)["event"] for line in LINES} <= rare


def test_a_line_of_no_kind_is_refused_with_its_values() -> None:
    with pytest.raises(ValueError, match=r"no kind of event has the values .*'pid': 7"):
        event_of({"event": "at work", "pid": 7})
    with pytest.raises(ValueError, match="no kind"):
        event_of({"event": "warning"})
