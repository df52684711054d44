"""What all trials of a scan share, and the folder through which their processes get it."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.core.files import named_on_failure
from beamline.features.trials.view_choices import ViewChoice
from beamline.projections.prepared import PreparedProjections
from recon.base.arrays import F32, F64, I64
from recon.base.geometry import Geometry
from recon.prep.emission import weighted_lines

VolumeAt = Callable[[float], F32]
"""The volume [z, y, x] that a view of this time, or of the energy of this number, shows."""
_VALUES, _REFERENCE, _REGIONS = "values.pickle", "reference_", "regions.npy"
_SMALL = 4096  # bytes of an array that needs no file of its own


@dataclass(frozen=True, eq=False)
class TrialData:
    """What every trial of a scan shares.

    Attributes:
        prepared: the views that may be used, those that no trial uses as its views held out, and what is known of
            both, without what the monitor says of views: trials are compared by all rays alike.
        truth: the volume [z, y, x] on Grid.matching(geometry).
        shown_held_out: [view] of those held out as `shown` of the others; None: 0.
        references: volumes on the same grid that trials are compared with, in addition to the truth, by method.
        regions: int8 [z, y, x], mask of dense and empty regions, see `metrics.kmeans_mask`; None without contrast.
    """

    prepared: PreparedProjections
    truth: F32 | None
    shown_held_out: F64 | None = None
    references: Mapping[str, F32] = field(default_factory=dict)
    regions: NDArray[np.int8] | None = None

    @property
    def geometry(self) -> Geometry:
        """Of the views that may be used."""
        return self.prepared.geometry

    @property
    def shown(self) -> F64:
        """[view] time in s, or number of the energy, of the views that may be used; 0: all show the same volume."""
        if (energies := self.prepared.energies) is not None:
            return energies.of_view.astype(np.float64)
        return np.zeros(self.geometry.n_views) if self.prepared.times is None else self.prepared.times

    @property
    def rays_held_out(self) -> F32 | None:
        """Weights of the rays of the views held out; None: all alike."""
        held_out = self.prepared.held_out
        rays = None if held_out is None else self.prepared.ray_weights(held_out[1].n_views)
        return None if rays is None else rays[self.geometry.n_views :]

    def save(self, folder: Path) -> None:
        """Into a new folder, each large array in a file of its own.

        Raises:
            DataError: the disk did not take it.
        """
        with named_on_failure(folder):
            folder.mkdir()
        arrays: dict[int, NDArray[Any]] = {}

        def number_of(value: object) -> int | None:
            """Of an array with a file of its own."""
            if not isinstance(value, np.ndarray) or value.nbytes <= _SMALL:
                return None
            arrays[id(value)] = value
            return id(value)

        with named_on_failure(folder / _VALUES), (folder / _VALUES).open("wb") as file:
            pickler = pickle.Pickler(file)
            pickler.persistent_id = number_of  # type: ignore[method-assign]
            pickler.dump(self)
        for number, array in arrays.items():
            write_array(folder / f"{number}.npy", array)

    @classmethod
    def load(cls, folder: Path) -> TrialData:
        """What `save` of the same program wrote; large arrays stay in their files until they are used."""
        with (folder / _VALUES).open("rb") as file:
            unpickler = pickle.Unpickler(file)  # noqa: S301 - written by the process that started this one
            unpickler.persistent_load = lambda number: np.load(folder / f"{number}.npy", mmap_mode="r")  # type: ignore[method-assign]
            data: TrialData = unpickler.load()
        made = {path.stem.removeprefix(_REFERENCE): np.load(path) for path in folder.glob(f"{_REFERENCE}*.npy")}
        regions = folder / _REGIONS  # these were made after the others were saved
        return replace(data, references=made, regions=np.load(regions) if regions.exists() else None)


def write_reference(folder: Path, method: str, volume: F32) -> None:
    """A volume that trials of the method are compared with, beside data that were saved."""
    write_array(folder / f"{_REFERENCE}{method}.npy", volume)


def write_regions(folder: Path, regions: NDArray[np.int8]) -> None:
    """The dense and the empty regions, beside data that were saved."""
    write_array(folder / _REGIONS, regions)


def averaged(prepared: PreparedProjections, choice: ViewChoice) -> PreparedProjections:
    """The views of a row of a study, each the mean of a window of views.

    A longer exposure adds light, so the transmissions are averaged, -log(mean(exp(-p))), not the logarithms. Counts
    of an emission are added. A ray weighs as the least of its window.
    """
    groups = choice.groups
    assert groups is not None
    middle = prepared.of_views(groups[:, choice.window // 2])
    if choice.window == 1 and prepared.emission is None:
        return middle
    angles = prepared.geometry.angles[groups].mean(axis=1)
    angles.setflags(write=False)
    geometry, whole = replace(middle.geometry, angles=angles), prepared.projections
    if prepared.emission is not None:
        emission = prepared.emission.summed(groups, geometry)
        lines, weights = weighted_lines(emission)
        return replace(
            middle,
            projections=replace(middle.projections, data=lines, weights=weights),
            geometry=geometry,
            emission=emission,
        )
    counted = whole.weights
    least = None if counted is None else np.stack([counted[group].min(axis=0) for group in groups])
    means = np.stack([_mean(np.asarray(whole.data[group])) for group in groups])
    return replace(middle, projections=replace(middle.projections, data=means, weights=least), geometry=geometry)


def _mean(views: F32) -> F32:
    """The line integrals [row, col] of the mean transmission of some views [view, row, col]."""
    least = views.min(axis=0)  # taken out before the exponential, which would be 0 behind much matter
    return np.asarray(least - np.log(np.exp(least - views).mean(axis=0)), np.float32)


def write_array(path: Path, array: NDArray[Any]) -> None:
    """Write a .npy file. `np.save` of a path loses the last 4 kB where the disk is full, and says nothing.

    Raises:
        DataError: the disk did not take it.
    """
    with named_on_failure(path), path.open("wb") as file:
        np.save(SimpleNamespace(write=file.write), array, allow_pickle=False)


def by_parts(count: int, data: TrialData, fit: Callable[[PreparedProjections], F32]) -> VolumeAt:
    """A volume of each part of the views: of each energy, or of so long, with linear change between their middles."""
    shown = data.shown
    if data.prepared.energies is None:
        edges = np.arange(count + 1) * shown.size // count
        in_order = np.argsort(shown, kind="stable")
        parts: list[I64] = [np.sort(in_order[first:stop]) for first, stop in pairwise(edges.tolist())]
    else:
        parts = [np.flatnonzero(shown == energy) for energy in range(count)]
    volumes = np.stack([fit(data.prepared.of_views(at)) for at in parts])
    middles = np.array([shown[at].mean() for at in parts])
    return lambda view: np.tensordot(_linear(view, middles), volumes, 1)


def _linear(at: float, knots: F64) -> F32:
    return np.array([np.interp(at, knots, row) for row in np.eye(knots.size)], np.float32)
