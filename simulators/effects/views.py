"""Views: the stretch of a scan in which an anomaly is there."""

from __future__ import annotations

from typing import TypeAlias

from simulators.frame.shot import Shot

Views: TypeAlias = tuple[int, int]
"""First view and the one after the last. A flat counts to the view that is exposed next."""


def check(views: Views | None) -> None:
    """Raises ValueError where the stretch is empty or begins before view 0."""
    if views is not None and not 0 <= views[0] < views[1]:
        raise ValueError(f"views must be [first, one after the last] with 0 <= first < last, got {list(views)}")


def within(views: Views | None, shot: Shot) -> bool:
    """Whether the shot lies in the stretch; without one it always does."""
    return views is None or views[0] <= shot.view < views[1]
