"""Truncation: the warning of a sample that goes on beyond the edges of the field, which no view sees whole."""

from __future__ import annotations

from collections.abc import Mapping

from beamline.monitor.field import beyond_the_field
from recon.base.arrays import F32
from recon.base.geometry import Geometry
from recon.voxels.field_edges import FieldEdges


def cut_sides(data: F32, geometry: Geometry) -> dict[str, float]:
    """Line integral at each edge beyond which the sample goes on, see `recon.voxels.field_edges`."""
    return FieldEdges.of(data, geometry).beyond()


def passing_sentence(ranges: Mapping[str, tuple[int, int]], n_views: int) -> str:
    """A warning for `FieldEdges.passing`."""
    words = " and ".join(f"at the {side} edge in views {first} to {last}" for side, (first, last) in ranges.items())
    return (
        f"Matter leaves the field {words} of {n_views}, and all of it is inside in others: the sample, or a part of "
        "it, stands beside the rotation axis. What lies farther from the axis than the edge is not reconstructed, and "
        "the rim is uncertain. Centre the sample on the axis, or move the camera until the axis is near its edge and "
        "take a full turn."
    )


def cut_sentence(sides: dict[str, float]) -> str:
    """A warning for `cut_sides`."""
    return (
        f"{beyond_the_field(sides)} What lies outside is not seen by all views: values inside are relative, not "
        "absolute, and those at the rim are uncertain. FBP continues the views smoothly beyond the edge; the edge "
        "columns are not used as air. If they are air, and the beam is weaker than its flats, give --air columns."
    )
