"""tile_lists: lists of the Gaussians that touch each image tile or brick of voxels, made by counting and one sort.

A pixel is a sum, so any order within a tile is correct; a stable sort makes it the same in every run. The host needs
only one number, the length of the lists. It reads the length from the device, or uses the length of a `Room`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import triton
import triton.language as tl
from torch import Tensor

PROGRAMS = 4096  # number of programs that keep a large device busy
_BLOCK = 256
_LEAST = 32  # least number of Gaussians in a part of a list
_SPARE = 1.25  # length of a room divided by the number of counted pairs
# largest number of tiles for 16-bit numbers (including the one after the last); they need half the sorting passes
_SHORT = 2**15 - 1


@dataclass(eq=False)
class Room:
    """The length of lists that are refilled repeatedly without waiting for the device.

    Attributes:
        needed: int64 scalar on the device: largest number of pairs needed so far; lists with more than `pairs` were
            cut.
        pairs: length of the lists; None until the first lists are counted, see `grow`.
    """

    needed: Tensor
    pairs: int | None = None

    def grow(self, pairs: int) -> None:
        """Set the length to a quarter more than `pairs`, in whole blocks."""
        self.pairs = _BLOCK * max(1, math.ceil(_SPARE * pairs / _BLOCK))


@dataclass(frozen=True, eq=False)
class TileLists:
    """The Gaussians of each tile.

    Attributes:
        owners: int32 [pairs], indices of Gaussians; those of tile t are owners[starts[t]:starts[t + 1]]. In a room,
            values after those of the last tile have no meaning.
        starts: int32 [tiles + 1]; tiles are numbered row-major.
        counts: number of tiles along each axis.
    """

    owners: Tensor
    starts: Tensor
    counts: tuple[int, ...]

    @property
    def n_tiles(self) -> int:
        return math.prod(self.counts)

    @property
    def shares(self) -> int:
        """Number of parts of each list, each with its own layer, so that a few tiles still keep a device busy."""
        return max(1, min(PROGRAMS // self.n_tiles, self.owners.shape[0] // (_LEAST * self.n_tiles)))


@triton.jit(do_not_specialize=["n"])
def _touched(boxes, touched, n, edge, AXES: tl.constexpr, BLOCK: tl.constexpr):
    """Number of tiles that each box touches, int64 [n]."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    tiles = tl.full((BLOCK,), 1, tl.int64)
    for axis in tl.static_range(AXES):
        low = tl.load(boxes + 2 * (AXES * i + axis), i < n, 0)
        high = tl.load(boxes + 2 * (AXES * i + axis) + 1, i < n, 0)
        tiles *= tl.where(high > low, (high - 1) // edge - low // edge + 1, 0)
    tl.store(touched + i, tiles, i < n)


@triton.jit(do_not_specialize=["n", "pairs", "halvings"])
def _tile_of_pairs(
    boxes, ends, owners, tiles, needed, n, pairs, halvings, edge, tiles_y, tiles_x, n_tiles,
    AXES: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Owner and tile of each pair of a Gaussian and a tile that it touches, int32 [pairs] and [pairs].

    Unused pairs get the tile `n_tiles`.
    """
    pair = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    low, high = tl.zeros((BLOCK,), tl.int32), tl.zeros((BLOCK,), tl.int32) + n
    for _ in range(halvings):  # the first Gaussian whose pairs end after this one
        middle = (low + high) // 2
        before = (middle < n) & (tl.load(ends + middle, middle < n, 0) <= pair)
        low, high = tl.where(before, middle + 1, low), tl.where(before, high, middle)
    owner, held = low, (low < n) & (pair < pairs)
    # counted from the last tile of the box to the first
    rank = (tl.load(ends + owner, held, 1) - 1 - pair).to(tl.int32)
    tile, stride = tl.zeros((BLOCK,), tl.int32), 1
    for back in tl.static_range(AXES):
        axis = AXES - 1 - back
        first_of_box = tl.load(boxes + 2 * (AXES * owner + axis), held, 0)
        end_of_box = tl.load(boxes + 2 * (AXES * owner + axis) + 1, held, 1)
        first = first_of_box // edge
        span = tl.maximum((end_of_box - 1) // edge - first + 1, 1)
        tile += (first + rank % span) * stride
        rank = rank // span
        stride *= tiles_x if back == 0 else tiles_y
    tl.store(owners + pair, owner, pair < pairs)
    tl.store(tiles + pair, tl.where(held, tile, n_tiles), pair < pairs)
    if tl.program_id(0) == 0:
        tl.store(needed, tl.maximum(tl.load(needed), tl.load(ends + n - 1)))


@triton.jit(do_not_specialize=["pairs", "halvings"])
def _starts(tiles, starts, pairs, halvings, n_tiles, BLOCK: tl.constexpr):
    """For each tile, the index of the first sorted pair that does not belong to an earlier tile, int32 [n_tiles +
    1]."""
    tile = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    low, high = tl.zeros((BLOCK,), tl.int32), tl.zeros((BLOCK,), tl.int32) + pairs
    for _ in range(halvings):
        middle = (low + high) // 2
        before = (middle < pairs) & (tl.load(tiles + middle, middle < pairs, 0) < tile)
        low, high = tl.where(before, middle + 1, low), tl.where(before, high, middle)
    tl.store(starts + tile, low, tile <= n_tiles)


def tile_lists(boxes: Tensor, shape: Sequence[int], edge: int, room: Room | None = None) -> TileLists:
    """Lists for boxes int32 [n, 2 * axes] (low, high for each axis, high excluded, inside `shape`), tiles of `edge`.

    Raises:
        MemoryError: there are 2^31 or more pairs of a Gaussian and a tile.
    """
    counts, n, device = tuple(-(-size // edge) for size in shape), len(boxes), boxes.device
    n_tiles = math.prod(counts)
    touched = torch.empty(n, dtype=torch.int64, device=device)
    if n > 0:
        _touched[(triton.cdiv(n, _BLOCK),)](boxes, touched, n, edge, AXES=len(counts), BLOCK=_BLOCK)
    ends = touched.cumsum(0)
    if room is not None and room.pairs is not None:
        pairs, needed = room.pairs, room.needed
    else:
        pairs, needed = int(ends[-1]) if n > 0 else 0, touched.new_zeros(())
        if room is not None:
            room.grow(pairs)
    if pairs >= 2**31:
        raise MemoryError(
            f"{n} Gaussians touch {pairs} tiles of edge {edge}, more than the lists can hold (2^31). Use a smaller "
            "image or grid, or fewer or smaller Gaussians"
        )
    owners = torch.empty(pairs, dtype=torch.int32, device=device)
    tile = torch.empty(pairs, dtype=torch.int16 if n_tiles < _SHORT else torch.int32, device=device)
    if pairs > 0:
        _tile_of_pairs[(triton.cdiv(pairs, _BLOCK),)](
            boxes, ends, owners, tile, needed, n, pairs, n.bit_length(), edge, counts[-2], counts[-1], n_tiles,
            AXES=len(counts), BLOCK=_BLOCK,
        )  # fmt: skip
    tile, order = torch.sort(tile, stable=True)
    starts = torch.empty(n_tiles + 1, dtype=torch.int32, device=device)
    _starts[(triton.cdiv(n_tiles + 1, _BLOCK),)](tile, starts, pairs, pairs.bit_length(), n_tiles, BLOCK=_BLOCK)
    return TileLists(owners[order], starts, counts)
