"""Noise on the trigger line while a stage brakes: every kept projection was taken at the angle in the file."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from beamline.core.errors import ScanStopped
from beamline.core.stop import StopRequest
from drivers.base.frame import FrameKind
from tests.drivers.faults.rig import DARKS, FIRST, FLATS, KINDS, STEP, Rig, Scanned
from tests.slow_cases import others_slow

RigOf = Callable[[str], Rig]
VIEWS, PERIOD = 60, 0.08
"""The stage brakes from 25 deg/s: at 10, 20 and 60 deg/s² over 15, 8 and 3 views."""
SCAN = (
    f"scan.angles={{scheme: fixed, views: {VIEWS}, start_deg: {FIRST}, span_deg: {STEP * VIEWS}}}",
    f"scan.period_s={PERIOD}",
    "devices.stage.low_deg=-60",
)


def stopped(rig: Rig, runs: Path, seed: int, pulses: int) -> tuple[Scanned, list[float], int]:
    """A scan that is stopped after some view, with pulses of noise until 0.2 s after the stage stands.

    Returns it, the steps by which each of its views was taken off its angle, and the last view before the stop.
    """
    rng, stop = np.random.default_rng(seed), StopRequest()
    acceleration = float(rng.choice([10.0, 20.0, 60.0]))
    at, late = int(rng.integers(6, 43)), rng.uniform(0, PERIOD)
    noise = np.sort(rng.uniform(0, STEP / PERIOD / acceleration + 0.2, pulses))

    def act() -> None:
        rig.clock.sleep(late)
        rig.trigger_cable.noise = tuple(rig.clock.now() + noise)
        stop.stop()

    rig.at_frame[at] = act
    scanned = rig.scan(runs, *SCAN, f"devices.stage.acceleration_deg_s2={acceleration}", stop=stop)
    assert type(scanned.error) is ScanStopped and scanned.folder is not None
    line = rig.trigger_cable.line
    with h5py.File(scanned.folder / "scan.h5") as file:
        log = file["entry/frame_log"]
        views = file["entry/instrument/detector/image_key"][()] == 0
        triggers, times = log["trigger"][()][views], log["time"][()][views]
    off = [
        abs(math.degrees(line.angle_at(float(time))) - FIRST - STEP * trigger) / STEP
        for trigger, time in zip(triggers, times, strict=True)
    ]
    return scanned, off, at - DARKS - FLATS


def check(rig: Rig, runs: Path, seed: int) -> None:
    pulses = 1 + seed % 5
    scanned, off, _ = stopped(rig, runs, seed, pulses)
    assert max(off) < 0.3, seed
    rows = scanned.rows()
    views, invalid = rows[FrameKind.PROJECTION], len(rows[FrameKind.INVALID])
    assert len(set(views)) == len(views), seed
    assert invalid <= pulses, f"{seed}: views were left out without need"
    assert ("came while the stage braked" in str(scanned.error)) is (invalid > 0), seed
    missing = set(range(max(views) + 1)) - set(views)
    assert missing == {int(i) for i in scanned.of("block_done")[-1].data["missing"]}, seed
    assert len(missing) <= pulses, seed


@pytest.mark.parametrize(("kind", "seeds"), others_slow([("pm16c", (7,)), *((kind, (0, 3, 5)) for kind in KINDS)]))
def test_noise_while_the_stage_brakes_shifts_no_angle(
    rig_of: RigOf, tmp_path: Path, kind: str, seeds: tuple[int, ...]
) -> None:
    for seed in seeds:
        check(rig_of(kind), tmp_path / str(seed), seed)


@pytest.mark.parametrize("kind", others_slow(KINDS))
def test_without_noise_every_view_until_the_stage_stands_is_kept(rig_of: RigOf, tmp_path: Path, kind: str) -> None:
    scanned, off, last = stopped(rig_of(kind), tmp_path, 4, 0)
    assert max(off) < 0.01
    rows = scanned.rows()
    assert rows[FrameKind.PROJECTION] == list(range(len(off))) and rows[FrameKind.INVALID] == []
    assert len(off) > last + 2 and "braked" not in str(scanned.error)
