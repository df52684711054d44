"""ReconRecord: all facts about a volume. They are the same in its file, in the event `done` and in scripts."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.core.quantities import VoxelKind
from recon.base.method import Ending
from recon.base.volume import Grid, Volume, VolumeSeries

Value = str | int | float | bool | NDArray[Any]
_ENDS = {"ended_early": "early", "resumed_from": "resumed_from", "checkpoint_lost": "lost_checkpoint"}
"""Names of the parameters that state how a reconstruction ended, and of the fields of `Ending`."""


@dataclass(frozen=True, eq=False)
class VoxelsInFile:
    """float32 voxels, [z, y, x] or [volume, z, y, x], that are in files and not in memory. `read` loads a part when it
    is needed.
    """

    shape: tuple[int, ...]
    read: Callable[[Any], NDArray[np.float32]]

    @property
    def dtype(self) -> np.dtype[np.float32]:
        return np.dtype(np.float32)

    def __getitem__(self, part: Any) -> NDArray[np.float32]:
        return self.read(part)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        return np.asarray(self[:], dtype)


class VolumeField:
    """A field of a dataclass for a volume. Voxels in a file are read when the field is first used."""

    def __get__(self, record: Any, owner: type | None = None) -> Volume:
        if record is None:
            raise AttributeError("a field without a default")
        held: Volume = record.__dict__["volume"]
        if isinstance(held.data, VoxelsInFile):
            held = record.__dict__["volume"] = replace(held, data=held.data[:])
        return held

    def __set__(self, record: Any, volume: Volume) -> None:
        record.__dict__["volume"] = volume


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class ReconRecord:
    """The record of a volume: its method, settings, data, figures of merit and files.

    The same values are in the file of the volume, in the event `done` and in the results of `beamline.api`.

    Attributes:
        volume: `volume.data` float32 [z, y, x]. For an open file, it is a dataset that can be sliced along z. For a
            file that was just written, it is read when it is first used.
        length_unit: "mm" if the pixel size is known, otherwise "px".
        raw_file: name of the scan it was made from.
        time: time at which the volume was made, in s since the Unix epoch.
        parameters: every setting used, by name; numbers, strings and arrays.
        metrics: figures of merit, by name.
        history: equally long arrays, by name (step, seconds, loss ...); empty if there are no steps.
        deviation: float32 [z, y, x], standard deviation of each voxel, in the unit of the volume; None: not known.
        series: all volumes, if `volume` is one of several; None: it is the only one.
        change: float32 [z, y, x], the volume minus the reference, after the reference was moved to the position of the
            volume; None: no reference was used.
        displacement: float32 [3, z, y, x] along z, y, x in `length_unit`: position of a point in the reference minus
            its position in the volume; None: no reference was used.
        kind: the quantity of the voxels.
        model: the Gaussians behind the volume and the geometry of their projections (`record.arrays_of_model`); empty:
            there is no model.
        compared: figures of merit of FBP from the same projections; None: not computed. This attribute and the
            following ones exist only for a volume that was just reconstructed; files do not contain them.
        warnings: sentences.
        hiding: the warning that the volume may hide details; empty: there is no such warning.
        chosen: how `auto` or a preset found the settings; empty if the settings were given.
        output, report: paths of the volume and of its report; None: not written.
        elapsed, times: total time in s, and time of each phase in s.
    """

    volume: VolumeField = VolumeField()
    length_unit: str
    raw_file: str
    title: str
    sample: str
    time: float
    parameters: Mapping[str, Value]
    metrics: Mapping[str, float] = field(default_factory=dict)
    history: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    model: Mapping[str, Any] = field(default_factory=dict)
    deviation: NDArray[np.float32] | None = None
    change: NDArray[np.float32] | None = None
    displacement: NDArray[np.float32] | None = None
    kind: VoxelKind = VoxelKind.ATTENUATION
    series: VolumeSeries | None = None
    compared: Mapping[str, float] | None = None
    warnings: Sequence[str] = ()
    hiding: str = ""
    chosen: str = ""
    output: Path | None = None
    report: Path | None = None
    elapsed: float = math.nan
    times: Mapping[str, float] = field(default_factory=dict)

    @property
    def grid(self) -> Grid:
        """Grid of the volume, without reading its voxels."""
        held: Volume = self.__dict__["volume"]
        return held.grid

    @property
    def unit(self) -> str:
        """Unit of the voxels; empty for fractions."""
        return self.kind.unit(self.length_unit)

    @property
    def method(self) -> str:
        """Name of the method; for `auto`, of the chosen method. Empty for a file of another program."""
        return str(self.parameters.get("method", ""))

    @property
    def axis_col(self) -> float:
        """Rotation axis in columns of the full detector; NaN if no file states it."""
        return float(self.parameters.get("axis_col", math.nan))

    @property
    def ending(self) -> Ending:
        """How the reconstruction ended, from its parameters."""
        early, *others = (self.parameters.get(name, "") for name in _ENDS)
        return Ending(bool(early), *map(str, others))

    @property
    def ended_early(self) -> bool:
        """True if the reconstruction was stopped before its end."""
        return self.ending.early

    @property
    def seconds_of_volumes(self) -> tuple[float, ...]:
        """Time of each volume of a series, in s after the first projection. Empty if there is only one volume."""
        return () if self.series is None else tuple(self.series.seconds.tolist())

    @property
    def figures(self) -> Mapping[str, float]:
        """Figures of merit: the same as `metrics`, under the name that scripts use."""
        return self.metrics

    @property
    def settings(self) -> Mapping[str, Value]:
        """Settings: the same as `parameters`, under the name that scripts use."""
        return self.parameters

    @property
    def units(self) -> str:
        """Unit of the voxels: the same as `unit`, under the name that scripts use."""
        return self.unit

    def __repr__(self) -> str:
        return f"ReconRecord({self.method}: {' x '.join(map(str, self.grid.shape))} voxels, {self.output})"

    def _repr_html_(self) -> str:
        """HTML for a notebook: the figures of merit and the middle slices of the volume."""
        figures = ", ".join(f"{name} {value:.4g}" for name, value in self.metrics.items())
        return f"<p>{self.method}: {figures}</p>{self.volume._repr_html_()}"

    def event_values(self) -> dict[str, Any]:
        """The values of the event `done` by name, in the order in which the event lists them."""
        others = {
            "times_s": self.seconds_of_volumes or None,
            "hiding": self.hiding or None,
            "chosen": self.chosen or None,
            "fbp": self.compared,
        }
        return {
            "output": self.output,
            "report": self.report,
            "method": self.method,
            "axis_col": self.axis_col,
            "n_views": self.parameters.get("n_views"),
            "shape": self.grid.shape if self.series is None else self.series.data.shape,
            "units": self.unit,
            "elapsed": self.elapsed,
            "times": self.times,
            **self.metrics,
            **recorded_ending(self.ending),
            **{name: value for name, value in others.items() if value is not None},
        }


def recorded_ending(ending: Ending) -> dict[str, Value]:
    """The parameters that state how a reconstruction ended. Empty for a reconstruction that was resumed and then
    completed.
    """
    return {name: value for name, field in _ENDS.items() if (value := getattr(ending, field))}
