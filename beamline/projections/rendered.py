"""Rendered: the line integrals that a volume made of a scan has at an angle, which the monitor compares with views."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.projections.corrections.width import TO_MIDDLE
from beamline.storage import hdf5
from beamline.storage.readers.base import ScanSource
from recon.base.geometry import Geometry
from recon.base.volume import Grid, Volume
from recon.prep.background import surface
from recon.voxels.projector import project

PARAMETERS = "/entry/reconstruction/parameters"
_NOT_RENDERED = {
    "columns": "some columns alone", "view_shifts_px": "displacements", "view_roll_deg": "roll",
    "view_tilt_deg": "tilt", "learnt_background_terms": "a learnt background", "learnt_gains_of_pixels": "learnt gains",
    "exposure_arc_deg": "an exposure's arc",
}  # fmt: skip


def rendered(path: Path, source: ScanSource) -> Callable[[float, int], NDArray[np.float32]]:
    """Of a volume file of `beamline recon` of this scan: (angle in radians, pixels a side of a cell) to means of cells.

    What was taken off all views as the background of the beam is in them.

    Raises:
        DataError: no volume of ours, of a cone beam, or one that is not made of all rows of this scan's frames.
    """
    with hdf5.open_hdf5(path) as file:
        try:
            data = file["/entry/data/data"][()]
            z, y, x = (file[f"/entry/data/{name}"][()] for name in "zyx")
            axis, pitch = (float(file[f"{PARAMETERS}/{name}"][()]) for name in ("axis_col", "pixel_pitch"))
            taken_off = file.get(f"{PARAMETERS}/background_terms")
            terms = None if taken_off is None else taken_off[()]
            to_middle = math.radians(file[PARAMETERS][TO_MIDDLE][()] if TO_MIDDLE in file[PARAMETERS] else 0.0)
            beyond = [what for name, what in _NOT_RENDERED.items() if f"{PARAMETERS}/{name}" in file]
        except KeyError as error:
            raise DataError(
                f"{path} is not a volume of `beamline recon`: {error.args[0]}. No frame was checked."
            ) from None
    if source.cone is not None:
        raise DataError(f"{source.path} is a cone-beam scan; views are compared with volumes of parallel beams only.")
    if source.row_pitch_mm is not None:
        raise DataError(f"{source.path} has pixels that are not square; volumes are compared only with square ones.")
    if beyond:
        raise DataError(
            f"{path} is of views with {' and '.join(beyond)}, which are not rendered here. Reconstruct this scan "
            "without them, to compare its views."
        )
    pixel = source.pixel_size_mm or 1.0
    binning = max(1, round(pitch / pixel))
    rows = source.shape[0] // binning
    if abs(pitch / pixel - binning) > 1e-3 or len(z) != rows:
        raise DataError(
            f"{path} has {len(z)} slices for pixels of {pitch:g}; frames of {source.shape[0]} rows of pixels of "
            f"{pixel:g} need {rows}. Reconstruct all rows of this scan."
        )
    size = float(x[1] - x[0]) if len(x) > 1 else pitch
    centre = tuple(float(axis_[0] + axis_[-1]) / 2 for axis_ in (z, y, x))
    slices = float(z[1] - z[0]) if len(z) > 1 else size
    volume = Volume(np.asarray(data, np.float32), Grid(data.shape, size, centre, slices))  # type: ignore[arg-type]

    def render(angle: float, cell: int) -> NDArray[np.float32]:
        if cell % binning:
            raise DataError(
                f"{path} is binned by {binning}, which does not divide the monitor's cells of {cell} pixels."
            )
        geometry = Geometry.parallel([angle + to_middle], source.shape, pixel_pitch=pixel, axis_col=axis).binned(
            binning
        )
        image = project(volume, geometry)[0]
        if terms is not None:
            image += surface(terms, source.shape, binning)
        k = cell // binning
        rows, cols = (n // k for n in image.shape)
        return image[: rows * k, : cols * k].reshape(rows, k, cols, k).mean(axis=(1, 3))

    return render
