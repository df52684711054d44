"""The choices after a pass, in the form of an event."""

from __future__ import annotations

from typing import Any


def option(
    choice: str,
    gain: float | None = 0.0,
    ends: tuple[float | None, float | None] = (0.0, 0.0),
    frames: int = 0,
    seconds: float = 0.0,
    dose: float = 0.0,
    size: float = 0,
) -> dict[str, Any]:
    """One choice; `ends`: ends of the range of its gain; `size`: bytes."""
    costs = {"frames": frames, "seconds": seconds, "dose": dose, "bytes": size}
    return {"choice": choice, **costs, "gain": gain, "low": ends[0], "high": ends[1]}


UNKNOWN = None, None
"""Ends of the range of an unknown gain."""
