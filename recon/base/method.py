"""Method: the interface of all reconstruction methods, with their input and output values.

A method is a frozen dataclass of its settings, a `Method`. `recon.methods` registers it.
"""

from __future__ import annotations

import json
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self
from zipfile import is_zipfile

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32, F64
from recon.base.choices import Quality
from recon.base.decisions import Decisions, Stop
from recon.base.declared_types import Checked, types_of
from recon.base.geometry import Geometry
from recon.base.greys import html, middle_slices
from recon.base.json_values import plain
from recon.base.reach import SampleRadius
from recon.base.volume import Grid, Volume, VolumeSeries

if TYPE_CHECKING:
    from recon.base.view_data import Views

Plain = str | int | float
Clock = Callable[[], float]
_ENDLESS = 10**6  # number of steps or iterations that a run never reaches, because its time limit ends it before


@dataclass(frozen=True)
class Progress:
    """State of a running reconstruction, as the function `RunControl.on_progress` gets it.

    Attributes:
        step, steps: number of steps or iterations done and planned (planned 0: unknown, for example in a fit during a
            scan).
        seconds: time since the start, by the caller's clock.
        loss: running mean of the loss, in normalised units.
        residual: running mean of |rendered - measured| / |measured| (root mean squares) over the projections that the
            latest steps used.
        n_gaussians, n_views: number of Gaussians in the model and of projections in the data.
        held_out: ||rendered - measured|| / ||measured|| of the held-out projections; NaN if there are none.
        unit: what `step` counts. The text `unit` is empty for fitting steps and iterations. For a direct method or
            other work, `unit` names what is counted, such as "slices", and loss and residual are NaN.
    """

    step: int
    steps: int
    seconds: float
    loss: float
    residual: float
    n_gaussians: int
    n_views: int
    held_out: float = float("nan")
    unit: str = ""


SWEEPS_OF_TRIALS = "sweeps of trials"
"""Beginning of `Progress.unit` during test reconstructions.

The planned number of iterations is the usual number. A search continues as long as necessary, and only few scans need
the largest number.
"""


@dataclass(frozen=True, eq=False)
class DataUse(Checked):
    """How the projections are used.

    FBP interpolates rays of weight 0 from their neighbours, and gives all other rays the same weight.

    Attributes:
        weights: weight of each ray [view, row, col], 0 or more; None: 1 everywhere.
        held_out: numbers of the projections that are not fitted; their residual is in the history.
        times: [view] time of each exposure in s, for a method that makes volumes at several times; None: the exposures
            are evenly spaced in time, in the order of the projections.
        sample_radius: mm from the rotation axis to the edge of a sample that is wider than the field of view; None: it
            is measured.
    """

    weights: F32 | None = None
    held_out: Sequence[int] = ()
    times: F64 | None = None
    sample_radius: float | SampleRadius | None = None


