"""Truncation: a sample that goes on beyond the edges of the field, which no view sees whole."""

from __future__ import annotations

import numpy as np

from beamline.monitor.field import FieldOfViewCheck, beyond_the_field
from recon.base.arrays import F32
from recon.base.geometry import Geometry
from recon.voxels.view_weights import covers_the_circle

_VIEWS, _PARTS, _COLUMNS = 32, 4, 3  # views looked at, parts of them, and columns
_SHARE = 0.1  # of the depth in the middle


def cut_sides(data: F32, geometry: Geometry) -> dict[str, float]:
    """Line integral at each edge ("left", "right") beyond which the sample goes on; empty where it is in the field.

    The median over views and rows is asked, in each quarter of the scan: corners at some angles do not count. It
    must be more than the default limit of the monitor's check `field`, which asks the same of each view while it comes,
    and than a tenth of what is in the middle. A full turn about an axis off the middle is cut near the axis on purpose;
    the other half turn sees what is there. [`recon.prep.air.edge_depth` asks before, of views whose beam may have
    drifted, whether columns that look like air are a sample]

    Args:
        data: line integrals [view, row, col].
    """
    n, cols = len(data), data.shape[2]
    if n == 0 or cols < 2 * _COLUMNS:
        return {}
    some = np.unique(np.linspace(0, n - 1, min(n, _VIEWS)).round().astype(int)).tolist()
    edges = {
        "left": np.stack([data[view, :, :_COLUMNS] for view in some]),
        "right": np.stack([data[view, :, -_COLUMNS:] for view in some]),
    }
    if geometry.is_off_middle and covers_the_circle(geometry.angles):
        far = "right" if geometry.axis_col < (cols - 1) / 2 else "left"
        edges = {far: edges[far]}
    depth = float(np.median([data[view].max(axis=1) for view in some]))
    levels = {  # a beam drifts away from its flats; a sample is there from the first to the last view
        side: min(float(np.median(part)) for part in np.array_split(values, min(_PARTS, len(values))))
        for side, values in edges.items()
    }
    return {side: level for side, level in levels.items() if level > max(FieldOfViewCheck.edge, _SHARE * depth)}


def cut_sentence(sides: dict[str, float]) -> str:
    """A warning for `cut_sides`."""
    return (
        f"{beyond_the_field(sides)} What lies outside is not seen by all views: values inside are relative, not "
        "absolute, and those at the rim are uncertain. FBP continues the views smoothly beyond the edge; the edge "
        "columns are not used as air. If they are air, and the beam is weaker than its flats, give --air columns."
    )
