"""Reads the Gaussians behind a volume from its file."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from beamline.core.errors import DataError
from beamline.storage import hdf5
from beamline.storage.recon_record import ReconRecord
from beamline.storage.writers.recon_file import opened_reconstruction
from recon.base.geometry import Geometry
from recon.base.kernel import Kernel
from recon.splatting.gaussians import Gaussians


@dataclass(frozen=True, eq=False)
class Model:
    """Gaussians and the projections to which they were fitted.

    Attributes:
        gaussians: the Gaussians, with lengths in `length_unit`.
        geometry: geometry of these projections, in the same unit.
        record: record of the volume that was made from the Gaussians; its voxels are not read.
    """

    gaussians: Gaussians
    geometry: Geometry
    record: ReconRecord


def read_model(path: Path) -> Model:
    """The model in a reconstruction file.

    Raises:
        DataError: the file contains no Gaussians, or it cannot be read.
    """
    with opened_reconstruction(path) as record, hdf5.readable(path):
        arrays = record.model
        if not arrays:
            raise DataError(
                f"{path} contains no Gaussians: {record.parameters.get('method', 'its method')} does not use "
                "Gaussians, or the volume was made in slabs. Expected a volume that r2 made in one piece. Nothing "
                "was written."
            )
        rows, cols = (int(n) for n in arrays["detector_shape"])
        sod, sdd = (float(d) for d in arrays["source_distances"])
        axis_col, axis_row = (float(a) for a in arrays["axis"])
        geometry = Geometry(
            arrays["view_angles"], (rows, cols), float(arrays["pixel_pitch"]), axis_col, axis_row, sod, sdd,
            arrays["view_shifts"], arrays["view_roll"], arrays["view_tilt"],
            centres=arrays.get("view_centres", np.zeros((0, 3))),
        )  # fmt: skip
        gaussians = Gaussians.from_physical(
            arrays["centres"], arrays["widths"], arrays["densities"], arrays["rotations"],
            float(arrays["density_unit"]), Kernel(str(arrays["kernel"])),
        )  # fmt: skip
        # The error bars belong to the voxels in the file, which is closed at the end of this function.
        return Model(gaussians, geometry, replace(record, deviation=None))