@dataclass(frozen=True, eq=False)
class RunControl(Checked):
    """How a caller follows, stops and resumes a reconstruction.

    If `should_stop` returns True, the reconstruction ends with the volume reached so far. Direct methods do not call
    `should_stop`. Methods call `should_stop` through the property `stop`, which exists even if `should_stop` is None.

    Attributes:
        should_stop: function (or a `Stop`) that is called between steps or iterations.
        on_progress: function that gets the progress: about ten times a second in a fit, after each iteration, or after
            every sixteen slices of FBP.
        on_checkpoint: function that gets the checkpoint of a fit every `checkpoint_every` s.
        resume: checkpoint from which a fit with the same data and settings continues.
        decide: object in which the method records what it decides from its data; if it contains decisions of an earlier
            run, the method repeats these decisions; None: the method decides by itself.
        stop_trials: function that is called after each iteration of the test reconstructions that choose the weight of
            total variation; True ends only the test reconstructions; None: same as `should_stop`.
    """

    should_stop: Callable[[], bool] | None = None
    on_progress: Callable[[Progress], None] | None = None
    on_checkpoint: Callable[[Mapping[str, NDArray[Any]]], None] | None = None
    checkpoint_every: float = 60.0
    resume: Mapping[str, NDArray[Any]] | None = None
    now: Clock = time.perf_counter
    decide: Decisions | None = None
    stop_trials: Callable[[], bool] | None = None

    @property
    def stop(self) -> Stop:
        """The `Stop` that methods call between steps. The `Stop` returns True if the run must end with the volume
        reached so far.
        """
        return self.should_stop if isinstance(self.should_stop, Stop) else Stop(self.should_stop or _never)

    @property
    def stop_of_trials(self) -> Callable[[], bool]:
        """The function that test reconstructions call between iterations. The function returns True if the test
        reconstructions must end.
        """
        return self.stop_trials or self.stop

    def tell(self, progress: Progress) -> None:
        """Report the progress if the caller asked for it."""
        if self.on_progress is not None:
            self.on_progress(progress)

    def report_progress(self, step: int, steps: int, begin: float, n_views: int, unit: str) -> None:
        """Report progress without a residual, for a direct method or for a part of the work. `begin` is the time at
        which the direct method or the part of the work began, in s on the clock of this control."""
        if self.on_progress is not None:
            self.on_progress(Progress(step, steps, self.now() - begin, math.nan, math.nan, 0, n_views, unit=unit))

    def by(self, deadline: float) -> RunControl:
        """This control with a deadline: the run ends when the clock `now` of this control shows `deadline` (s)."""
        return replace(self, should_stop=self.stop.by(deadline, self.now))


def _never() -> bool:
    return False


@dataclass(frozen=True, eq=False)
class ReconProblem:
    """The projections and the grid of a reconstruction.

    Attributes:
        views: line integrals with the weights of their rays.
        use: how the projections are used; its weights and its held-out projections are those of `views`.
    """

    views: Views
    grid: Grid
    use: DataUse = DataUse()
    seed: int = 0
    device: str = "cpu"

    def __post_init__(self) -> None:
        held_out = tuple(self.views.held_out.tolist())
        object.__setattr__(self, "use", replace(self.use, weights=self.views.weights, held_out=held_out))

    @property
    def projections(self) -> F32:
        """The line integrals [view, row, col]."""
        return self.views.data

    @property
    def geometry(self) -> Geometry:
        return self.views.geometry

    @property
    def wide(self) -> bool:
        """True if the sample is known to be wider than the field of view."""
        return self.views.reach is not None and self.views.reach.sample is not None


@dataclass(frozen=True)
class Ending:
    """How a reconstruction ended, and which earlier run it continued.

    Attributes:
        early: True if the reconstruction was stopped before its end. The volume is then the one reached when it
            stopped.
        resumed_from: file of the earlier run that the reconstruction continued; empty: it started from the beginning.
        lost_checkpoint: why the last checkpoint could not be written; empty: none was lost.
    """

    early: bool = False
    resumed_from: str = ""
    lost_checkpoint: str = ""


