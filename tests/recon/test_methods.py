"""The registry of methods: each name gives its object, and one line registers a method everywhere."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import fields, is_dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import recon
from recon import methods
from recon.base.method import Method
from recon.splatting.fit_method import Fit
from recon.testing import MethodConformance
from recon.voxels.projector import Projector
from tests.messages import refused
from tests.recon.saved import comes_back

ROOT = Path(__file__).parents[2]
VIEWS = recon.Geometry.parallel(np.linspace(0, np.pi, 12, endpoint=False), (6, 24), pixel_pitch=0.5)


@pytest.fixture(scope="module")
def projections() -> NDArray[np.float32]:
    grid = recon.Grid.matching(VIEWS)
    truth = np.zeros(grid.shape, np.float32)
    truth[1:5, 8:15, 6:13] = 0.2
    return Projector(VIEWS, grid).forward(truth)


@pytest.mark.parametrize("name", methods.taking("allow_negative"))
def test_negative_densities_are_kept_where_they_are_allowed(name: str, projections: NDArray[np.float32]) -> None:
    """Air below zero: 0.02 on rays of 12 mm."""
    views = projections - np.float32(0.02)
    short = {"steps": 4, "gaussians": 50, "finish": 2} if name in methods.taking("finish") else {"iterations": 3}

    def lowest(**allowed: bool) -> float:
        method = methods.build(methods.by_name(name), {**short, **allowed})
        return float(recon.reconstruct(views, VIEWS, method).volume.data.min())

    assert lowest() == 0
    assert lowest(allow_negative=True) < -5e-4


@pytest.mark.parametrize("name", methods.names())
def test_registry_entries_match_their_classes(name: str) -> None:
    method = methods.by_name(name)
    assert method.name == name and method.label
    assert is_dataclass(method) and getattr(recon, method.__name__) is method
    assert methods.streams(name) is issubclass(method, Fit)


def test_settings_are_built_by_name() -> None:
    built = methods.build(recon.R2, {"steps": 5, "fit.loss": "l2", "fit.truncation.sigmas": 3.0})
    assert isinstance(built, recon.R2)
    assert (built.steps, built.fit.loss, built.fit.truncation.sigmas) == (5, "l2", 3.0)
    assert built.fit.ssim_weight == recon.R2().fit.ssim_weight
    assert methods.taking("tv_weight") == ("fista-tv", "os-sirt-tv")
    assert methods.taking("fit.loss") == ("r2", "r2-published")
    assert "iterations" not in {f.name for f in fields(recon.R2)}
    with refused(ValueError):
        methods.build(recon.Sirt, {"tv_weight": 0.1})
    with refused(ValueError):
        methods.build(recon.Sirt, {"magic": 0.1})


def test_an_unknown_name_is_refused_with_the_legal_ones() -> None:
    for look in (methods.by_name, methods.streams):
        with refused(ValueError):
            look("art")


@pytest.mark.parametrize("method", [recon.FistaTv, recon.OsSirtTv])
@pytest.mark.parametrize("weight", [-1e-3, float("nan"), float("inf")])
def test_a_weight_that_no_total_variation_has_is_refused(method: type[recon.FistaTv], weight: float) -> None:
    with refused(ValueError):
        method(tv_weight=weight)


def test_names_load_nothing_that_computes() -> None:
    code = "import sys, recon.methods as m; m.names(); m.streams('r2'); print({'torch', 'numba'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize("name", [*methods.names(), "auto"])
def test_what_any_method_makes_is_saved_and_comes_back(
    name: str, projections: NDArray[np.float32], tmp_path: Path
) -> None:
    if name == "auto":
        method: Method = recon.Auto((recon.Fbp(), recon.R2(steps=4, gaussians=50, finish=1)))
    elif name in methods.names_of_one_volume():
        method = methods.by_name(name)().toy()
    else:
        method = methods.build(methods.by_name(name), {"sweeps": 1, "weight": 0.01, "moves": False})
    several = recon.Geometry.parallel(np.tile(VIEWS.angles, method.volumes), VIEWS.detector_shape, pixel_pitch=0.5)
    views = np.concatenate([projections] * method.volumes)
    comes_back(recon.reconstruct(views, several, method), tmp_path / "v.npz")


class TestConformance(MethodConformance):
    """Ours pass the suite that is shipped."""

    @pytest.fixture(
        params=[
            pytest.param(name, marks=[pytest.mark.slow] * entry.module.startswith("recon.features"))
            for name, entry in methods.REGISTRY.items()
        ]
        + [pytest.param("auto", marks=pytest.mark.slow)]
    )
    def method(self, request: pytest.FixtureRequest) -> Method:
        fit = recon.R2(steps=40, gaussians=200, finish=2)
        if request.param == "auto":
            return recon.Auto((recon.Fbp(), recon.FistaTv(iterations=3), fit))
        method = methods.by_name(request.param)
        if request.param not in methods.names_of_one_volume():
            return methods.build(
                method, {"sweeps": 5, "weight": 0.01} | ({"moves": False} if request.param == methods.IN_TIME else {})
            )
        short = {"iterations": 5, "steps": 40, "gaussians": 200, "finish": 2}
        return methods.build(method, {k: v for k, v in short.items() if methods.has_setting(method, k)})
