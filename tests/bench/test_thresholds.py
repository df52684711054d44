"""The effect of each empirical constant of recon: the loss on small scans without it.

Run with  pytest -m bench -s tests/bench/test_thresholds.py  (an hour of one core). It prints a table
with the text of recon/base/empirical.py. Eight rows of shell, teapot and foam (50 views), the
measured walnut (60), bone and cement; a teapot and a shell in cones whose voxels are wider than their pixels; a region
of interest; views with wild pixels; and 12 views, too few to hold any out. PSNR in dB; of the walnut the RMS of views
never seen. Nothing may be tuned on bone and cement: they only decide what goes.
"""

from __future__ import annotations

import ast
import importlib
import math
import pkgutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

import recon
from recon.assess.metrics import psnr
from recon.base import empirical
from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.splatting.settings import DensityPolicy, FitSettings
from tests.bench import quality_cases
from tests.bench.quality_cases import SLABS, TEXTURED, Case, rows_of, walnut_held_out

VIEWS, PHOTONS = 50, 1e5
VALIDATION = "bone", "cement", "12 bone", "12 cement", "180 bone", "180 cement"


def _slab(folder: Path, name: str, views: int = VIEWS) -> Case:
    first = 8 if name in TEXTURED else 16  # bone and cement have 24 rows, the others 40
    return rows_of(quality_cases.slab(folder, name, views, PHOTONS), range(first, first + 8))


def _region(folder: Path) -> Case:
    """The teapot in the middle 80 of 128 columns."""
    case, inner = _slab(folder, "teapot"), slice(24, 104)
    geometry = Geometry.parallel(case.geometry.angles, (8, 80), pixel_pitch=1.0)
    data, truth = np.ascontiguousarray(case.projections[..., inner]), case.truth[:, inner, inner]
    return replace(case, projections=data, geometry=geometry, grid=Grid.matching(geometry), truth=truth)


def _wild(folder: Path, share: float, value: float) -> Case:
    """The teapot with wild pixels; one, where their share is 0."""
    case = _slab(folder, "teapot")
    data = case.projections.copy()
    data[np.random.default_rng(6).random(data.shape) < share] = value
    data[7, 3, 60] = value
    return replace(case, projections=data)


ROWS: dict[str, Callable[[Path], Case]] = {
    **{name: partial(_slab, name=name) for name in ("shell", "teapot", "foam", "bone", "cement")},
    "walnut": lambda folder: rows_of(walnut_held_out(folder), range(12, 20)),
    "teapot, cone": lambda folder: quality_cases.cone(folder, "teapot", VIEWS, 64),
    "shell, cone": lambda folder: quality_cases.cone(folder, "shell", VIEWS, 64),
    "region": _region,
    "wild pixels": lambda folder: _wild(folder, 2e-4, 12.0),
    "one wild pixel": lambda folder: _wild(folder, 0.0, 1e6),
    **{f"12 {name}": partial(_slab, name=name, views=12) for name in ("shell", "foam", "bone", "cement")},
    **{f"180 {name}": partial(_slab, name=name, views=180) for name in ("bone", "cement")},
}
ALL = "shell", "teapot", "foam", "walnut", "bone", "cement", "teapot, cone", "region"
PATCHES = "foam", "walnut", "bone", "cement"
FITS = "shell", "teapot", "teapot, cone", "12 shell", "12 foam", "12 bone", "12 cement"
BY_NOISE = "foam", "walnut", "bone", "cement", "180 bone", "180 cement"


@dataclass(frozen=True)
class Removed:
    """How a constant is removed, and where that is measured.

    Attributes:
        value: with which its rule has no effect; of a default of settings, the published one.
        by_noise: FISTA-TV makes the volume, with no views held out.
    """

    value: Any
    rows: tuple[str, ...]
    method: recon.Method | None = None
    by_noise: bool = False


def _fit(**settings: Any) -> recon.R2:
    return recon.R2(fit=FitSettings(**settings))


