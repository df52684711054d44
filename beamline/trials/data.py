"""What all trials of a trade-off share, and the file through which their processes get it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.core.files import named_on_failure
from recon.base.arrays import F32, F64
from recon.base.geometry import Geometry, arrays_of, geometry_of_arrays
from recon.voxels.emission import Emission

_COUNTED = ("counts", "survival", "background")
_OPTIONAL = ("truth", "weights", "of_view", "sections")


@dataclass(frozen=True, eq=False)
class Data:
    """What every trial of a trade-off shares.

    Attributes:
        projections, geometry: of the views that may be used.
        held_out: views that no trial uses, and their geometry.
        truth: the volume [z, y, x] on Grid.matching(geometry).
        weights: [view, row, col] of the rays of these views, then of those held out; 0: not measured. None: all alike.
        emission: the counts behind the views that may be used; None: the sample does not emit.
        of_view: [view] time in s, or number of the energy, of these views, then of those held out; None: all show the
            same volume.
        sections: [energy, material] attenuation of pure materials, 1/mm; None: views have times, or all show the same.
        states: numbers of two materials that are states of one; empty: there are none.
    """

    projections: F32
    geometry: Geometry
    held_out: tuple[F32, Geometry] | None
    truth: F32 | None
    weights: F32 | None = None
    emission: Emission | None = None
    of_view: F64 | None = None
    sections: F64 | None = None
    states: tuple[int, ...] = ()

    @property
    def shown(self) -> F64:
        """`of_view`, or 0 for all."""
        n = self.geometry.n_views + (0 if self.held_out is None else self.held_out[1].n_views)
        return np.zeros(n) if self.of_view is None else self.of_view

    @property
    def rays_held_out(self) -> F32 | None:
        """Weights of the rays of the views held out; None: all alike."""
        return None if self.weights is None else self.weights[self.geometry.n_views :]

    def save(self, path: Path) -> None:
        """As .npz, without pickle.

        Raises:
            DataError: the disk did not take it.
        """
        arrays = {"projections": self.projections, **_geometry_arrays("geometry", self.geometry)}
        if self.held_out is not None:
            arrays |= {"held_out": self.held_out[0], **_geometry_arrays("held_out_geometry", self.held_out[1])}
        arrays |= {name: value for name in _OPTIONAL if (value := getattr(self, name)) is not None}
        arrays["states"] = np.array(self.states, np.intp)
        if self.emission is not None:
            arrays |= {f"emission.{name}": v for name in _COUNTED if (v := getattr(self.emission, name)) is not None}
        with named_on_failure(path):
            np.savez(path, allow_pickle=False, **arrays)

    @classmethod
    def load(cls, path: Path) -> Data:
        with np.load(path, allow_pickle=False) as file:
            geometry = _geometry("geometry", file)
            held = (file["held_out"], _geometry("held_out_geometry", file)) if "held_out" in file else None
            counted = {name: file.get(f"emission.{name}") for name in _COUNTED}
            emission = None if counted["counts"] is None else Emission(geometry=geometry, **counted)
            optional = {name: file.get(name) for name in _OPTIONAL}
            states = tuple(file["states"].tolist())
            return cls(file["projections"], geometry, held, emission=emission, states=states, **optional)


def write_array(path: Path, array: F32) -> None:
    """Write a .npy file. `np.save` of a path loses the last 4 kB where the disk is full, and says nothing.

    Raises:
        DataError: the disk did not take it.
    """
    with named_on_failure(path), path.open("wb") as file:
        np.save(SimpleNamespace(write=file.write), array, allow_pickle=False)


def geometry_in(path: Path) -> Geometry:
    """The geometry of what `Data.save` left, without its views."""
    with np.load(path, allow_pickle=False) as file:
        return _geometry("geometry", file)


def _geometry_arrays(prefix: str, geometry: Geometry) -> dict[str, NDArray[Any]]:
    return {f"{prefix}.{name}": array for name, array in arrays_of(geometry).items()}


def _geometry(prefix: str, arrays: Mapping[str, NDArray[Any]]) -> Geometry:
    return geometry_of_arrays({f.name: arrays[f"{prefix}.{f.name}"] for f in fields(Geometry)})
