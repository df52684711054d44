"""Quality against time of every method on the same data: R²-Gaussian, and what a user would take instead.

Run with  pytest -m bench -s tests/bench/test_quality.py -k "teapot-50"  (some minutes a case). One line a method: PSNR
and SSIM as Zha et al. 2024 take them (volumes clipped at 0, SSIM the mean over the slices of three directions), wall
and processor seconds. FISTA-TV stands at the best of the weights tried for each case and by the time of that one run;
R²-Gaussian has its default settings everywhere; steps and Gaussians at the start stand in the rows. A row with sweeps
is the row before, finished (`recon.splatting.finish`), and holds the time of both.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import recon
from recon import AsdPocs, FistaTv, OsSirtTv, Sirt
from recon.assess.metrics import psnr, ssim3d
from recon.base.kernel import Kernel
from recon.base.method import ReconProblem
from recon.splatting.finish import finish
from recon.splatting.settings import FitSettings
from recon.voxels.fbp import fbp
from recon.voxels.fdk import fdk
from recon.voxels.iterative import solve
from recon.voxels.projector import Projector
from recon.warm_up import warm_up
from tests.bench.quality_cases import OBJECTS, Case, cone, dense_battery, walnut

F32 = NDArray[np.float32]
# Where the search for the best weight begins, and its factor.
FISTA_WEIGHT, FACTOR = 3e-4, 3.0


class Table:
    """Rows of one case; each is printed when it is known."""

    def __init__(self, case: Case) -> None:
        self.case, self.rows = case, dict[str, tuple[float, float, float, float]]()
        print(
            f"\n{case.name}, {case.geometry.n_views} views of {case.geometry.detector_shape}, {case.grid.shape} voxels"
        )

    def add(self, name: str, make: Callable[[], F32], after: str = "") -> float:
        """Time a method and judge its volume [z, y, x]; its PSNR. What it took up from `after` took time, too."""
        earlier = self.rows[after][2:] if after else (0.0, 0.0)
        begin, worked = time.perf_counter() - earlier[0], time.process_time() - earlier[1]
        volume = np.maximum(make(), 0)
        wall, cpu = time.perf_counter() - begin, time.process_time() - worked
        quality = psnr(self.case.truth, volume, self.case.peak), ssim3d(self.case.truth, volume, self.case.peak)
        self.rows[name] = (*quality, wall, cpu)
        print(f"  {name:44s} {quality[0]:6.2f} dB  {quality[1]:.4f} {wall:7.1f} s {cpu:7.1f} CPU s", flush=True)
        return quality[0]

    def best(self, start: str) -> tuple[str, tuple[float, float, float, float]]:
        """The row with the highest PSNR of those whose name begins so."""
        return max(((n, r) for n, r in self.rows.items() if n.startswith(start)), key=lambda row: row[1][0])


def best_weight(quality: Callable[[float], float]) -> float:
    """The weight from which the quality falls to both sides, in steps of FACTOR."""
    found = {w: quality(w) for w in (FISTA_WEIGHT, FISTA_WEIGHT * FACTOR)}
    while (top := max(found, key=lambda w: found[w])) in (min(found), max(found)):
        further = top * FACTOR if top == max(found) else top / FACTOR
        found[further] = quality(further)
    return top


def _compile(case: Case) -> None:
    """All kernels of this kind of beam, outside the timings."""
    warm_up(geometry=case.geometry)
    few = case.geometry.select(np.arange(0, case.geometry.n_views, max(1, case.geometry.n_views // 3)))
    data = case.projections[:: max(1, case.geometry.n_views // 3)][: few.n_views]
    for how in (Sirt(1), AsdPocs(1), FistaTv(1), OsSirtTv(1, 2, momentum=True)):
        solve(how, Projector(few, case.grid), data)


def _compare(
    case: Case,
    fits: tuple[int, ...],
    count: int,
    sweeps: tuple[int, ...] = (6,),
    os_weights: tuple[float, ...] = (0.004,),
    slow_ones: bool = True,
    fista_iterations: int = 20,
) -> Table:
    """All methods; fits of so many steps from `count` Gaussians, each finished by so many sweeps."""
    _compile(case)
    table = Table(case)
    data, geometry, grid = case.projections, case.geometry, case.grid
    projector = Projector(geometry, grid)

    def iterated(how: Sirt | AsdPocs | FistaTv | OsSirtTv) -> Callable[[], F32]:
        return lambda: solve(how, projector, data).data

    if geometry.is_cone:
        table.add("FDK, hann", lambda: fdk(data, geometry, grid, "hann"))
    else:
        table.add("FBP, hann", lambda: fbp(data, geometry, grid, filter="hann"))
    if slow_ones:
        table.add("SIRT, 100 iterations", iterated(Sirt(100)))
        table.add("ASD-POCS, 10 iterations", iterated(AsdPocs(10)))
    for weight in os_weights:
        table.add(f"OS-SIRT-TV, 40 sweeps, weight {weight:g}", iterated(OsSirtTv(40, tv_weight=weight)))
    table.add("FISTA-TV, default", iterated(FistaTv()))
    table.add("OS-SIRT-TV, default", iterated(OsSirtTv()))
    best_weight(lambda weight: table.add(
        f"FISTA-TV, {fista_iterations} iterations, weight {weight:.2g}",
        iterated(FistaTv(fista_iterations, tv_weight=weight)),
    ))  # fmt: skip
    for steps in fits:
        made: list[recon.Reconstruction] = []

        def fitted(steps: int = steps, made: list[recon.Reconstruction] = made) -> F32:
            made.append(recon.reconstruct(data, geometry, recon.R2(steps=steps, gaussians=count, finish=0), grid=grid))
            return made[0].volume.data

        name = f"R²-Gaussian, {steps} steps from {count // 1000}k"
        table.add(name, fitted)
        model = made[0].gaussians
        assert model is not None
        problem = ReconProblem(data, geometry, grid, recon.DataUse(), 0, "cpu")
        for n in sweeps:
            table.add(
                f"{name}, {n} sweeps",
                lambda n=n, model=model, made=made, problem=problem: finish(made[0].volume, model, problem, n).data,  # type: ignore[misc]
                after=name,
            )
    name, peer = table.best("FISTA")
    _, ours = table.best("R²")
    print(f"  R²-Gaussian - {name}: {ours[0] - peer[0]:+.2f} dB in {ours[2] / peer[2]:.2f} of the time")
    return table


@pytest.mark.bench
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("views", [75, 50, 25])
@pytest.mark.parametrize("name", list(OBJECTS))
def test_the_published_protocol_at_half_size(shared_data: Path, name: str, views: int) -> None:
    table = _compare(cone(shared_data, name, views, 128), (500, 1000), 75_000, slow_ones=views == 50)
    assert table.best("R²")[1][0] > table.best("FISTA")[1][0]


@pytest.mark.bench
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("views", [75, 50, 25])
def test_a_measured_walnut(shared_data: Path, views: int) -> None:
    table = _compare(walnut(shared_data, views), (300, 600), 35_000)
    assert table.best("R²")[1][0] > table.best("FBP")[1][0]


@pytest.mark.bench
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("views", [180, 90, 45])
def test_a_battery_full_of_particles(views: int) -> None:
    table = _compare(dense_battery(views), (500, 1500), 150_000, (6, 12), (0.002, 0.004, 0.008))
    assert table.best("R²")[1][0] > table.best("SIRT")[1][0]


@pytest.mark.bench
@pytest.mark.timeout(3600)
@pytest.mark.parametrize(("views", "published"), [(75, 48.1), (50, 47.6), (25, 46.0)])
def test_the_teapot_at_full_size_against_the_published_figures(shared_data: Path, views: int, published: float) -> None:
    case = cone(shared_data, "teapot", views, 256)
    warm_up(geometry=case.geometry)
    table = Table(case)
    # Fewer Gaussians too: with 25 views they are few data for 50k. True Gaussians, as those published.
    gaussian = FitSettings(kernel=Kernel.GAUSSIAN)
    for steps, count, settings in (
        (1500, 50_000, gaussian),
        (2000, 15_000, gaussian),
        (3000, 50_000, gaussian),
        (10_000, 50_000, replace(gaussian, views_per_step=1, pace=5.0)),
    ):
        fit = recon.R2(steps=steps, gaussians=count, fit=settings)
        table.add(
            f"R²-Gaussian, {steps} steps of {settings.views_per_step} views from {count // 1000}k",
            lambda fit=fit: recon.reconstruct(case.projections, case.geometry, fit, grid=case.grid).volume.data,
        )
    assert table.best("R²")[1][0] > published - 1
