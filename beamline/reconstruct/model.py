"""The Gaussians behind a volume, as its file keeps them."""

from __future__ import annotations

from typing import Any

import numpy as np

from recon.base.geometry import Geometry
from recon.splatting.gaussians import Gaussians


def arrays_of_model(gaussians: Gaussians, geometry: Geometry) -> dict[str, Any]:
    """The arrays of a model for a file, by name: physical values, so that no other program needs our parameters."""
    return {
        "kernel": gaussians.kernel.value,
        "density_unit": gaussians.density_unit,
        **gaussians.physical(),
        "view_angles": geometry.angles,
        "view_shifts": geometry.shifts,
        "view_roll": geometry.roll,
        "view_tilt": geometry.tilt,
        **({"view_centres": geometry.centres} if geometry.centres.any() else {}),
        "detector_shape": np.array(geometry.detector_shape),
        "pixel_pitch": geometry.pixel_pitch,
        "axis": np.array([geometry.axis_col, geometry.axis_row]),
        "source_distances": np.array([geometry.sod, geometry.sdd]),
    }
