"""Whether sweeps end, on volumes whose changes are given."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from recon.base.decisions import Decisions
from recon.voxels.standstill import MIRRORED, Standstill


def sweeps_of(changes: Sequence[float], *, from_rest: bool) -> int | None:
    """The sweep after which sweeps end; None: they do not. Four sweeps together change the volume by each change."""
    standstill = Standstill(Decisions(0), 0.005, from_rest=from_rest)
    x = np.ones((2, 2, 2), np.float32)
    for done in range(1, MIRRORED * len(changes) + 2):
        if done > 1 and (done - 1) % MIRRORED == 0:
            x = x * np.float32(1 + changes[(done - 1) // MIRRORED - 1])
        if standstill.ends(x, done, True):
            return done
    return None


@pytest.mark.parametrize(
    ("changes", "usual", "from_rest"),
    [
        ((0.004, 0.007, 0.006, 0.004), 5, 17),  # sweeps that speed up
        ((0.02, 0.01, 0.004), 13, 13),
        ((0.004, 0.003), 5, 9),
        ((0.002, 0.003, 0.004), 5, None),
    ],
)
def test_sweeps_that_speed_up_do_not_end_while_the_changes_grow(
    changes: Sequence[float], usual: int, from_rest: int | None
) -> None:
    assert sweeps_of(changes, from_rest=False) == usual
    assert sweeps_of(changes, from_rest=True) == from_rest
