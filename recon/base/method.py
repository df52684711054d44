"""Method: the interface of every reconstruction method, and the values that go in and come out.

A method is a frozen dataclass of its settings, a `Method`. `recon.methods` registers it.
"""

from __future__ import annotations

import json
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
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
from recon.base.volume import Grid, Volume, VolumeSeries

if TYPE_CHECKING:
    from recon.base.view_data import Views

Plain = str | int | float
Clock = Callable[[], float]
_ENDLESS = 10**6  # steps or iterations: a time ends the run long before


@dataclass(frozen=True)
class Progress:
    """State of a running reconstruction, as `RunControl` reports it.

    Attributes:
        step, steps: done and planned, or iterations (0: unknown, as in a fit while views still arrive).
        seconds: since the start, by the caller's clock.
        loss: running mean of the loss, in normalised units.
        residual: running mean of |rendered - measured| / |measured| (root mean squares), over the views just used.
        n_gaussians, n_views: in the model and in the data.
        held_out: ||rendered - measured|| / ||measured|| of views that the fit does not see; NaN without such views.
        unit: name of the steps of a direct method or of a part of the work, such as slices; loss and residual are then
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
"""How `Progress.unit` of trials begins: a search goes on as long as it must, so that few scans take the most."""


SAMPLE = "sample_radius"
"""Name of the decision on the radius, and how the settings begin that state it."""


@dataclass(frozen=True)
class SampleRadius:
    """How far a sample reaches from the rotation axis, where it is wider than the field.

    Attributes:
        radius: that predicts views held out best, or that was given, in mm: half the width of a square box, so that it
            lies between that of a round sample and 0.886 of it, where areas are equal.
        low, high: mm, from which to which radius views are predicted as well but for chance, and a step of the search.
        density: relative uncertainty of the density in the middle: half of what it changes from `low` to `high`.
    """

    radius: float
    low: float
    high: float
    density: float

    @property
    def settings(self) -> dict[str, float]:
        """The values as settings of a result."""
        return {SAMPLE if name == "radius" else f"{SAMPLE}_{name}": value for name, value in asdict(self).items()}


@dataclass(frozen=True, eq=False)
class DataUse(Checked):
    """How the projections are used.

    Attributes:
        weights: of each ray [view, row, col], 0 or more; None: one for all. FBP fills rays of weight 0 from their
            neighbours and takes all others alike.
        held_out: numbers of the views that are not fitted; their residual is in the history.
        times: [view] when each was exposed, in s, for a method of volumes in time; None: evenly, in the order of the
            views.
        sample_radius: how far the sample reaches from the rotation axis, in mm, where it is wider than the field; None:
            that is measured.
    """

    weights: F32 | None = None
    held_out: Sequence[int] = ()
    times: F64 | None = None
    sample_radius: float | SampleRadius | None = None


@dataclass(frozen=True, eq=False)
class RunControl(Checked):
    """How a caller watches, ends and continues a reconstruction.

    Attributes:
        should_stop: asked between steps or iterations; True ends the reconstruction with the volume so far. Direct
            methods do not ask. Any function, or a `Stop`; methods ask `stop`, which is always there.
        on_progress: called about ten times a second, after each iteration, or each sixteen slices of FBP.
        on_checkpoint: gets the checkpoint of a fit every `checkpoint_every` s.
        resume: the checkpoint of a fit with the same data and settings, which is continued.
        decide: keeps the method's decisions by its data, and may follow another run; None: the run decides alone.
        stop_trials: asked after each sweep of the trials that choose a weight of total variation; True ends
            these alone. None: as `should_stop`.
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
        """The request that methods ask between steps: should the run end with the volume so far?"""
        return self.should_stop if isinstance(self.should_stop, Stop) else Stop(self.should_stop or _never)

    @property
    def stop_of_trials(self) -> Callable[[], bool]:
        """The request that trials ask between sweeps."""
        return self.stop_trials or self.stop

    def tell(self, progress: Progress) -> None:
        """Report the progress, where somebody listens."""
        if self.on_progress is not None:
            self.on_progress(progress)

    def report_progress(self, step: int, steps: int, begin: float, n_views: int, unit: str) -> None:
        """Report progress without a residual: of a direct method, or of a part of the work that began at `begin`."""
        if self.on_progress is not None:
            self.on_progress(Progress(step, steps, self.now() - begin, math.nan, math.nan, 0, n_views, unit=unit))

    def by(self, deadline: float) -> RunControl:
        """The same control with a deadline by its clock."""
        return replace(self, should_stop=self.stop.by(deadline, self.now))


def _never() -> bool:
    return False


@dataclass(frozen=True, eq=False)
class ReconProblem:
    """The views and the grid of a reconstruction.

    Attributes:
        views: line integrals, with the weights of their rays.
        use: what else is known of the views, with their weights.
        wide: the grid holds a sample beyond the field.
    """

    views: Views
    grid: Grid
    use: DataUse = DataUse()
    seed: int = 0
    device: str = "cpu"
    wide: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "use", replace(self.use, weights=self.views.weights))

    @property
    def projections(self) -> F32:
        """The line integrals [view, row, col] of the views."""
        return self.views.data

    @property
    def geometry(self) -> Geometry:
        return self.views.geometry


