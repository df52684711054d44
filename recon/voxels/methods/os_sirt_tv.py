"""OS-SIRT-TV: ordered-subset SIRT with a proximal step of total variation after each sweep."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar, Self

from recon.base.arrays import F32
from recon.base.geometry import Geometry
from recon.base.method import ReconProblem, Reconstruction, RunControl, Traits
from recon.base.settings_check import check_settings
from recon.base.volume import Grid
from recon.base.work import Costs, Work
from recon.voxels.held_out import CHOICE_SWEEPS, choose_weight
from recon.voxels.iterative import TV_WEIGHT_CHOSEN, run_iterative
from recon.voxels.noise_balance import NoiseBalance
from recon.voxels.sweeps import interleaved
from recon.voxels.tv import TotalVariationProx, difference_weights
from recon.voxels.voxel_problem import Momentum, VoxelProblem, density_unit, iterative_memory
from recon.voxels.work import on_volume, ordered_sweeps, weight_choice


@dataclass(frozen=True)
class OsSirtTv:
    """A sweep of ordered-subset SIRT, then a proximal step of TV. Memory: 6 volumes, 3 x the projections.

    It is for views of very few photons (10 to 30 a pixel: up to 2 dB ahead), and with `momentum` for a quick volume.
    Of a cone its weight follows the noise: 2.3 dB behind FISTA-TV on a thorax, whose weight views held out choose.

    Attributes:
        tv_weight: threshold of that step in density units; None: by views held out or by the noise, see
            `choose_weight`.
        momentum: carry sweeps on along their last change (Kim, Ramani & Fessler 2015, IEEE Trans. Med. Imaging 34,
            167), for two volumes more: a quick volume. After 10 sweeps +4.2 dB (battery) and +2.1 dB (walnut), after 40
            -0.1 and -1.0 dB: noise comes in sooner, too.
    """

    name: ClassVar[str] = "os-sirt-tv"
    label: ClassVar[str] = "OS-SIRT-TV"
    traits: ClassVar[Traits] = Traits(budget=True, halo=20)

    iterations: int = 40
    subsets: int = 9
    tv_weight: float | None = None
    tv_steps: int = 5
    momentum: bool = False
    allow_negative: bool = False

    def __post_init__(self) -> None:
        check_settings(self, whole={"iterations": 1, "subsets": 1, "tv_steps": 0}, least={"tv_weight": 0.0})

    @property
    def trial_sweeps(self) -> int:
        """Those for the weight."""
        return 0 if self.tv_weight is not None else CHOICE_SWEEPS

    def run(self, problem: ReconProblem, control: RunControl) -> Reconstruction:
        return run_iterative(self, problem, control)

    def iterate(self, problem: VoxelProblem, x: F32) -> F32:
        projector = problem.projector
        sweeps = problem.sweeps(interleaved(projector, self.subsets))
        prox = TotalVariationProx(x.shape, difference_weights(projector.grid), problem.nonnegative, self.tv_steps)
        scale = problem.scale
        weight: NoiseBalance | float | None = None
        threshold = 0.0
        ahead = Momentum(x, problem.decide) if self.momentum else None
        for k in range(self.iterations):
            error = sweeps.run(x, 1.0, problem.nonnegative, problem.rng)
            if self.tv_weight is None:
                weight = weight or choose_weight(problem, x, self.iterations)
                if isinstance(weight, NoiseBalance):
                    weight.value = problem.decide("balance", partial(weight.after_sweep, sweeps.residual))
                mu = weight.value if isinstance(weight, NoiseBalance) else weight
                threshold = float(mu * problem.decide("pace", lambda: sweeps.pace))
                prox(x, threshold)
            else:
                # The unit follows the volume: the first sweeps are blurred, and fainter than later ones.
                prox(x, self.tv_weight * problem.decide("unit", partial(density_unit, x)))
            prox.turn()
            if not problem.go_on(k + 1, math.sqrt(error) / scale) or k + 1 == self.iterations:
                break
            if ahead is not None:
                ahead(x)
        if self.tv_weight is None and (unit := density_unit(x)) > 0:
            problem.decide(TV_WEIGHT_CHOSEN, lambda: threshold / unit)
        return x

    def toy(self) -> Self:
        return replace(self, iterations=1)

    def costs(self, geometry: Geometry, grid: Grid) -> Costs:
        step = on_volume("tv", grid, self.tv_steps + 1) + on_volume("pass", grid, 2 * self.momentum)
        work = ordered_sweeps(geometry, grid, self.iterations, self.subsets) + self.iterations * step
        return Costs({self.name: work}, weight_choice(geometry, grid) if self.tv_weight is None else Work())

    def memory(self, geometry: Geometry, grid: Grid, weighted: bool) -> int:
        return iterative_memory(geometry, grid, 8.1 + 2 * self.momentum, 5.2, 8.2 * weighted, filtered=True)
