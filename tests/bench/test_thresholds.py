"""What each empirical constant of the choice brings: it is removed, and the loss on small scans is measured.

Run with  pytest -m bench -s tests/bench/test_thresholds.py. 24 rows of shell, teapot and foam (50 views), the measured
walnut (60 views), the teapot in a cone whose voxels are wider than its pixels, and a shell of 12 views, too few to hold
any out. Loss of `r2` in dB, by default settings, of the walnut of the RMS of views never seen.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

import recon
from recon.assess.metrics import psnr
from recon.base.geometry import Geometry
from recon.base.volume import Grid
from tests.bench import quality_cases
from tests.bench.quality_cases import Case
from tests.bench.test_patch_prior import PHOTONS, TUNED, VIEWS


class Constant(NamedTuple):
    """A constant of a module, and the value with which its rule has no effect."""

    rule: str
    place: str
    removed: Any


def _matter_everywhere(*_: Any) -> None:
    return None


CONSTANTS = [
    Constant("octaves of a search", "recon.voxels.held_out._OCTAVES", 3),
    Constant("coarse voxels cannot explain edges", "recon.voxels.held_out._COARSE", math.inf),
    Constant("strongest prior within 3 %, coarse voxels", "recon.voxels.held_out._ALIKE", 0.0),
    Constant("trials leave out air", "recon.voxels.held_out.columns_of_matter", _matter_everywhere),
    Constant("search begins by the number of views", "recon.voxels.held_out.determined", lambda _: 1.0),
    Constant("standard errors that end a search", "recon.voxels.held_out._ERRORS", 0.0),
    Constant("sweeps of a trial", "recon.voxels.held_out._SWEEPS", 8),
    Constant("first strength of patches", "recon.voxels.methods.pnp_dct._FIRST", 1.0),
    Constant("higher threshold in short trials", "recon.voxels.methods.pnp_dct.TRIAL_THRESHOLD", 1.0),
    Constant("the same of a fit's trial", "recon.splatting.finish.TRIAL_THRESHOLD", 1.0),
    Constant("falling threshold of patches", "recon.voxels.pnp_dct._FALL", 1.0),
    Constant("pull towards sparse patches", "recon.voxels.pnp_dct._PULL", 0.3),
    Constant("a trial fit is looked at early", "recon.splatting.finish.FIRST_SHARE", 1.0),
    Constant("a fit too far behind ends", "recon.splatting.finish._FAR", math.inf),
    Constant("single wild rays of a finish", "recon.splatting.finish._WILD", math.inf),
    Constant("rings off the views of a finish", "recon.splatting.finish.ring_offsets", lambda *_: np.float32(0)),
    Constant("width of first Gaussians", "recon.splatting.initialise._SPREAD", 1.0),
    Constant("wild pixels of a start", "recon.splatting.initialise._WILD", math.inf),
    Constant("total variation of a fit by the change", "recon.splatting.settings._TV_CHANGE", math.inf),
    Constant("noise: share of the weight", "recon.voxels.noise_balance._SHARE", 1.0),
    Constant("noise: power of the residual", "recon.voxels.noise_balance._POWER", 0.0),
    Constant("noise: what only the residual shows", "recon.voxels.noise_balance._MOST_BY_FOUND", 1.0),
    Constant("noise: many views", "recon.voxels.noise_balance._MANY_VIEWS", 0.0),
    Constant("noise: bounded by a model", "recon.voxels.noise_balance._TOO_NOISY", math.inf),
]


def _slab(folder: Path, name: str, views: int = VIEWS) -> Case:
    """24 of the 40 rows."""
    case = quality_cases.slab(folder, name, views, PHOTONS)
    geometry = case.geometry.rows(8, 32)
    geometry = Geometry.parallel(geometry.angles, geometry.detector_shape, pixel_pitch=1.0)
    data = np.ascontiguousarray(case.projections[:, 8:32])
    return replace(case, projections=data, geometry=geometry, grid=Grid.matching(geometry), truth=case.truth[8:32])


ROWS: dict[str, Callable[[Path], Case]] = {
    "shell": lambda folder: _slab(folder, "shell"),
    "teapot": lambda folder: _slab(folder, "teapot"),
    "foam": lambda folder: _slab(folder, "foam"),
    "walnut": lambda folder: TUNED["walnut"](folder, "walnut"),
    "cone": lambda folder: quality_cases.cone(folder, "teapot", VIEWS, 64),
    "12 views": lambda folder: _slab(folder, "shell", 12),
}


def _quality(case: Case) -> float:
    use = recon.DataUse(case.weights)
    volume = recon.reconstruct(case.projections, case.geometry, "r2", grid=case.grid, use=use).volume.data
    if case.unseen is None:
        return psnr(case.truth, np.maximum(volume, 0), case.peak)
    data, geometry, rays = case.unseen
    differences = (recon.Projector(geometry, case.grid).forward(volume) - data)[rays]
    return float(-10 * np.log10(np.mean(np.square(differences, dtype=np.float64))))


@pytest.mark.bench
@pytest.mark.timeout(7200)
def test_what_each_constant_brings(shared_data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cases = {name: load(shared_data) for name, load in ROWS.items()}
    usual = {name: _quality(case) for name, case in cases.items()}
    print("| rule | where | value | removed | mean loss, dB | worst | on |\n|---|---|---|---|---|---|---|", flush=True)
    for rule, place, removed in CONSTANTS:
        module, name = place.rsplit(".", 1)
        value = getattr(importlib.import_module(module), name)
        with monkeypatch.context() as patch:
            patch.setattr(place, removed)
            loss = {row: usual[row] - _quality(case) for row, case in cases.items()}
        worst = max(loss, key=lambda row: loss[row])
        was, then = (str(each) if isinstance(each, int | float) else "rule" for each in (value, removed))
        mean = sum(loss.values()) / len(loss)
        where = place.removeprefix("recon.")
        print(f"| {rule} | `{where}` | {was} | {then} | {mean:+.2f} | {loss[worst]:+.2f} | {worst} |", flush=True)
    assert all(math.isfinite(each) for each in usual.values())
