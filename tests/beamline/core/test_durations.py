"""Rates of this machine are measured once, kept for a month, and only for the machine that they are of."""

from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from beamline.core.durations import DAYS, MachineSpeed, seconds_left
from recon.base.work import Rate

KEY: dict[str, Any] = {"processor": "a", "threads": 2}


@pytest.fixture
def measured(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The operations that were measured."""
    operations: list[str] = []

    def rate(operation: str, now: object, threads: int) -> Rate:
        operations.append(operation)
        return Rate(float(len(operations)), 0.5 / threads)

    monkeypatch.setattr("recon.machine_speed.measured_rate", rate)
    return operations


def test_an_operation_is_measured_once_on_a_machine(tmp_path: Path, measured: list[str]) -> None:
    path = tmp_path / "new" / "speed.json"
    one = MachineSpeed(path, key=KEY, today=lambda: 100.0)
    assert [one("tv"), one("tv"), one("pass")] == [Rate(1, 0.25), Rate(1, 0.25), Rate(2, 0.25)]
    other = MachineSpeed(path, key=KEY, today=lambda: 100.0 + 86400 * (DAYS - 1))
    assert [other("pass"), other("tv")] == [Rate(2, 0.25), Rate(1, 0.25)] and measured == ["tv", "pass"]
    other("slope")  # a later figure does not make the earlier ones younger
    MachineSpeed(path, key=KEY, today=lambda: 101.0 + 86400 * DAYS)("tv")
    assert measured == ["tv", "pass", "slope", "tv"]


@pytest.mark.parametrize("content", ["", "{}", "[1]", '{"key": {}, "measured": 0, "rates": {"tv": 1}}', None])
def test_figures_of_another_machine_or_a_damaged_file_are_measured_anew(
    tmp_path: Path, measured: list[str], content: str | None
) -> None:
    path = tmp_path / "speed.json"
    if content is None:
        MachineSpeed(path, key=KEY)("tv")
        measured.clear()
    else:
        path.write_text(content)
    speed = MachineSpeed(path, key={**KEY, "threads": 1})
    speed("tv")
    assert measured == ["tv"]


def test_a_folder_that_takes_no_file_costs_only_time(tmp_path: Path, measured: list[str]) -> None:
    (tmp_path / "file").touch()
    assert MachineSpeed(tmp_path / "file" / "speed.json", key=KEY)("tv") == Rate(1, 0.25)


@given(st.floats(0.1, 1e3), st.floats(0, 1e3), st.floats(0.1, 1e3))
def test_the_rest_takes_as_long_as_so_far_for_each_unit(done: float, more: float, pace: float) -> None:
    assert seconds_left(done, done + more, pace * done) == pytest.approx(pace * more, rel=1e-6, abs=1e-6)
    assert seconds_left(0, more, pace) is None and seconds_left(done, 0.0, pace) == 0
