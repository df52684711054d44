"""Placement of projections: position of the rotation axis on the detector, and shift, roll and tilt, with checks."""

from __future__ import annotations

import operator
from typing import Any, TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike

from recon.base.arrays import F64, frozen
from recon.base.declared_types import check_arguments

# mm, from far below an atom to 1000 km; in this range float32 can represent the results
_SHORTEST, LONGEST = 1e-12, 1e9


class Where(TypedDict, total=False):
    """Position of the rotation axis on the detector, and pose of each projection. The names are those of the attributes
    of `Geometry`.

    Attributes:
        axis_col, axis_row: None or left out: the middle of the detector, (cols - 1) / 2 and (rows - 1) / 2.
        shifts: [view, 2] pixels; None or left out: no projection is shifted.
        roll, tilt: radians, one value for all projections or [view]; left out: 0.
    """

    axis_col: float | None
    axis_row: float | None
    shifts: ArrayLike | None
    roll: ArrayLike
    tilt: ArrayLike


def placed_views(
    angles: ArrayLike, detector_shape: tuple[int, int], pixel_pitch: float, **where: Unpack[Where]
) -> dict[str, Any]:
    """The attributes of a `Geometry` for these projections, except the distances of the source.

    Raises:
        TypeError: a keyword that `Where` does not have.
        ValueError: there are no angles, the detector is empty, the pitch is not positive, or a value is not finite.
    """
    if unknown_names := where.keys() - Where.__annotations__.keys():
        raise TypeError(
            f"unknown geometry arguments: {', '.join(sorted(unknown_names))}; known are "
            f"{', '.join(Where.__annotations__)}"
        )
    check_arguments(Where, where)
    axis_col, axis_row, shifts = where.get("axis_col"), where.get("axis_row"), where.get("shifts")
    theta = checked_angles(angles)
    rows, cols = (operator.index(n) for n in detector_shape)
    if rows < 1 or cols < 1:
        raise ValueError(f"detector_shape must be (rows, cols) >= 1, got {(rows, cols)}")
    if not _SHORTEST <= pixel_pitch <= LONGEST:
        raise ValueError(f"pixel_pitch must be {_SHORTEST:g} to {LONGEST:g} mm, got {pixel_pitch}")
    col = (cols - 1) / 2 if axis_col is None else float(axis_col)
    row = (rows - 1) / 2 if axis_row is None else float(axis_row)
    for name, value in (("axis_col", col), ("axis_row", row)):
        if not np.isfinite(value):
            raise ValueError(f"{name} must be finite, got {value}")
    shifts_of_views = np.zeros((theta.size, 2)) if shifts is None else np.asarray(shifts, np.float64)
    if shifts_of_views.shape != (theta.size, 2) or not np.isfinite(shifts_of_views).all():
        raise ValueError(
            f"shifts must be finite, in pixels (col, row), with shape [{theta.size}, 2], got shape "
            f"{shifts_of_views.shape}"
        )
    roll, tilt = (_checked_turns(name, where.get(name, 0.0), theta.size) for name in ("roll", "tilt"))
    return {
        "angles": frozen(theta), "detector_shape": (rows, cols), "pixel_pitch": float(pixel_pitch),
        "axis_col": col, "axis_row": row, "shifts": frozen(shifts_of_views), "roll": roll, "tilt": tilt,
    }  # fmt: skip


def checked_angles(angles: ArrayLike) -> F64:
    """Angles [view] in radians. Raises ValueError if there are no angles, or if an angle is not finite."""
    theta = np.atleast_1d(np.asarray(angles, dtype=np.float64))
    if theta.ndim != 1 or theta.size == 0:
        raise ValueError(f"angles must be a list of at least one angle in radians, got shape {theta.shape}")
    if not np.isfinite(theta).all():
        not_finite = np.flatnonzero(~np.isfinite(theta))[:8].tolist()
        raise ValueError(
            f"{(~np.isfinite(theta)).sum()} of {theta.size} angles are not finite (projections {not_finite} ...)"
        )
    return theta


def _checked_turns(name: str, turns: Any, views: int) -> F64:
    values = np.asarray(turns, np.float64)
    if values.shape not in ((), (views,)) or not np.isfinite(values).all():
        raise ValueError(
            f"{name} must be finite radians: one number for all projections, or an array of shape [{views}]; got "
            f"shape {values.shape}"
        )
    return frozen(np.broadcast_to(values, (views,)))
