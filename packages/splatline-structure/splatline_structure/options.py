"""Values of the options of `beamline structure`, and which options go together."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from splatline_structure.materials import Spacing

FEWEST_VIEWS = 16
"""Fewest projections that can be divided, 8 in each half."""
_OF_VOLUMES = "parts", "slices", "voxel_um", "scan", "quick"  # options that --states does not take


def numbers_in_text(text: str) -> list[float]:
    """Parse numbers separated by commas. Raises ValueError for other text."""
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = [math.nan]
    if not all(map(math.isfinite, numbers)):
        raise ValueError(f"{text!r}: expected numbers such as 0.2,0.5,1, one for each state")
    return numbers


def edges_of(text: str) -> Spacing:
    """Parse the edges of a voxel (z, y, x) in µm: one number or three. Raises ValueError for other text."""
    try:
        z, y, x = map(float, text.split(":") if ":" in text else [text] * 3)
    except ValueError:
        z = y = x = math.nan
    if not all(0 < edge < math.inf for edge in (z, y, x)) or not math.isclose(y, x, rel_tol=1e-3):
        raise ValueError(
            f"{text!r}: expected the edge of a voxel in µm, such as 0.65, or the three edges Z:Y:X, such as 3:1:1. "
            "Y must be equal to X, because the pixels of a slice must be squares"
        )
    return z, y, x


def refuse_together(states: bool, compare: bool, n: int, values: dict[str, Any]) -> None:
    """Raise UsageError for options that do not go together."""
    if compare and n != 2:
        raise click.UsageError(f"--compare needs two volumes, got {n}.")
    if values["parts"] and (n > 1 or values["scan"]):
        raise click.UsageError("--parts needs exactly one volume, and cannot be combined with --scan.")
    options = {"--compare": compare, **{f"--{name.replace('_', '-')}": values[name] for name in _OF_VOLUMES}}
    if states and (others := [name for name, value in options.items() if value]):
        raise click.UsageError(f"--states cannot be combined with {others[0]}.")
    if values["charge"] and not states:
        raise click.UsageError("--charge needs --states.")
