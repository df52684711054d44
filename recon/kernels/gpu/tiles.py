"""tile_lists: the Gaussians that touch each tile of an image or brick of voxels, by counting and one sort (torch).

A pixel is a sum, so the order within a tile is free; a stable sort makes it the same in every run.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

_PROGRAMS = 4096  # programs that keep a large device busy
_LEAST = 32  # Gaussians that a part of a list should hold at least


@dataclass(frozen=True, eq=False)
class TileLists:
    """Gaussians tile by tile.

    Attributes:
        owners: int32 [pairs], indices of Gaussians; those of tile t are owners[starts[t]:starts[t + 1]].
        starts: int32 [tiles + 1]; tiles are numbered row-major.
        counts: tiles along each axis.
    """

    owners: Tensor
    starts: Tensor
    counts: tuple[int, ...]

    @property
    def n_tiles(self) -> int:
        return math.prod(self.counts)

    @property
    def shares(self) -> int:
        """Number of parts of each list, each with a layer of its own, so that few tiles still occupy a device."""
        return max(1, min(_PROGRAMS // self.n_tiles, self.owners.shape[0] // (_LEAST * self.n_tiles)))


def tile_lists(boxes: Tensor, shape: Sequence[int], edge: int) -> TileLists:
    """Lists for boxes int32 [n, 2 * axes] (low, high of each axis, high excluded, inside `shape`), tiles of `edge`.

    Raises:
        MemoryError: where there are 2^31 or more pairs of a Gaussian and a tile.
    """
    counts = tuple(-(-size // edge) for size in shape)
    low, high = boxes[:, 0::2], boxes[:, 1::2]
    first = low // edge
    spans = torch.where(high > low, (high - 1) // edge - first + 1, 0)
    ends = spans.prod(1, dtype=torch.int64).cumsum(0)
    # The only number read from the device: the length of the lists.
    pairs = int(ends[-1]) if len(boxes) > 0 else 0
    if pairs >= 2**31:
        raise MemoryError(
            f"{len(boxes)} Gaussians touch {pairs} tiles of edge {edge}, more than lists hold (2^31); "
            "take a smaller image or grid, or fewer or smaller Gaussians"
        )
    device = boxes.device
    owner = torch.searchsorted(ends, torch.arange(pairs, device=device), right=True)
    spans, first = spans[owner], first[owner]
    rank = torch.arange(pairs, device=device) - (ends[owner] - spans.prod(1))
    tile, stride = torch.zeros_like(rank), 1
    for axis in reversed(range(len(counts))):
        tile += (first[:, axis] + rank % spans[:, axis]) * stride
        rank = rank // spans[:, axis]
        stride *= counts[axis]
    tile, order = torch.sort(tile.to(torch.int32), stable=True)
    edges = torch.arange(math.prod(counts) + 1, device=device, dtype=torch.int32)
    starts = torch.searchsorted(tile, edges, out_int32=True)
    return TileLists(owner[order].to(torch.int32), starts, counts)
