"""The line about the machine: short, true, and the same for people and programs."""

from __future__ import annotations

import json

import numba

from beamline.core.machine import machine, machine_line


def test_what_a_time_means_nothing_without() -> None:
    found = machine()
    assert found["threads"] == numba.get_num_threads()
    assert int(found["cores"]) >= 1
    assert str(found["processor"]).strip()
    json.dumps(found)
    line = machine_line(found)
    assert "1 core, 1 thread," in machine_line({**found, "cores": 1, "threads": 1})
    assert "2 cores, 3 threads," in machine_line({**found, "cores": 2, "threads": 3})
    assert "\n" not in line and all(str(value) in line for value in found.values())
