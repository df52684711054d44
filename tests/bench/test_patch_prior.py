"""Sparse patches beside total variation, the fit and auto, on scans that it was tuned on, and on scans held back.

Run with  pytest -m bench -s tests/bench/test_patch_prior.py -k tuned  (or held_back). 50 views, 10⁵ photons, 40 x 128²
voxels or fewer, from volumes of twice the resolution. PSNR in dB and CPU seconds; the walnut and Diamond are measured,
and judged by the RMS of views never seen.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray
from scipy.ndimage import zoom

import recon
from recon.assess.metrics import psnr
from recon.warm_up import warm_up
from tests.bench import quality_cases
from tests.bench.quality_cases import SLABS, Case

F32 = NDArray[np.float32]
METHODS = recon.FistaTv(), recon.PnpDct(), recon.R2(), recon.Auto()
VIEWS, PHOTONS = 50, 1e5


def _textured(name: str, own_voxels: bool) -> Callable[[Path], F32]:
    """Slices of a CT volume, 0 outside the field.

    Args:
        own_voxels: 24 slices, interpolated to twice the resolution, so that the voxels of the case are those of the CT,
            whose edges are one or two wide; else 80 slices as they are, whose structure is finer than those voxels.
    """

    def load(folder: Path) -> F32:
        slices = slice(52, 76) if own_voxels else slice(24, 104)
        volume = tifffile.imread(folder / f"qim3d_{name}_128x128x128.tif").astype(np.float32)[slices]
        _, y, x = np.indices(volume.shape, np.float32)
        inside = np.where(np.hypot(y - 63.5, x - 63.5) < 62, volume / volume.max(), 0).astype(np.float32)
        return zoom(inside, 2, order=1, mode="nearest", grid_mode=True) if own_voxels else inside

    return load


def _slab(folder: Path, name: str) -> Case:
    return quality_cases.slab(folder, name, VIEWS, PHOTONS)


def _walnut(folder: Path, name: str) -> Case:
    """60 of 240 measured views, and the 60 between them."""
    case, other = quality_cases.walnut_halved(folder, 120), np.arange(1, 120, 2)
    rays = np.ones(case.projections[other].shape, np.bool_)
    unseen = case.projections[other], case.geometry.select(other), rays
    seen = np.arange(0, 120, 2)
    return replace(case, projections=case.projections[seen], geometry=case.geometry.select(seen), unseen=unseen)


def _diamond(folder: Path, name: str) -> Case:
    return quality_cases.diamond(folder, 76)


TUNED = {"shell": _slab, "teapot": _slab, "walnut": _walnut, "diamond": _diamond}
TEXTURED = {
    f"{name}{', binned' * (not own)}": _textured(name, own) for name in ("bone", "cement") for own in (True, False)
}
HELD_BACK = {**dict.fromkeys(TEXTURED, _slab), "thorax": _slab}


def _row(case: Case, name: str) -> dict[str, float]:
    """dB, or 20 log10 of the inverse RMS of views never seen, by method."""
    found: dict[str, float] = {}
    for method in METHODS:
        warm_up(method, case.geometry, weighted=case.weights is not None)
        begin = time.process_time()
        use = recon.DataUse(case.weights)
        volume = recon.reconstruct(case.projections, case.geometry, method, grid=case.grid, use=use).volume.data
        seconds = time.process_time() - begin
        if case.unseen is None:
            found[method.name], said = (quality := psnr(case.truth, np.maximum(volume, 0), case.peak)), f"{quality:.2f}"
        else:
            data, geometry, rays = case.unseen
            left = (recon.Projector(geometry, case.grid).forward(volume) - data)[rays]
            rms = float(np.sqrt(np.mean(np.square(left, dtype=np.float64))))
            found[method.name], said = -20 * np.log10(rms), f"{rms:.5f}"
        print(f"| {name} | {method.name} | {said} | {seconds:.1f} CPU s |", flush=True)
    return found


@pytest.mark.bench
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", list(TUNED))
def test_scans_that_it_was_tuned_on(shared_data: Path, name: str) -> None:
    found = _row(TUNED[name](shared_data, name), name)
    assert found["pnp-dct"] > found["fista-tv"] - 0.5


@pytest.mark.bench
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", list(HELD_BACK))
def test_scans_held_back(shared_data: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for textured, load in TEXTURED.items():
        monkeypatch.setitem(SLABS, textured, load)
    found = _row(HELD_BACK[name](shared_data, name), name)
    assert found["pnp-dct"] > found["fista-tv"]
