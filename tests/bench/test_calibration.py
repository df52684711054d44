"""Calibrated geometry compared with the true one: 32 disturbed scans of analytic bodies.

Run with  pytest -m bench -s tests/bench/test_calibration.py  (some twenty minutes; `-k parallel` for half).
One line a case: errors of what can be known, in pixels and degrees; PSNR by FISTA-TV of the undisturbed scan, of the
disturbed one with the geometry learnt, and without; processor seconds of the calibration and of the reconstruction.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import numpy as np
import pytest
from numpy.typing import NDArray

import recon
from recon.assess.metrics import psnr
from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.features.calibration.joint import knowable
from recon.features.calibration.learn import learn_geometry
from tests.recon.bodies import Bodies, balls, sponge

VIEWS, SHAPE, NOISE = 80, (32, 80), 0.01
METHOD = recon.FistaTv(8, tv_weight=3e-3)
BEAMS = {"parallel": np.pi, "cone": 2 * np.pi}
BODIES = {"balls": balls, "sponge": sponge}
PLACES = frozenset({"axis", "shifts"})
CASES: dict[str, frozenset[str]] = {
    "axis": frozenset({"axis"}),
    "tilt": frozenset({"axis", "tilt"}),
    "roll": frozenset({"axis", "roll"}),
    "drift": PLACES,
    "wobble": PLACES,
    "jitter": PLACES,
    "jumps": PLACES,
    "all": frozenset({"axis", "roll", "tilt", "shifts"}),
}
"""Disturbances, and the terms that are asked for."""


def _geometry(beam: str, axis: float, shifts: NDArray[np.float64], roll: float, tilt: float) -> Geometry:
    angles = np.linspace(0, BEAMS[beam], VIEWS, endpoint=False)
    turns = {"roll": np.radians(roll), "tilt": np.radians(tilt)}
    if beam == "parallel":
        return Geometry.parallel(angles, SHAPE, pixel_pitch=1.0, axis_col=axis, shifts=shifts, **turns)
    return Geometry.cone(angles, SHAPE, 1.5, 200, 300, axis_col=axis, shifts=shifts, **turns)


def _disturbed(beam: str, case: str) -> Geometry:
    """The geometry of a case: shifts up to some pixels, and half a degree of tilt and roll."""
    share, rng = np.arange(VIEWS) / VIEWS, np.random.default_rng(1)
    angles = BEAMS[beam] * share
    parts = {
        "drift": np.stack((3 * share**1.5, -2 * share), axis=1),
        "wobble": np.stack((np.cos(2 * angles + 0.3) + 0.3 * np.cos(3 * angles), 0.7 * np.cos(angles - 1)), axis=1),
        "jitter": rng.normal(0, 0.5, (VIEWS, 2)),
        "jumps": np.outer(share >= 1 / 3, (3, -2)) + np.outer(share >= 2 / 3, (-1.5, 3)),
    }
    shifts = sum((part for name, part in parts.items() if case in (name, "all")), np.zeros((VIEWS, 2)))
    axis = (SHAPE[1] - 1) / 2 + (4.3 if case in ("axis", "all") else 0)
    return _geometry(beam, axis, shifts, 0.5 * (case in ("roll", "all")), 0.5 * (case in ("tilt", "all")))


def _as_placed(found: Geometry, truth: Geometry) -> Geometry:
    """The geometry found, with the truth's place of the sample on its stage: nobody can know it."""
    off = truth.shifts - found.shifts
    return replace(
        found, shifts=found.shifts + off - knowable(off, truth.angles)[0] - [[knowable(off, truth.angles)[1], 0]]
    )


T = TypeVar("T")


def _seconds(work: Callable[[], T]) -> tuple[float, T]:
    begun = time.process_time()
    done = work()
    return time.process_time() - begun, done


@pytest.mark.bench
@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("body", BODIES)
@pytest.mark.parametrize("beam", BEAMS)
def test_calibration(beam: str, body: str, case: str) -> None:
    sample: Bodies = BODIES[body](0.42 * SHAPE[1], SHAPE[0])
    truth = _disturbed(beam, case)
    start = _geometry(beam, (SHAPE[1] - 1) / 2, np.zeros((VIEWS, 2)), 0, 0)
    views = sample.views(truth, NOISE)
    took, learnt = _seconds(lambda: learn_geometry(views, start, CASES[case]))
    found = learnt.change.applied(start)
    off, mean = knowable(found.shifts - truth.shifts, truth.angles)
    axis = abs(found.axis_col + mean - truth.axis_col)
    across, down = np.sqrt(np.mean(off**2, axis=0))
    turns = [float(np.degrees(np.abs(a - b).max())) for a, b in ((found.roll, truth.roll), (found.tilt, truth.tilt))]
    grid = Grid.matching(start)
    solid = sample.volume(grid)
    tall = replace(grid, shape=(grid.shape[0] + 8, *grid.shape[1:]))  # rays of leaning views leave the rows seen

    def quality(of: NDArray[np.float32], geometry: Geometry) -> float:
        volume = recon.reconstruct(of, geometry, METHOD, grid=tall).volume.data[4:-4]
        return psnr(solid[4:-4], volume[4:-4], float(solid.max()))

    best = quality(sample.views(start, NOISE), start)
    whole, after = _seconds(lambda: quality(views, _as_placed(found, truth)))
    without = quality(views, _as_placed(start, truth))
    print(
        f"\n| {beam} | {body} | {case} | {axis:.3f} | {across:.3f} | {down:.3f} | {turns[0]:.3f} | {turns[1]:.3f} "
        f"| {best:.1f} | {after:.1f} | {without:.1f} | {took:.1f} | {whole:.1f} |",
        end="", flush=True,
    )  # fmt: skip
    assert after > without - 0.1  # what views held out confirmed is no harm