REMOVED: dict[str, Removed] = {
    "SHARPENED": Removed(0.0, (*ALL, "shell, cone")),
    "FIRST_THRESHOLD": Removed(1.0, ("12 shell", "12 foam", "12 bone", "12 cement"), recon.PnpDct()),
    "PULL": Removed(0.3, PATCHES),
    "FALL": Removed(1.0, PATCHES),
    "SHARE_OF_NOISE": Removed(1.0, BY_NOISE, by_noise=True),
    "MOST_BY_RESIDUAL": Removed(1.0, BY_NOISE, by_noise=True),
    "MANY_VIEWS": Removed(0.0, BY_NOISE, by_noise=True),
    "SPREAD": Removed(1.0, FITS),
    "WILD_PIXEL": Removed(math.inf, ("one wild pixel",), recon.R2(steps=400)),
    "EMPTY": Removed(math.inf, ("region",)),
    "PACE": Removed(1.0, FITS, _fit(pace=1.0)),
    "VIEWS_A_STEP": Removed(1, FITS, _fit(views_per_step=1)),
    "NARROWEST": Removed(0.128, (*FITS, "shell, cone"), _fit(smallest=0.128)),
    "TV_OF_NOISE": Removed(0.0, FITS),
    "TV_LEAST": Removed(0.0, (*FITS, "shell, cone")),
    "TV_MOST": Removed(math.inf, FITS),
    "TV_CHANGE": Removed(math.inf, FITS),
    "LOST": Removed(0.0, (*FITS, "region")),
    "GROWTH": Removed(10.0, FITS, _fit(policy=DensityPolicy(growth=10.0))),
    "WILD_RAY": Removed(math.inf, ("wild pixels",)),
}
"""The others are numbers without which nothing is left to measure, or act where these rows do not."""
WORTH = 0.3  # dB of the worst row
SAVES_TIME = ("SPREAD",)


@contextmanager
def _without(name: str, value: Any) -> Iterator[None]:
    """The constant has this value in all modules that import it."""
    with ExitStack() as stack:
        for found in pkgutil.walk_packages(recon.__path__, "recon."):
            if ".kernels" not in found.name and "__main__" not in found.name and ".fields" not in found.name:
                module = importlib.import_module(found.name)
                if module is not empirical and hasattr(module, name):
                    stack.enter_context(patch.object(module, name, value))
        yield


def _quality(case: Case, method: recon.Method, by_noise: bool) -> float:
    with ExitStack() as stack:
        if by_noise:
            held_out = "recon.voxels.trial.Trial.of"
            stack.enter_context(patch(held_out, classmethod(lambda cls, problem: None)))
            method = recon.FistaTv()
        use = recon.DataUse(case.weights)
        volume = recon.reconstruct(case.projections, case.geometry, method, grid=case.grid, use=use).volume.data
    if case.unseen is None:
        return psnr(case.truth, np.maximum(volume, 0), case.peak)
    data, geometry, rays = case.unseen
    differences = (recon.Projector(geometry, case.grid).forward(volume) - data)[rays]
    return float(-10 * np.log10(np.mean(np.square(differences, dtype=np.float64))))


def _evidence() -> dict[str, str]:
    """The text behind each constant."""
    found, names = {}, list[str]()
    for statement in ast.parse(Path(empirical.__file__).read_text()).body:
        if isinstance(statement, ast.Assign):
            target = statement.targets[0]
            names = [part.id for part in getattr(target, "elts", [target])]
        elif isinstance(statement, ast.Expr) and names and isinstance(statement.value, ast.Constant):
            found.update(dict.fromkeys(names, " ".join(str(statement.value.value).split())))
            names = []
    return found


@pytest.mark.bench
@pytest.mark.timeout(7200)
def test_what_each_constant_brings(shared_data: Path) -> None:
    cases, of_no_use = dict[str, Case](), dict[str, float]()
    usual: dict[tuple[str, str, bool], float] = {}

    def quality(row: str, method: recon.Method, by_noise: bool) -> float:
        if row not in cases:
            with patch.dict(SLABS, TEXTURED):
                cases[row] = ROWS[row](shared_data)
        return _quality(cases[row], method, by_noise)

    print("| constant | value | what it is, and what is lost without it | removed | bone, cement | worst |")
    print("|---|---|---|---|---|---|", flush=True)
    for name, text in _evidence().items():
        value, test = getattr(empirical, name), REMOVED.get(name)
        if test is None:
            print(f"| `{name}` | {value:g} | {text} | | | |", flush=True)
            continue
        plain = recon.R2(steps=400) if name == "WILD_PIXEL" else recon.PnpDct() if name == "FIRST_THRESHOLD" else None
        loss = {}
        for row in test.rows:
            key = row, name if plain else "", test.by_noise
            if key not in usual:
                usual[key] = quality(row, plain or recon.R2(), test.by_noise)
            with _without(name, test.value):
                loss[row] = usual[key] - quality(row, test.method or recon.R2(), test.by_noise)
        worst = max(loss, key=lambda row: loss[row])
        held_back = [loss[row] for row in loss if row in VALIDATION]
        mean = f"{-sum(held_back) / len(held_back):+.2f}" if held_back else ""
        print(f"| `{name}` | {value:g} | {text} | {test.value:g} | {mean} | {-loss[worst]:+.2f} {worst} |", flush=True)
        if name not in SAVES_TIME and loss[worst] < WORTH:
            of_no_use[name] = loss[worst]
    assert all(math.isfinite(each) for each in usual.values())
    assert not of_no_use, f"no row loses {WORTH} dB without these: they can go"
