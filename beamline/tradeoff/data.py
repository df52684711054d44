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
from recon.base.arrays import F32
from recon.base.geometry import Geometry, arrays_of, geometry_of_arrays
from recon.voxels.emission import Emission

_COUNTED = ("counts", "survival", "background")


@dataclass(frozen=True, eq=False)
class Data:
    """What every trial of a trade-off shares.

    Attributes:
        projections, geometry: of the views that may be used.
        held_out: views that no trial uses, and their geometry.
        truth: the volume [z, y, x] on Grid.matching(geometry).
        weights: [view, row, col] of the rays of these views, then of those held out; 0: not measured. None: all alike.
        emission: the counts behind the views that may be used; None: the sample does not emit.
    """

    projections: F32
    geometry: Geometry
    held_out: tuple[F32, Geometry] | None
    truth: F32 | None
    weights: F32 | None = None
    emission: Emission | None = None

    def save(self, path: Path) -> None:
        """As .npz, without pickle.

        Raises:
            DataError: the disk did not take it.
        """
        arrays = {"projections": self.projections, **_geometry_arrays("geometry", self.geometry)}
        if self.held_out is not None:
            arrays |= {"held_out": self.held_out[0], **_geometry_arrays("held_out_geometry", self.held_out[1])}
        if self.truth is not None:
            arrays["truth"] = self.truth
        if self.weights is not None:
            arrays["weights"] = self.weights
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
            return cls(file["projections"], geometry, held, file.get("truth"), file.get("weights"), emission)


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
