"""Clusters of jumps of a sample: which parts of a scan between them are fitted together."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from recon.base.arrays import I64

LEAST = 6
"""Views of a part that its displacement is fitted to."""


def jump_clusters(sizes: I64) -> list[tuple[int, int]]:
    """First and last number of jumps between which no part [its size] is long enough for its own displacement."""
    clustered: list[tuple[int, int]] = []
    for jump in range(sizes.size - 1):
        if clustered and sizes[jump] < LEAST:
            clustered[-1] = clustered[-1][0], jump
        else:
            clustered.append((jump, jump))
    return clustered


def part_groups(sizes: I64, clusters: Sequence[tuple[int, int]]) -> I64:
    """[part] parts without one of these jumps between them are a group, numbered from 0; -1: too few views, or inside
    a cluster of jumps."""
    group = np.zeros(sizes.size, np.int64)
    for first, last in clusters:
        group[last + 1 :] += 1
        group[first + 1 : last + 1] = -1
    for at in range(len(clusters) + 1):
        if sizes[group == at].sum() < LEAST:
            group[group == at] = -1
    group[group >= 0] = np.unique(group[group >= 0], return_inverse=True)[1]
    return group


def thinned(group: I64, most: int, short: int) -> I64:
    """[view] indices of at most about `most` views, evenly spread in each group [view]; all views of groups up to
    `short`.
    """
    step = max(1, math.ceil(group.size / most))
    keep = [
        np.flatnonzero(group == at)[:: 1 if (group == at).sum() <= short else step] for at in range(group.max() + 1)
    ]
    return np.sort(np.concatenate(keep))
