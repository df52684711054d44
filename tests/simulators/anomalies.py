"""Anomalies: compares the label of an anomaly with the pixels in which a frame with it differs from a frame without
it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from simulators.effects.chain import AnomalyLabel
from simulators.frame.shot import Shot
from simulators.scenes.expose import expose
from tests.simulators import shots

SEEN = 1e-3
"""A pixel counts as changed if its intensity changes by this share: ten counts in ten thousand."""


def change(effect: dict[str, Any], shot: Shot) -> NDArray[np.float64]:
    """Relative change of the intensity in each pixel by the effect, for flats and projections of one scene."""
    plain, changed = (expose(shots.scene(*effects), shot).astype(float) for effects in ([], [effect]))
    return changed / np.maximum(plain, 1) - 1


def labels(effect: dict[str, Any], shot: Shot) -> tuple[AnomalyLabel, ...]:
    return shots.scene(effect).chain.labels(shot)


def check_regions(effect: dict[str, Any], shot: Shot, loose: int = 1) -> bool:
    """Assert that the anomaly is visible and its regions are right.

    The regions contain every changed pixel, and each one is at most `loose` pixels wider than its change. Where two
    parts of an anomaly meet, their invisible parts may add up to 2 SEEN.
    """
    changes, found = np.abs(change(effect, shot)), labels(effect, shot)
    seen, beyond = changes > SEEN, changes > 2 * SEEN
    for label in found:
        top, below, left, right = label.region
        inside = seen[top:below, left:right]
        assert inside.any(), f"{label} lies where nothing changes"
        rows, cols = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
        wider = np.array([rows[0], below - top - 1 - rows[-1], cols[0], right - left - 1 - cols[-1]])
        assert (wider <= loose).all(), f"{label} is wider than what changes by {wider}"
        assert label.kind == effect["kind"]
        beyond[top:below, left:right] = False
    assert not beyond.any(), f"pixels beyond the regions of {found} change"
    return bool(found)