@dataclass(frozen=True)
class Ending:
    """How a reconstruction ended, and the step from which it was resumed.

    Attributes:
        early: it was stopped, and has the volume reached by then.
        resumed_from: file of an earlier run that it continued; empty: it began anew.
        lost_checkpoint: why the last checkpoint could not be written; empty: none was lost.
    """

    early: bool = False
    resumed_from: str = ""
    lost_checkpoint: str = ""


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """A reconstructed volume, with what its method says of itself: what `Method.run` and `recon.reconstruct` return.

    Attributes:
        volume: the attenuation, `volume.data` float32 [z, y, x] in 1/mm.
        settings: every parameter that was used.
        history: the record of the fit or the iterations, empty for a direct method.
        gaussians: the model behind the volume of a fit, a `recon.splatting.gaussians.Gaussians`, which this module
            must not import; None for other methods.
        checkpoint: the state of a fit, which `RunControl.resume` takes; see `checkpoint.arrays_of`.
        method: its name; of a choice (`recon.Auto`), that of the method chosen. `run` may leave it to the caller.
        seconds: wall time of the reconstruction. `run` may leave it to the caller, too, as 0.
        deviation: the standard deviation of each voxel, see `recon.error_bars`; None: not known.
        series: all volumes, the first of which is `volume`; None: the method makes one.
        at: gives the volume [z, y, x] that a view shows, by its time as in `DataUse.times`, or by the number of its
            energy; None: the method makes one volume.
        chosen: how a choice or a preset came to the settings; empty where they were given.
        started_from: Gaussians at the start of a fit; 0 for other methods.
        ending: how it ended, as its caller knows it.
        outside: gives what the sample outside the volume adds to views, [view, row, col] for their geometry; None:
            nothing is known to lie there.
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
        """Write the volume and its settings to the new file `path`, an .npz; `beamline export` takes it further.

        As `Volume.save`, with the arrays `method`, `seconds`, and `settings`, JSON in which NaN and infinities are
        numbers of Python's. Several volumes in time are there, too: `series` float32 [volume, z, y, x] and `series_s`.
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
        """What `save` wrote, or `Volume.save`, which knows neither method nor settings.

        Sequences and arrays among the settings are lists, and what JSON has no type for is text.

        Raises:
            ValueError, KeyError: the file is no .npz, or one of another program.
        """
        if Path(path).exists() and not is_zipfile(path):
            raise ValueError(f"{str(path)!r} is no .npz; expected a file that save wrote")
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
    """A reconstruction method: a frozen dataclass of its settings, and what its callers ask it.

    A method derives from one of the four kinds in `recon.base.method_kinds`, which answer for it.

    Attributes:
        name: in commands, files and events.
        label: in reports.
        takes: what it accepts beside views, grid and seed: device, held_out, times, checkpoints, quality, budget.
        halo: slices beyond a slab that it reconstructs, too, so that the slab's edges do not show.
        error_bars: factors of what refits differ by, and of the gradient, see `recon.error_bars`; None: not calibrated.
        fitted: its volume is fitted to the views step by step: it has a history, and can be stopped.
        weighs: weights of rays count; else rays of weight 0 are filled, and all others count alike.
        needs_matter: it refuses views without matter, such as those of a slab of air.
        knows_outside: it explains views by a box that holds all of a sample wider than the field.
        makes_boxes: it makes any box of voxels as it makes the whole volume.
        volumes: number of volumes that it makes.
        least_views: of each of several volumes.
        allow_negative: voxels below zero are kept.
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
            ValueError: the method does not take these views, settings or data.
        """

    @abstractmethod
    def toy(self) -> Self:
        """The same method with the least work that still runs each of its kernels."""

    @abstractmethod
    def memory(self, geometry: Geometry, grid: Grid, weighted: bool) -> int:
        """Peak memory of `run` in bytes, without the projections, and without their weights if they are `weighted`."""

    def views_wanted(self, geometry: Geometry) -> NDArray[np.bool_]:
        """[view] which of these views it uses.

        Raises:
            ValueError: it takes no such views.
        """
        return np.ones(geometry.n_views, bool)

    @property
    def time_limit(self) -> float | None:
        """Seconds that end a run; None: only its work does."""
        return None

    @property
    def stops_early(self) -> bool:
        """Whether views held out may end a run."""
        return False

    @property
    def trial_sweeps(self) -> int:
        """Sweeps over the views of all trials that choose its prior, as a rule."""
        return 0

    @property
    def alternatives(self) -> tuple[Method, ...]:
        """The methods that it chooses among, the preferred one first; itself if it does not choose."""
        return (self,)

    def device_of(self, problem: ReconProblem) -> str:
        """The device on which it computes this problem."""
        return problem.device if "device" in self.takes else "cpu"

    def for_part(self, share: float, of_time: float) -> Self:
        """The method for this share of a volume, in this share of its seconds."""
        return self

    def with_quality(self, quality: Quality, default_count: int) -> Self:
        """The method with the settings of a preset, for a grid with `default_count` Gaussians by default."""
        return self

    @classmethod
    def ended_by(cls, seconds: float) -> dict[str, Plain]:
        """The settings with which so many seconds, and nothing else, end a run; none where its own length remains."""
        lengths: dict[str, Plain] = {"seconds": seconds, "steps": _ENDLESS, "iterations": _ENDLESS}
        return {name: value for name, value in lengths.items() if name in types_of(cls)}