@dataclass(frozen=True, eq=False)
class Preview:
    """What a method shows of a scan that still runs, see `Method.preview`.

    Attributes:
        volume: the sample so far, [z, y, x] in 1/mm.
        moved: the reference that was moved to it.
        left: norm of what the moved reference leaves of the projections, divided by their norm; 0: it explains all.
    """

    volume: Volume
    moved: Volume
    left: float


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """Result of a reconstruction: the volume and what the method reports about it.

    `recon.reconstruct` and `Method.run` return a `Reconstruction`. `Method.run` may leave `method` empty and `seconds`
    0, because the caller of `run` fills in `method`, `seconds` and `ending`.

    Attributes:
        volume: the attenuation, `volume.data` float32 [z, y, x] in 1/mm.
        settings: every parameter that was used.
        history: progress of the fit or the iterations; empty for a direct method.
        gaussians: the Gaussian model of a fit (a `recon.splatting.gaussians.Gaussians`); None for other methods.
        checkpoint: state of a fit for `RunControl.resume`; see `checkpoint.arrays_of`.
        method: name of the method; for `recon.Auto`, of the chosen method.
        seconds: wall time of the reconstruction in s.
        deviation: standard deviation of each voxel, see `recon.error_bars`; None: not computed.
        series: all volumes of a method that makes several volumes; the first one is also `volume`; None for a method
            that makes one volume.
        at: function that returns the volume [z, y, x] at a time (in s, as in `DataUse.times`), or at an energy, given
            by its number; None for a method that makes one volume.
        chosen: how an automatic choice or a preset found the settings; empty if they were given.
        started_from: number of Gaussians at the start of a fit; 0 for other methods.
        ending: how the run ended.
        outside: function that returns the contribution of the sample outside the volume to the projections of a
            geometry, [view, row, col]; None: no such contribution is known.
        change: the volume minus the reference, after the reference was moved to the position of the volume; None if no
            reference was used.
        displacement: [3, z, y, x] in mm along z, y, x: the position of a point in the reference minus its position in
            the volume; None if no reference was used.
    """

    volume: Volume
    settings: Mapping[str, Any]
    history: Sequence[Progress] = ()
    gaussians: Any = None
    checkpoint: Mapping[str, NDArray[Any]] | None = None
    method: str = ""
    seconds: float = 0.0
    deviation: Volume | None = None
    series: VolumeSeries | None = None
    at: Callable[[float], F32] | None = None
    chosen: str = ""
    started_from: int = 0
    ending: Ending = Ending()
    outside: Callable[[Geometry], F32] | None = None
    change: Volume | None = None
    displacement: F32 | None = None

    def __repr__(self) -> str:
        model = "" if self.gaussians is None else f", {self.gaussians.n} Gaussians"
        return f"Reconstruction({self.method}: {self.volume!r}, {self.seconds:.3g} s{model})"

    def _repr_html_(self) -> str:
        """HTML for a notebook: the volume's middle slices, its method and its settings."""
        pixels, (low, high) = middle_slices(self.volume.data)
        facts = {"result": repr(self)[15:-1], "grey": f"black {low:.4g}, white {high:.4g}"}
        if self.history and math.isfinite(self.history[-1].residual):
            facts["residual"] = f"{self.history[-1].residual:.4g} after {self.history[-1].step} steps"
        return html(f"Reconstruction by {self.method}", pixels, facts)

    def save(self, path: str | Path) -> None:
        """Write the volume and its settings to the new file `path`, an .npz; `beamline export` converts it.

        The file contains the arrays of `Volume.save`, and `method`, `seconds` and `settings`. `settings` is JSON that
        also contains NaN and Infinity, as Python writes them. If there are several volumes in time, the file also
        contains `series` float32 [volume, z, y, x], and `series_s`, the time of each volume in s.
        """
        several = {} if self.series is None else {"series": self.series.data, "series_s": self.series.seconds}
        self.volume.save(
            path,
            method=self.method,
            seconds=self.seconds,
            settings=json.dumps(self.settings, default=plain, allow_nan=True),
            **several,
        )

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a reconstruction from an .npz file that `save` wrote.

        `load` also reads a file of `Volume.save`, which contains no method and no settings; `method` and `settings` of
        the result are then empty. In the settings, `save` stored arrays and sequences as lists, and values without a
        JSON type as text.

        Raises:
            ValueError, KeyError: the file is not an .npz, or another program wrote it.
        """
        if Path(path).exists() and not is_zipfile(path):
            raise ValueError(f"{str(path)!r} is not an .npz file; give a file that save() wrote")
        with np.load(path, allow_pickle=False) as file:
            data, edge, height = file["volume"], float(file["voxel_mm"]), float(file["slice_mm"])
            grid = Grid(data.shape, edge, tuple(file["centre_zyx_mm"]), None if height == edge else height)
            return cls(
                Volume(data, grid),
                json.loads(str(file.get("settings", "{}"))),
                method=str(file.get("method", "")),
                seconds=float(file.get("seconds", 0.0)),
                series=VolumeSeries(file["series_s"], file["series"]) if "series" in file else None,
            )


class Method(Checked, ABC):
    """A reconstruction method: a frozen dataclass of its settings, with the properties that callers need.

    A method derives from one of the four kinds in `recon.base.method_kinds`, which define most of these properties.

    Attributes:
        name: name in commands, files and events.
        label: name in reports.
        takes: what it accepts in addition to projections, grid and seed: device, held_out, times, checkpoints, quality,
            budget, reference.
        halo: number of additional slices that the method reconstructs on each side of a slab, so that the edges of the
            slab are not visible.
        error_bars: factors for the difference of the refits and for the gradient, see `recon.error_bars`. None: the
            error bars of this method are not calibrated.
        fitted: True if the method fits the volume to the projections step by step. Such a method has a history and can
            be stopped.
        weighs: True if the method uses the weights of rays. False: the method interpolates rays of weight 0, and gives
            all other rays the same weight.
        needs_matter: True if the method raises an error for projections without material, for example for a slab of
            air.
        knows_outside: True if the method can reconstruct the full width of a sample that is wider than the field of
            view.
        makes_boxes: True if the method can reconstruct a box of voxels alone, and the voxels are identical to those of
            the whole volume.
        volumes: number of volumes it makes.
        least_views: smallest number of projections for each of several volumes.
        allow_negative: True if voxels below zero are kept.
    """

    name: ClassVar[str]
    label: ClassVar[str]
    takes: ClassVar[frozenset[str]] = frozenset()
    halo: ClassVar[int] = 0
    error_bars: ClassVar[tuple[float, float] | None] = None
    fitted: ClassVar[bool] = True
    weighs: ClassVar[bool] = True
    needs_matter: ClassVar[bool] = False
    knows_outside: ClassVar[bool] = True
    makes_boxes: ClassVar[bool] = False
    least_views: ClassVar[int] = 0
    volumes: int = 1
    allow_negative: bool = False

    @abstractmethod
    def run(self, problem: ReconProblem, control: RunControl) -> Reconstruction:
        """Reconstruct.

        Raises:
            ValueError: the method cannot use these projections, settings or data.
        """

    @abstractmethod
    def toy(self) -> Self:
        """The same method with the least work that still runs all of its kernels."""

    @abstractmethod
    def memory(self, geometry: Geometry, grid: Grid, weighted: bool) -> int:
        """Peak memory of `run` in bytes. It does not include the projections, nor (if `weighted`) their weights."""

    def preview(self, views: Views) -> Preview | None:
        """What the method can show of a scan that still runs, from the projections so far; None: nothing."""
        return None

    def views_wanted(self, geometry: Geometry) -> NDArray[np.bool_]:
        """[view] True for each projection that the method uses.

        Raises: ValueError: the method cannot use such projections.
        """
        return np.ones(geometry.n_views, bool)

    @property
    def time_limit(self) -> float | None:
        """Time limit of a run in seconds; None: the run ends when its work is done."""
        return None

    @property
    def stops_early(self) -> bool:
        """Whether held-out projections may end a run early."""
        return False

    @property
    def trial_sweeps(self) -> int:
        """Usual number of iterations of all test reconstructions that choose the regularisation weight of the
        method."""
        return 0

    @property
    def costs_little(self) -> bool:
        """Whether the method, which is tried after total variation, takes at most about three times as long."""
        return False

    @property
    def alternatives(self) -> tuple[Method, ...]:
        """The methods from which this method chooses, the preferred one first. A method that does not choose returns
        only itself."""
        return (self,)

    def device_of(self, problem: ReconProblem) -> str:
        """The device on which the method solves this problem."""
        return problem.device if "device" in self.takes else "cpu"

    def for_part(self, share: float, of_time: float) -> Self:
        """The method for a part of a volume. `share` is the fraction of the volume, `of_time` the fraction of the time
        limit."""
        return self

    def at_height(self, above: float) -> Self:
        """The method for a part of a volume whose z = 0 lies `above` mm over that of the whole volume."""
        return self

    def with_quality(self, quality: Quality, default_count: int) -> Self:
        """The method with the settings of a preset. `default_count` is the default number of Gaussians for the grid."""
        return self

    @classmethod
    def ended_by(cls, seconds: float) -> dict[str, Plain]:
        """Settings with which a run ends only after `seconds`. Empty if the method cannot use a time limit."""
        lengths: dict[str, Plain] = {"seconds": seconds, "steps": _ENDLESS, "iterations": _ENDLESS}
        return {name: value for name, value in lengths.items() if name in types_of(cls)}
