"""Time to plan a night of a hundred scans;  pytest -m bench -s tests/bench/test_queue_plan.py.

A hundred copies of the shipped configurations, each with a wrong line (`tests.beamline.scan.wrong_configs`), and a
hundred that are right, each in a file of its own. The modules are loaded before: the first plan of a process also
loads what reads a scene.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from beamline import api
from beamline.config.load import config_folder
from tests.beamline.scan.wrong_configs import wrong_configs

SCANS, ROUNDS = 100, 5
MOST = 1.0  # s of CPU time


def good_configs(folder: Path, n: int) -> list[Path]:
    """Copies of the shipped configurations in turn, each with other values."""
    paths = []
    for number in range(n):
        text = (config_folder() / f"{('simulated', 'instrument', 'demo')[number % 3]}.yaml").read_text("utf-8")
        paths.append(folder / f"good_{number}.yaml")
        paths[-1].write_text(text.replace("distance_mm: 100.0", f"distance_mm: {100 + number}.0"), "utf-8")
    return paths


def seconds(call: Callable[[], object]) -> tuple[float, float]:
    """Medians of wall time and of CPU time."""
    times = []
    for _ in range(ROUNDS):
        wall, cpu = time.perf_counter(), time.process_time()
        call()
        times.append((time.perf_counter() - wall, time.process_time() - cpu))
    wall, cpu = np.median(times, axis=0)
    return float(wall), float(cpu)


@pytest.mark.bench
@pytest.mark.parametrize("kind", ["good", "wrong"])
def test_a_hundred_scans_are_planned_within_a_second(kind: str, tmp_path: Path) -> None:
    paths: Sequence[Path] = (
        good_configs(tmp_path, SCANS) if kind == "good" else [each.path for each in wrong_configs(tmp_path, SCANS)]
    )
    api.plan(paths[:3], output=tmp_path)
    wall, cpu = seconds(lambda: api.plan(paths, output=tmp_path))
    print(f"\n{SCANS} {kind} configurations: {wall:.2f} s, of them {cpu:.2f} s of CPU time")
    assert cpu < MOST
