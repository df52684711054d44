"""Threads: frames are the same to the last bit however many share the work, and several may be computed at once."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numba import config

from simulators.effects.catalogue import CATALOGUE
from simulators.frame.shot import Detector, Shot
from simulators.scenes.expose import expose
from simulators.scenes.scene import Scene
from tests.simulators import shots
from tests.simulators.effects import on_demand
from tests.simulators.effects.parameters import entry

SIDE = 259
"""Pixels; their square is more than bands.SMALL, and no number of threads divides it."""
FRINGES = {
    "wave": entry("phase_fringes"),
    "transport": {"kind": "phase_fringes", "delta_beta": 3.0, "distance": 100.0, "energy": 20.0, "method": "transport"},
}
AT_ONCE = """
import threading
from simulators.scenes.expose import expose
from tests.simulators.effects.test_threads import large, with_all

frames = []

def make():
    frames.append([expose(with_all(method), large()) for method in ("wave", "transport")])

threads = [threading.Thread(target=make) for _ in range(3)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
assert len(frames) == 3
assert all((one == other).all() for each in frames for one, other in zip(each, frames[0]))
"""


def with_all(method: str) -> Scene:
    """A cloud with all effects that leave light in the frame."""
    entries = [FRINGES[method] if name == "phase_fringes" else entry(name) for name in CATALOGUE if name != "lost_beam"]
    return replace(shots.scene(*entries, flux=4000.0), sample=on_demand.Cloud())


def large() -> Shot:
    detector = Detector.centred((SIDE, SIDE), 0.004)
    return replace(on_demand.shot(2), detector=detector, roi=(1000, 2000, SIDE, SIDE))


@pytest.mark.parametrize("method", FRINGES)
def test_the_number_of_threads_changes_no_bit(monkeypatch: pytest.MonkeyPatch, method: str) -> None:
    frames = []
    for threads in (1, 2, 3):
        monkeypatch.setattr(config, "NUMBA_NUM_THREADS", threads)
        frames.append(expose(with_all(method), large()))
    assert np.unique(frames[0]).size > 20
    np.testing.assert_array_equal(frames[0], frames[1])
    np.testing.assert_array_equal(frames[0], frames[2])


@pytest.mark.slow
def test_frames_may_be_made_in_several_threads_at_once() -> None:
    """Numba's simplest layer of threads, the only one on some machines, ends the process where two enter it."""
    numba = {"NUMBA_THREADING_LAYER": "workqueue", "NUMBA_NUM_THREADS": "2"}
    ran = subprocess.run(
        [sys.executable, "-c", AT_ONCE],
        cwd=Path(__file__).parents[3],
        env=os.environ | numba,
        capture_output=True,
        text=True,
        timeout=200,
    )
    assert ran.returncode == 0, ran.stderr
