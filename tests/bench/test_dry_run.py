"""The time that `recon --dry-run` predicts, compared with the time a run takes, in CPU s.

Run with  OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 pytest -m bench -s tests/bench/test_dry_run.py  (some ten minutes), or a
part of it with -k "walnut and r2". A run is single, in processor time, which others on the machine change by a fifth.
Where the data choose among several, the figure that counts is that of what they chose.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import recon
from beamline.projections.prepare import prepare_projections
from beamline.projections.selection import Selection
from beamline.projections.views import select
from beamline.storage.readers.open import SourceOptions
from recon.base.arrays import F32
from recon.base.geometry import Geometry
from recon.base.method import Method
from recon.base.volume import Grid
from recon.forecast import forecast
from recon.methods import by_name, names_compared
from recon.voxels.projector import Projector
from recon.warm_up import warm_up

_DATA = Path(__file__).parents[3] / "shared" / "data"
_WITHIN, _MOST = 0.3, 0.72  # of the time; share of all runs that must be so near

Views = tuple[F32, Geometry]


def _scan(name: str, quantity: str | None = None, **chosen: object) -> Views:
    """Corrected views of a scan file."""
    with SourceOptions(_DATA / name, quantity=quantity).open() as source:  # type: ignore[arg-type]
        prepared = prepare_projections(select(source, Selection(**chosen)), lambda warning: None)  # type: ignore[arg-type]
    return np.ascontiguousarray(prepared.seen.data, np.float32), prepared.geometry


def _walnut(views: int, rows: int, binning: int = 1) -> Views:
    some = (48 - rows // 2, 48 + rows // 2)
    name = "walnut_parallel_rebinned_240x96x256.h5"
    return _scan(name, "line-integrals", views=f"fixed:{views}", rows=some, binning=binning)


def _cone(views: int) -> Views:
    """A CT volume of a teapot, projected in a cone, with noise."""
    with np.load(_DATA / "scivis_teapot_256.npz") as file:
        whole = file[file.files[0]].astype(np.float32)
    depth = whole.shape[0] // 2
    volume = whole[: 2 * depth].reshape(depth, 2, 128, 2, 128, 2).mean((1, 3, 5)) * np.float32(0.02 / whole.max())
    angles = np.linspace(0, 2 * np.pi, views, endpoint=False)
    geometry = Geometry.cone(angles, (depth + 8, 144), 2.0, 1024, 2048)
    data = Projector(geometry, Grid((depth, 128, 128), 2.0)).forward(volume)
    return data + np.random.default_rng(0).normal(0, 0.01, data.shape).astype(np.float32), geometry


SCANS: dict[str, Callable[[], Views]] = {
    "walnut 60 x 32 x 256": lambda: _walnut(60, 32),
    "walnut 120 x 48 x 128": lambda: _walnut(120, 96, 2),
    "Diamond 91 x 135 x 160": lambda: _scan("diamond_24737_parallel_91x135x160.h5", axis_col=85.75),
    "tooth 181 x 2 x 640": lambda: _scan("aps2bm_tooth_181x2x640.h5", axis_col=295.6),
    "teapot, cone 50 x 97 x 144": lambda: _cone(50),
}
_SHORT: tuple[Method, ...] = (
    recon.Fbp(), recon.Sirt(iterations=20), recon.Sart(iterations=3), recon.Cgls(), recon.AsdPocs(iterations=3),
    recon.FistaTv(), recon.OsSirtTv(), recon.PnpDct(), recon.R2(steps=200, finish=0), recon.R2(), recon.Auto(),
)  # fmt: skip
METHODS = (*_SHORT, *(by_name(name)() for name in names_compared() if name not in {each.name for each in _SHORT}))
SHARES: list[float] = []  # expected over taken, of all runs so far


@functools.cache
def _views(scan: str) -> Views:
    return SCANS[scan]()


def _named(method: Method) -> str:
    return f"{method.name}, 200 steps" if getattr(method, "steps", None) else method.name


@pytest.mark.bench
@pytest.mark.timeout(1800)
@pytest.mark.skipif(not _DATA.is_dir(), reason="needs the real scans")
@pytest.mark.parametrize("method", METHODS, ids=_named)
@pytest.mark.parametrize("scan", SCANS)
def test_a_run_takes_the_seconds_that_were_expected(scan: str, method: Method) -> None:
    (data, geometry), now = _views(scan), time.process_time
    for each in method.alternatives:
        warm_up(each, geometry)
    begin = now()
    found = forecast(method, geometry, Grid.matching(geometry), now)
    assert found is not None
    timing = now() - begin
    begin, repeats = now(), 5 if not method.fitted else 1
    for _ in range(repeats):
        made = recon.reconstruct(data, geometry, method)
    taken = (now() - begin) / repeats
    expected = found.choice_seconds + found.volumes.get(made.method, found.most)
    SHARES.append(expected / taken)
    near = sum(abs(share - 1) <= _WITHIN for share in SHARES)
    print(
        f"\n| {scan} | {_named(method)} | {expected:.2f} | {found.least:.2f} to {found.most:.2f} | {taken:.2f} "
        f"| {timing:.2f} | {SHARES[-1]:.2f} | {near} of {len(SHARES)} within 30 %",
        flush=True,
    )


@pytest.mark.bench
def test_most_runs_were_near() -> None:
    """Of the runs before, in one call."""
    if not SHARES:
        pytest.skip("none ran before in this call")
    near = sum(abs(share - 1) <= _WITHIN for share in SHARES)
    assert near >= _MOST * len(SHARES)
