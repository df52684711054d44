"""Runs one trial: reconstructs a volume and measures its quality. The module also has the data that all trials of a
scan share."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from beamline.core.errors import user_message
from beamline.core.machine import peak_memory, reset_peak_memory
from beamline.features.trials.trial import MethodTrial, Outcome, TrialTable
from beamline.features.trials.view_choices import ViewChoice
from beamline.reconstruct.run import run_on
from recon.assess import metrics
from recon.base.arrays import F32
from recon.base.geometry import Geometry
from recon.base.method import Method, RunControl
from recon.base.view_data import Views
from recon.base.views import parse_views
from recon.base.volume import Grid, Volume
from recon.judgement import contrast_in, judge
from recon.warm_up import warm_up

_JUDGED = "psnr", "ssim3d", "residual_held_out"
_UNWATCHED = RunControl()


class TrialRun(NamedTuple):
    """The work of a trial: a method, the projections, and the grid of the volume."""

    method: Method
    views: Views
    grid: Grid
    seed: int
    device: str = "cpu"


class TrialScan(Protocol):
    """The scan that trials reconstruct. It gives the work of each trial, and measures the quality of its volume.

    Attributes:
        truth: the ground truth [z, y, x] of all trials, if it is known.
    """

    truth: F32 | None = None

    def asked_by(self, trial: MethodTrial) -> TrialRun:
        """The work of a trial. Raises ValueError if a setting or the projections do not exist."""

    def measured(self, trial: MethodTrial, volume: Volume) -> tuple[Mapping[str, float], Sequence[float]]:
        """Figures of merit of a volume by name, and the squared residual in each held-out projection."""

    def concluded(self, table: TrialTable) -> TrialTable:
        """The table with the conclusions from all trials added."""
        return table


@dataclass(frozen=True, eq=False)
class TrialData(TrialScan):
    """The data that all trials of a scan share.

    Attributes:
        views: the projections that may be used, and the held-out projections that no trial uses. They have no weights
            from the monitor, because trials are compared with equal weight for all rays.
        truth: the ground truth [z, y, x] on Grid.matching(geometry).
        references: further volumes on the same grid, by method, with which trials are compared.
        regions: int8 [z, y, x], dense and empty regions, see `recon.judgement.regions_of`; None if there are none.
        seed: random seed of all trials.
    """

    views: Views
    truth: F32 | None = None
    references: Mapping[str, F32] = field(default_factory=dict)
    regions: NDArray[np.int8] | None = None
    seed: int = 0

    @property
    def geometry(self) -> Geometry:
        """Geometry of the projections that may be used."""
        return self.views.seen.geometry

    def asked_by(self, trial: MethodTrial) -> TrialRun:
        """The method of a trial, and its projections."""
        if trial.choice is None:
            angles, period = self.geometry.angles, self.geometry.period
            views = self.views.using(parse_views(f"fixed:{trial.views}", angles, period=period))
        else:
            views = averaged(self.views, trial.choice)
        return TrialRun(trial.build(), views, Grid.matching(self.geometry), self.seed)

    def measured(self, trial: MethodTrial, volume: Volume) -> tuple[dict[str, float], list[float]]:
        """Figures of merit of a volume, and the squared residual of each held-out projection."""
        truth = None if self.truth is None else Volume(self.truth, volume.grid)
        judged = judge(volume, self.views, truth)
        figures = {name: value for name, value in judged.figures.items() if name in _JUDGED}
        if (reference := self.references.get(trial.method)) is not None:
            figures["psnr_all"] = metrics.psnr(reference, volume.data)
            figures["ssim_all"] = metrics.ssim3d(reference, volume.data)
        if self.regions is not None:
            figures |= contrast_in(self.regions, volume)
        return figures, [] if judged.held_out is None else judged.held_out.squares.tolist()


def averaged(views: Views, choice: ViewChoice) -> Views:
    """The projections of a row of a study, each the mean of a window of projections.

    As in a longer exposure, the transmissions are averaged and not their logarithms: -log(mean(exp(-p))). The weight of
    a ray is the smallest weight in its window.
    """
    groups = np.array(choice.groups)
    middle = views.using(groups[:, choice.window // 2])
    if choice.window == 1:
        return middle
    angles = views.geometry.angles[groups].mean(axis=1)
    angles.setflags(write=False)
    lines = np.stack([math.log(choice.window) - logsumexp(-views.data[group], axis=0) for group in groups])
    weights = None if views.weights is None else np.stack([views.weights[group].min(axis=0) for group in groups])
    used_views = middle.seen
    return replace(used_views, data=lines, geometry=replace(used_views.geometry, angles=angles), weights=weights)


def run_trial(
    trial: MethodTrial,
    data: TrialScan,
    control: RunControl = _UNWATCHED,
    cpu: Callable[[], float] = time.process_time,
) -> tuple[Outcome, F32 | None]:
    """Reconstruct the volume of a trial and measure it. Returns the outcome, and the volume [z, y, x] (None if the
    trial failed)."""
    try:
        method, views, grid, seed, device = data.asked_by(trial)
        geometry = views.seen.geometry
        trial = replace(trial, views=geometry.n_views)
        warm_up(method, geometry, device=device)  # so that compilation is in no trial's time
        reset_peak_memory()
        before = cpu()
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always", UserWarning)
            in_time = control if trial.seconds_asked is None else control.by(control.now() + trial.seconds_asked)
            result = run_on(method, views, grid, seed, in_time, device)
        cpu_seconds, peak = cpu() - before, peak_memory()  # before measuring, which has needs of its own
        figures, squared = data.measured(trial, result.volume)
    except (ValueError, MemoryError) as error:
        message = str(error) if isinstance(error, ValueError) else user_message(error)
        return Outcome(trial, "failed", message=message), None
    return Outcome(
        trial,
        "done",
        result.seconds,
        peak,
        {name: float(value) for name, value in figures.items()},
        None if result.gaussians is None else result.gaussians.n,
        "; ".join(dict.fromkeys(str(warning.message) for warning in warned)),
        cpu_seconds,
        squared,
    ), result.volume.data
