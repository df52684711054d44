"""Anomalies: where a frame with one differs from the same frame without it, and what its label says of that."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from simulators.effects.chain import Label
from simulators.effects.shot import Shot
from simulators.exposure import expose
from tests.simulators import shots

SEEN = 1e-3
"""Share of the light that a pixel must gain or lose to count as changed: ten counts of ten thousand."""


def change(effect: dict[str, Any], shot: Shot) -> NDArray[np.float64]:
    """Share of its light that each pixel gains or loses; flats and projections of one scene with the effect."""
    plain, changed = (expose(shots.scene(*effects), shot).astype(float) for effects in ([], [effect]))
    return changed / np.maximum(plain, 1) - 1


def label(effect: dict[str, Any], shot: Shot) -> Label | None:
    labels = shots.scene(effect).chain.labels(shot)
    assert len(labels) <= 1
    return labels[0] if labels else None


def check_region(effect: dict[str, Any], shot: Shot, loose: int = 1) -> bool:
    """Whether the anomaly shows; its region holds every changed pixel and is at most `loose` pixels wider."""
    seen, found = np.abs(change(effect, shot)) > SEEN, label(effect, shot)
    if found is None:
        assert not seen.any(), "it changes a frame that it does not label"
        return False
    assert seen.any(), "it labels a frame that it does not change"
    rows, cols = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    top, below, left, right = found.region
    box = np.array([rows[0] - top, below - 1 - rows[-1], cols[0] - left, right - 1 - cols[-1]])
    assert (box >= 0).all(), f"changed pixels lie beyond the region {found.region}"
    assert (box <= loose).all(), f"the region {found.region} is wider than what changes by {box}"
    assert found.kind == effect["kind"]
    return True
