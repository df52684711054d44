"""JSON lines of events keep their names and values: lines recorded from commands before events were classes."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from beamline.core.event_lines import LONGEST, event_in, event_of
from beamline.core.events import KINDS
from beamline.page.followed_run import RunValues, StampedValues

LINES = Path(__file__).with_name("event_lines.jsonl").read_text(encoding="utf-8").splitlines()


@pytest.mark.parametrize("line", LINES, ids=lambda line: json.loads(line)["event"])
def test_a_line_that_was_recorded_is_written_as_it_was(line: str) -> None:
    assert json.loads(event_of(json.loads(line)).to_json()) == json.loads(line)


def test_lines_of_every_kind_were_recorded() -> None:
    assert not KINDS.keys() - {json.loads(line)["event"] for line in LINES}


def test_who_reads_lines_knows_all_kinds_without_importing_them() -> None:
    code = "import sys; from beamline.core.event_lines import KINDS; sys.stdout.write(' '.join(KINDS))"
    known = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert {json.loads(line)["event"] for line in LINES} <= {*known}


def test_a_line_of_no_kind_is_refused_with_its_values() -> None:
    with pytest.raises(ValueError, match=r"the values.*'pid': 7"):
        event_of({"event": "at work", "pid": 7})
    with pytest.raises(ValueError, match=r"no event has the values \{'event': 'warning'\}"):
        event_of({"event": "warning"})


DEEP = "[" * 100_000
JUNK: tuple[Any, ...] = (
    "x",
    -1.5,
    10**400,
    True,
    None,
    [],
    [[]],
    {"a": {}},
    "\ud800\x1b[2J\n",
    1e300,
    2**70,
    "9" * 5000,
)


@pytest.mark.parametrize("line", LINES, ids=lambda line: json.loads(line)["event"])
def test_an_event_of_a_log_is_its_values(line: str) -> None:
    assert event_in(line) == event_in(line.encode()) == json.loads(line)


@pytest.mark.parametrize("line", LINES, ids=lambda line: json.loads(line)["event"])
def test_no_value_in_any_field_ends_who_reads_a_log(line: str) -> None:
    values = json.loads(line)
    for name in values:
        for junk in JUNK:
            StampedValues(RunValues(), 0.0).after([json.dumps({**values, name: junk})])
        StampedValues(RunValues(), 0.0).after([json.dumps({key: values[key] for key in values if key != name})])


@pytest.mark.parametrize(
    "line",
    [
        '{"event": "state", "time": null}', '{"event": "state", "time": "1"}', '{"event": "state", "time": 1e999}',
        '{"event": "state", "time": NaN}',
        f'{{"event": "state", "message": {DEEP}', f'{{"event": "new", "a": {DEEP}{DEEP.replace("[", "]")}}}',
        '{"event": ["state"]}', '{"time": 1.0}', "[1]", "", "\0" * 9, b"\xff\xfe", b'{"event": "new", "a": "\xff"}',
        '{"event": "new", "a": "' + "x" * LONGEST + '"}',
    ],
    ids=range(14),
)  # fmt: skip
def test_a_line_that_is_no_event(line: str | bytes) -> None:
    assert event_in(line) is None


def test_lines_of_another_version_are_events() -> None:
    assert event_in('{"event": "not known yet", "a": [1]}') == {"event": "not known yet", "a": [1]}
    assert event_in('{"event": "frame", "time": 1.0, "new": "x"}') is not None
