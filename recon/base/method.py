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
_ENDLESS = 10**6  # steps or iterations; a time limit ends the run long before


@dataclass(frozen=True)
class Progress:
    """State of a running reconstruction, as `RunControl` reports it.

    Attributes:
        step, steps: number of steps or iterations done and planned (planned 0: unknown, for example in a fit during a
            scan).
        seconds: time since the start, by the caller's clock.
        loss: running mean of the loss, in normalised units.
        residual: running mean of |rendered - measured| / |measured| (root mean squares) over the projections just used.
        n_gaussians, n_views: number of Gaussians in the model and of projections in the data.
        held_out: ||rendered - measured|| / ||measured|| of the held-out projections; NaN if there are none.
        unit: what is counted by a direct method, or in a part of the work, such as "slices"; empty: fitting steps or
        iterations. If it is not empty, loss and residual are
            NaN.
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

The planned number is the usual one. A search continues as long as necessary, and few scans take the largest number.
"""


@dataclass(frozen=True, eq=False)
class DataUse(Checked):
    """How the projections are used.

    Attributes:
        weights: weight of each ray [view, row, col], 0 or more; None: 1 everywhere. FBP interpolates rays of weight 0
            from their neighbours and treats all other rays equally.
        held_out: numbers of the projections that are not fitted; their residual is in the history.
        times: [view] time of each exposure in s, for a method that makes volumes in time; None: evenly spaced, in the
            order of the projections.
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

    Attributes:
        should_stop: function that is called between steps or iterations; True ends the reconstruction with the volume
            so far. Direct methods do not call `should_stop`. It may be any function or a `Stop`. Methods call the
            property `stop`, which exists also if this is None.
        on_progress: called about ten times a second, after each iteration, or after every sixteen slices of FBP.
        on_checkpoint: called with the checkpoint of a fit every `checkpoint_every` s.
        resume: checkpoint from which a fit with the same data and settings continues.
        decide: keeps the decisions that the method derives from its data, and can make the method repeat the decisions
            of another run; None: the method decides by itself.
        stop_trials: function that is called after each iteration of the test reconstructions that choose the weight of
            total variation; True ends only these. None: same as `should_stop`.
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
        """The `Stop` that methods call between steps. It returns True if the run must end with the volume so far."""
        return self.should_stop if isinstance(self.should_stop, Stop) else Stop(self.should_stop or _never)

    @property
    def stop_of_trials(self) -> Callable[[], bool]:
        """The function that test reconstructions call between iterations. It returns True if they must end."""
        return self.stop_trials or self.stop

    def tell(self, progress: Progress) -> None:
        """Report the progress if the caller asked for it."""
        if self.on_progress is not None:
            self.on_progress(progress)

    def report_progress(self, step: int, steps: int, begin: float, n_views: int, unit: str) -> None:
        """Report progress without a residual, for a direct method or a part of the work that began at `begin`."""
        if self.on_progress is not None:
            self.on_progress(Progress(step, steps, self.now() - begin, math.nan, math.nan, 0, n_views, unit=unit))

    def by(self, deadline: float) -> RunControl:
        """The same control with a deadline in s of its clock."""
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
    """How a reconstruction ended, and the step from which it was resumed.

    Attributes:
        early: True if it was stopped; the volume is the one reached by then.
        resumed_from: file of the earlier run that it continued; empty: it started from the beginning.
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

    `recon.reconstruct` and `Method.run` return it.

    Attributes:
        volume: the attenuation, `volume.data` float32 [z, y, x] in 1/mm.
        settings: every parameter that was used.
        history: progress of the fit or the iterations; empty for a direct method.
        gaussians: the Gaussian model of a fit, a `recon.splatting.gaussians.Gaussians` (this module must not import
            it); None for other methods.
        checkpoint: state of a fit for `RunControl.resume`; see `checkpoint.arrays_of`.
        method: name of the method; for `recon.Auto`, of the chosen method. `run` may leave it empty for the caller to
            fill in.
        seconds: wall time of the reconstruction. `run` may leave it 0 for the caller to fill in.
        deviation: standard deviation of each voxel, see `recon.error_bars`; None: not computed.
        series: all volumes of a method that makes several; the first one is `volume`. None: the method makes one.
        at: function that returns the volume [z, y, x] for the time of a projection (as in `DataUse.times`) or the
            number of its energy; None: the method makes one volume.
        chosen: how an automatic choice or a preset found the settings; empty if they were given.
        started_from: number of Gaussians at the start of a fit; 0 for other methods.
        ending: how the run ended; the caller fills it in.
        outside: function that returns the contribution of the sample outside the volume to the projections of a
            geometry, [view, row, col]; None: no such contribution is known.
        change: the volume minus a reference that was moved to it; None: no reference was used.
        displacement: [3, z, y, x] in mm along z, y, x: the place in the reference minus that in the volume; None: as
            `change`.
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
        also contains NaN and Infinity, as Python writes them. If there are several volumes in time, it also contains
        `series` float32 [volume, z, y, x] and `series_s`.
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
        """Read a file of `save`, or of `Volume.save` (which stores neither method nor settings).

        Sequences and arrays among the settings become lists. Values that JSON has no type for become text.

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
        halo: number of slices around a slab that it also reconstructs, so that the edges of the slab are not visible.
        error_bars: factors for the difference of the refits and for the gradient, see `recon.error_bars`; None: not
            calibrated.
        fitted: True if it fits the volume to the projections step by step; then it has a history and can be stopped.
        weighs: True if it uses the weights of rays. If False, rays of weight 0 are interpolated and all others count
            equally.
        needs_matter: True if it raises an error for projections without material, such as those of a slab of air.
        knows_outside: True if it can use a box that contains all of a sample wider than the field of view.
        makes_boxes: True if a box of voxels that it makes is identical to that part of the whole volume.
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
        """Peak memory of `run` in bytes, without the projections and (if `weighted`) without their weights."""

    def preview(self, views: Views) -> Preview | None:
        """What the method can show of a scan that still runs, from the projections so far; None: nothing."""
        return None

    def views_wanted(self, geometry: Geometry) -> NDArray[np.bool_]:
        """[view] True for the projections it uses.

        Raises:
            ValueError: it cannot use such projections.
        """
        return np.ones(geometry.n_views, bool)

    @property
    def time_limit(self) -> float | None:
        """Time limit of a run in seconds; None: it ends when its work is done."""
        return None

    @property
    def stops_early(self) -> bool:
        """Whether held-out projections may end a run early."""
        return False

    @property
    def trial_sweeps(self) -> int:
        """Usual number of iterations, over all test reconstructions that choose its regularisation weight."""
        return 0

    @property
    def alternatives(self) -> tuple[Method, ...]:
        """The methods from which it chooses, the preferred one first; the method itself if it does not choose."""
        return (self,)

    def device_of(self, problem: ReconProblem) -> str:
        """The device on which it solves this problem."""
        return problem.device if "device" in self.takes else "cpu"

    def for_part(self, share: float, of_time: float) -> Self:
        """The method for a part of a volume: `share` of the volume in `of_time` of its seconds."""
        return self

    def with_quality(self, quality: Quality, default_count: int) -> Self:
        """The method with the settings of a preset, for a grid with `default_count` Gaussians by default."""
        return self

    @classmethod
    def ended_by(cls, seconds: float) -> dict[str, Plain]:
        """Settings with which only a time limit of `seconds` ends a run; empty if the method ends by itself."""
        lengths: dict[str, Plain] = {"seconds": seconds, "steps": _ENDLESS, "iterations": _ENDLESS}
        return {name: value for name, value in lengths.items() if name in types_of(cls)}
