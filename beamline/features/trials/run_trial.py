"""The data that all trials of a scan share, and one trial: its reconstruction, and what it measures."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from beamline.core.errors import user_message
from beamline.core.machine import peak_memory, reset_peak_memory
from beamline.features.trials.trial import MethodTrial, Outcome
from beamline.features.trials.view_choices import ViewChoice
from beamline.projections.prepared import PreparedProjections
from beamline.reconstruct.run import run_on
from recon.assess import metrics
from recon.base.arrays import F32
from recon.base.geometry import Geometry
from recon.base.method import RunControl
from recon.base.views import parse_views
from recon.base.volume import Grid, Volume
from recon.judgement import judge
from recon.warm_up import warm_up

_JUDGED = "psnr", "ssim3d", "residual_held_out"


@dataclass(frozen=True, eq=False)
class TrialData:
    """What every trial of a scan shares.

    Attributes:
        prepared: the views that may be used, and those that no trial uses as its views held out, without what the
            monitor says of views: trials are compared by all rays with the same weight.
        truth: the volume [z, y, x] on Grid.matching(geometry).
        references: volumes on the same grid that trials are compared with, in addition to the truth, by method.
        regions: int8 [z, y, x], mask of dense and empty regions, see `metrics.kmeans_mask`; None without contrast.
    """

    prepared: PreparedProjections
    truth: F32 | None
    references: Mapping[str, F32] = field(default_factory=dict)
    regions: NDArray[np.int8] | None = None

    @property
    def geometry(self) -> Geometry:
        """Geometry of the views that may be used."""
        return self.prepared.geometry


def averaged(prepared: PreparedProjections, choice: ViewChoice) -> PreparedProjections:
    """The views of a row of a study, each the mean of a window of views.

    A longer exposure adds light, so the transmissions are averaged, -log(mean(exp(-p))), not the logarithms. A ray
    weighs as the least of its window.
    """
    groups = np.array(choice.groups)
    middle = prepared.of_views(groups[:, choice.window // 2])
    if choice.window == 1:
        return middle
    angles = prepared.geometry.angles[groups].mean(axis=1)
    angles.setflags(write=False)
    geometry, whole = replace(middle.geometry, angles=angles), prepared.projections
    weights: F32 | None = whole.weights
    lines = np.stack([math.log(choice.window) - logsumexp(-whole.data[group], axis=0) for group in groups])
    weights = None if weights is None else np.stack([weights[group].min(axis=0) for group in groups])
    means = replace(middle.projections, data=lines, weights=weights)
    return replace(middle, projections=means, geometry=geometry)


def run_trial(
    trial: MethodTrial,
    data: TrialData,
    seed: int,
    now: Callable[[], float] = time.perf_counter,
    cpu: Callable[[], float] = time.process_time,
) -> tuple[Outcome, F32 | None]:
    """Make a trial's reconstruction and measure it: the outcome, and the volume [z, y, x]; None where it failed."""
    control, grid = RunControl(now=now), Grid.matching(data.geometry)
    try:
        method, prepared = trial.build(), _views_of(trial, data)
        warm_up(method, data.geometry)  # so that compilation is in no trial's time
        reset_peak_memory()
        before = cpu()
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always", UserWarning)
            in_time = control if trial.seconds_asked is None else control.by(now() + trial.seconds_asked)
            result = run_on(method, prepared, grid, seed, in_time)
        cpu_seconds, peak = cpu() - before, peak_memory()  # before measuring, which has needs of its own
        figures, squared = measured(trial.method, result.volume.data, data, grid)
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
        "; ".join(dict.fromkeys(str(one.message) for one in warned)),
        cpu_seconds,
        squared,
    ), result.volume.data


def _views_of(trial: MethodTrial, data: TrialData) -> PreparedProjections:
    if trial.choice is None:
        angles, period = data.geometry.angles, data.geometry.period
        return data.prepared.of_views(parse_views(f"fixed:{trial.views}", angles, period=period))
    return averaged(data.prepared, trial.choice)


def measured(method: str, volume: F32, data: TrialData, grid: Grid) -> tuple[dict[str, float], list[float]]:
    """Figures of the volume [z, y, x], and the squared residual of each view held out."""
    made, truth = Volume(volume, grid), None if data.truth is None else Volume(data.truth, grid)
    judged = judge(made, data.prepared.views, truth, held_out=data.prepared.views_held_out)
    figures = {name: value for name, value in judged.figures.items() if name in _JUDGED}
    if (reference := data.references.get(method)) is not None:
        figures["psnr_all"] = metrics.psnr(reference, volume)
        figures["ssim_all"] = metrics.ssim3d(reference, volume)
    if data.regions is not None:
        figures["snr"], figures["cnr"] = metrics.snr_cnr(metrics.sampled(volume), data.regions)
    return figures, [] if judged.held_out is None else judged.held_out.left.tolist()
