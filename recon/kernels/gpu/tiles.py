"""tile_lists: the Gaussians that touch each tile of an image or brick of voxels, by counting and one sort.

A pixel is a sum, so the order within a tile is free; a stable sort makes it the same in every run.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import triton
import triton.language as tl
from torch import Tensor

PROGRAMS = 4096  # programs that keep a large device busy
_BLOCK = 256
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
        return max(1, min(PROGRAMS // self.n_tiles, self.owners.shape[0] // (_LEAST * self.n_tiles)))


@triton.jit(do_not_specialize=["n"])
def _touched(boxes, touched, n, edge, AXES: tl.constexpr, BLOCK: tl.constexpr):
    """How many tiles each box touches, int64 [n]."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    tiles = tl.full((BLOCK,), 1, tl.int64)
    for axis in tl.static_range(AXES):
        low = tl.load(boxes + 2 * (AXES * i + axis), i < n, 0)
        high = tl.load(boxes + 2 * (AXES * i + axis) + 1, i < n, 0)
        tiles *= tl.where(high > low, (high - 1) // edge - low // edge + 1, 0)
    tl.store(touched + i, tiles, i < n)


@triton.jit(do_not_specialize=["pairs"])
def _tile_of_pairs(
    boxes, owners, ends, tiles, pairs, edge, tiles_y, tiles_x, AXES: tl.constexpr, BLOCK: tl.constexpr
):  # fmt: skip
    """The tile of each pair of a Gaussian and a tile that it touches, int32 [pairs]."""
    pair = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    held = pair < pairs
    owner = tl.load(owners + pair, held, 0)
    rank = (tl.load(ends + owner, held, 1) - 1 - pair).to(tl.int32)  # from the last tile of the box to the first
    tile, stride = tl.zeros((BLOCK,), tl.int32), 1
    for back in tl.static_range(AXES):
        axis = AXES - 1 - back
        low = tl.load(boxes + 2 * (AXES * owner + axis), held, 0)
        high = tl.load(boxes + 2 * (AXES * owner + axis) + 1, held, 1)
        first = low // edge
        span = tl.maximum((high - 1) // edge - first + 1, 1)
        tile += (first + rank % span) * stride
        rank = rank // span
        stride *= tiles_x if back == 0 else tiles_y
    tl.store(tiles + pair, tile, held)


def tile_lists(boxes: Tensor, shape: Sequence[int], edge: int) -> TileLists:
    """Lists for boxes int32 [n, 2 * axes] (low, high of each axis, high excluded, inside `shape`), tiles of `edge`.

    Raises:
        MemoryError: where there are 2^31 or more pairs of a Gaussian and a tile.
    """
    counts, n, device = tuple(-(-size // edge) for size in shape), len(boxes), boxes.device
    touched = torch.empty(n, dtype=torch.int64, device=device)
    if n > 0:
        _touched[(triton.cdiv(n, _BLOCK),)](boxes, touched, n, edge, AXES=len(counts), BLOCK=_BLOCK)
    ends = touched.cumsum(0)
    pairs = int(ends[-1]) if n > 0 else 0  # the only number read from the device: the length of the lists
    if pairs >= 2**31:
        raise MemoryError(
            f"{n} Gaussians touch {pairs} tiles of edge {edge}, more than lists hold (2^31); "
            "take a smaller image or grid, or fewer or smaller Gaussians"
        )
    tile = torch.empty(pairs, dtype=torch.int32, device=device)
    owners = torch.searchsorted(ends, torch.arange(pairs, device=device), right=True, out_int32=True)
    if pairs > 0:
        _tile_of_pairs[(triton.cdiv(pairs, _BLOCK),)](
            boxes, owners, ends, tile, pairs, edge, counts[-2], counts[-1], AXES=len(counts), BLOCK=_BLOCK,
        )  # fmt: skip
    tile, order = torch.sort(tile, stable=True)
    edges = torch.arange(math.prod(counts) + 1, device=device, dtype=torch.int32)
    starts = torch.searchsorted(tile, edges, out_int32=True)
    return TileLists(owners[order], starts, counts)
