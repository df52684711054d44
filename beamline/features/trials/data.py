"""What all trials of a scan share, and the folder through which their processes get it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.core.files import named_on_failure
from beamline.features.trials.view_choices import ViewChoice
from recon.base.arrays import F32, F64, I64
from recon.base.geometry import Geometry, arrays_of, geometry_of_arrays
from recon.base.method import DataUse, Energies
from recon.prep.emission import Emission, weighted_lines

_COUNTED = ("counts", "survival", "background")
_OPTIONAL = ("truth", "weights", "of_view", "sections", "reference", "regions")
_MAPPED = ("projections", "weights", *(f"emission.{name}" for name in _COUNTED))  # read only as far as they are used

VolumeAt = Callable[[float], F32]
"""The volume [z, y, x] that a view of this time, or of the energy of this number, shows."""
PartFit = Callable[[F32, Geometry, F32 | None], F32]
"""The volume of some views, by line integrals [view, row, col], geometry, and weights of rays."""


@dataclass(frozen=True, eq=False)
class TrialData:
    """What every trial of a scan shares.

    Attributes:
        projections, geometry: of the views that may be used.
        held_out: views that no trial uses, and their geometry.
        truth: the volume [z, y, x] on Grid.matching(geometry).
        weights: [view, row, col] of the rays of these views, then of those held out; 0: not measured. None: all alike.
        emission: the counts behind the views that may be used; None: the sample does not emit.
        of_view: [view] time in s, or number of the energy, of these views, then of those held out; None: all show the
            same volume.
        sections: [energy, material] attenuation of pure materials, 1/mm; None: views have times, or all show the same.
        reference: a volume on the same grid that every trial is compared with, in addition to the truth; or None.
        regions: int8 [z, y, x], mask of dense and empty regions, see `metrics.kmeans_mask`; None without contrast.
    """

    projections: F32
    geometry: Geometry
    held_out: tuple[F32, Geometry] | None
    truth: F32 | None
    weights: F32 | None = None
    emission: Emission | None = None
    of_view: F64 | None = None
    sections: F64 | None = None
    reference: F32 | None = None
    regions: NDArray[np.int8] | None = None

    @property
    def shown(self) -> F64:
        """`of_view`, or 0 for all."""
        n = self.geometry.n_views + (0 if self.held_out is None else self.held_out[1].n_views)
        return np.zeros(n) if self.of_view is None else self.of_view

    @property
    def use(self) -> DataUse:
        """How the views that may be used are used; weights of the views held out stand behind theirs."""
        of_view, n = self.of_view, self.geometry.n_views
        if of_view is None:
            return DataUse(self.weights, emission=self.emission)
        if self.sections is None:
            return DataUse(self.weights, emission=self.emission, times=of_view[:n])
        energies = Energies(of_view[:n].astype(np.intp), self.sections)
        return DataUse(self.weights, emission=self.emission, energies=energies)

    @property
    def rays_held_out(self) -> F32 | None:
        """Weights of the rays of the views held out; None: all alike."""
        return None if self.weights is None else self.weights[self.geometry.n_views :]

    def chosen(self, choice: ViewChoice) -> tuple[F32, Geometry, DataUse]:
        """Line integrals [view, row, col], geometry and use of the views of a choice."""
        groups = choice.groups
        assert groups is not None
        lines, angles = averaged(self.projections, self.geometry.angles, groups)
        angles.setflags(write=False)
        geometry = replace(self.geometry.select(groups[:, choice.window // 2]), angles=angles)
        if self.emission is not None:  # of a window the counts are added
            emission = self.emission.summed(groups, geometry)
            lines, weights = weighted_lines(emission)
            return lines, geometry, DataUse(weights, emission=emission)
        if self.weights is None:
            return lines, geometry, DataUse()
        return lines, geometry, DataUse(np.stack([self.weights[group].min(axis=0) for group in groups]))

    def save(self, folder: Path) -> None:
        """As .npy files in a new folder, without pickle.

        Raises:
            DataError: the disk did not take it.
        """
        arrays = {"projections": self.projections, **_geometry_arrays("geometry", self.geometry)}
        if self.held_out is not None:
            arrays |= {"held_out": self.held_out[0], **_geometry_arrays("held_out_geometry", self.held_out[1])}
        arrays |= {name: value for name in _OPTIONAL if (value := getattr(self, name)) is not None}
        if self.emission is not None:
            arrays |= {f"emission.{name}": v for name in _COUNTED if (v := getattr(self.emission, name)) is not None}
        with named_on_failure(folder):
            folder.mkdir()
        for name, array in arrays.items():
            write_array(folder / f"{name}.npy", array)

    @classmethod
    def load(cls, folder: Path) -> TrialData:
        """What `save` wrote; views and their weights stay in the files until they are used."""
        arrays = {
            path.stem: np.load(path, mmap_mode="r" if path.stem in _MAPPED else None, allow_pickle=False)
            for path in folder.glob("*.npy")
        }
        geometry = geometry_in(folder)
        held = (arrays["held_out"], _geometry("held_out_geometry", folder)) if "held_out" in arrays else None
        counted: dict[str, Any] = {name: arrays.get(f"emission.{name}") for name in _COUNTED}
        emission = None if counted["counts"] is None else Emission(geometry=geometry, **counted)
        optional = {name: arrays.get(name) for name in _OPTIONAL}
        return cls(arrays["projections"], geometry, held, emission=emission, **optional)


def averaged(
    projections: NDArray[np.float32], angles: NDArray[np.float64], groups: I64
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """The views of a row: line integrals [view, row, col] and their mean angles [view].

    A longer exposure adds light, so the transmissions are averaged, -log(mean(exp(-p))), not the logarithms.

    Args:
        projections, angles: of the scan.
        groups: [view, window].
    """
    if groups.shape[1] == 1:
        return np.asarray(projections[groups[:, 0]], np.float32), angles[groups[:, 0]]
    out = np.empty((groups.shape[0], *projections.shape[1:]), np.float32)
    for mean, group in zip(out, groups, strict=True):
        part = np.asarray(projections[group])
        least = part.min(axis=0)  # taken out before the exponential, which would be 0 behind much matter
        mean[:] = least - np.log(np.exp(least - part).mean(axis=0))
    return out, angles[groups].mean(axis=1)


def write_array(path: Path, array: NDArray[Any]) -> None:
    """Write a .npy file. `np.save` of a path loses the last 4 kB where the disk is full, and says nothing.

    Raises:
        DataError: the disk did not take it.
    """
    with named_on_failure(path), path.open("wb") as file:
        np.save(SimpleNamespace(write=file.write), array, allow_pickle=False)


def geometry_in(folder: Path) -> Geometry:
    """The geometry of what `TrialData.save` wrote, without its views."""
    return _geometry("geometry", folder)


def _geometry_arrays(prefix: str, geometry: Geometry) -> dict[str, NDArray[Any]]:
    return {f"{prefix}.{name}": array for name, array in arrays_of(geometry).items()}


def _geometry(prefix: str, folder: Path) -> Geometry:
    return geometry_of_arrays({
        f.name: np.load(folder / f"{prefix}.{f.name}.npy", allow_pickle=False) for f in fields(Geometry)
    })  # fmt: skip


def by_parts(count: int, data: TrialData, fit: PartFit) -> VolumeAt:
    """A volume of each part of the views: of each energy, or of so long, with linear change between their middles."""
    n = data.geometry.n_views
    shown = data.shown[:n]
    if data.sections is None:
        edges = np.arange(count + 1) * n // count
        in_order = np.argsort(shown, kind="stable")
        parts = [np.sort(in_order[first:stop]) for first, stop in pairwise(edges.tolist())]
    else:
        parts = [np.flatnonzero(shown == energy) for energy in range(count)]
    weights = None if data.weights is None else data.weights[:n]
    volumes = np.stack([
        fit(data.projections[at], data.geometry.select(at), None if weights is None else weights[at]) for at in parts
    ])  # fmt: skip
    middles = np.array([shown[at].mean() for at in parts])
    return lambda view: np.tensordot(_linear(view, middles), volumes, 1)


def _linear(at: float, knots: F64) -> F32:
    return np.array([np.interp(at, knots, row) for row in np.eye(knots.size)], np.float32)
