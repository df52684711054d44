"""Networks that compute the density at a point: encodings, a small perceptron, attention along line segments.

All take points [line, sample, 3], 0 to 1 in the box of the field, and return densities [line, sample] in the unit of
the field.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import gelu, leaky_relu, silu
from torch.nn.utils import skip_init

from recon import Geometry, Grid

F32 = NDArray[np.float32]
Activation = Callable[[Tensor], Tensor]
_PRIMES = 19349663, 83492791
_SMALL = 1e-4  # largest initial features of a hash grid
_LEAST = 1e-3  # smallest initial density, as a fraction of the highest
_HEADS, _HEAD, _SEGMENT, _WIDER = 8, 4, 2, 4  # heads, size of a head, samples of a segment, factor for its perceptron


class HashGrid(nn.Module):
    """Multiresolution hash grid (Müller et al. 2022): `levels` with 16, 32, ... cubes along an edge, two features each.

    Level l has cubes of 1 / (sides[l] - 2) of the unit box. Features are at their corners and are interpolated
    trilinearly. A level has at most 2^log2_table entries; if it has more corners, they share entries by a hash (eq. 4).
    """

    def __init__(self, levels: int, log2_table: int, features: int = 2, coarsest: int = 16) -> None:
        super().__init__()
        sides = coarsest * 2 ** np.arange(levels, dtype=np.int64) + 1
        sizes = np.minimum(sides**3, 2**log2_table)
        self.sides, self.firsts = sides, np.concatenate(([0], np.cumsum(sizes)))
        self.table = nn.Parameter(torch.empty(int(self.firsts[-1]), features))
        self.width = levels * features

    def forward(self, points: Tensor) -> Tensor:
        levels = []
        corners = torch.tensor([[(n >> k) & 1 for k in range(3)] for n in range(8)], device=points.device)
        for level, side in enumerate(self.sides.tolist()):
            first, size = int(self.firsts[level]), int(self.firsts[level + 1] - self.firsts[level])
            scaled = points[..., None, :] * (side - 2) + 0.5
            low = scaled.floor()
            corner = low.long() + corners
            weight = torch.where(corners > 0, scaled - low, 1 - (scaled - low)).prod(-1)
            x, y, z = corner.unbind(-1)
            hashed = (x ^ (y * _PRIMES[0]) ^ (z * _PRIMES[1])) & (size - 1)
            entry = x + side * (y + side * z) if side**3 <= size else hashed
            levels.append((weight[..., None] * self.table[first + entry]).sum(-2))
        return torch.cat(levels, -1)


class Waves(nn.Module):
    """Fourier features: the coordinates of a point, and their sines and cosines at `bands` frequencies. The first
    frequency is one wave along an edge, each next one is twice as high."""

    def __init__(self, bands: int) -> None:
        super().__init__()
        self.bands, self.width = bands, 3 + 6 * bands

    def forward(self, points: Tensor) -> Tensor:
        octaves = 2 * math.pi * 2.0 ** torch.arange(self.bands, device=points.device)
        phases = ((points - 0.5)[..., None] * octaves).flatten(-2)
        return torch.cat((points - 0.5, phases.sin(), phases.cos()), -1)


class LineAttention(nn.Module):
    """Attention within segments of two samples of a line, then a perceptron (Cai et al. 2024, SAX-NeRF, Lineformer)."""

    def __init__(self, width: int) -> None:
        super().__init__()
        inner = _HEADS * _HEAD
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(2))
        self.mix = skip_init(nn.Linear, width, 3 * inner, bias=False)
        self.out = skip_init(nn.Linear, inner, width, bias=False)
        self.places = nn.Parameter(torch.zeros(_SEGMENT, _SEGMENT, _HEADS))
        sizes = width, _WIDER * width, _WIDER * width, width
        self.wide = nn.ModuleList(skip_init(nn.Linear, a, b, bias=False) for a, b in pairwise(sizes))

    def forward(self, x: Tensor) -> Tensor:
        lines, samples, width = x.shape
        pairs = x.reshape(lines * samples // _SEGMENT, _SEGMENT, width)
        mixed = self.mix(self.norms[0](pairs)).unflatten(-1, (3, _HEADS, _HEAD))
        queries, keys, values = mixed.unbind(2)
        scores = (queries[:, :, None] * keys[:, None]).sum(-1) / math.sqrt(_HEAD) + self.places
        shares = scores.softmax(2)
        pairs = pairs + self.out((shares[..., None] * values[:, None]).sum(2).flatten(-2))
        y = self.norms[1](pairs)
        for layer in self.wide[:-1]:
            y = gelu(layer(y))
        return (pairs + self.wide[-1](y)).reshape(lines, samples, width)


class Field(nn.Module):
    """Encoding, four linear layers (the encoding is added again before the third), density.

    Args:
        attention: attention along line segments after the second layer.
        highest: the density is this times a sigmoid; None: no limits.
    """

    def __init__(
        self, encoding: HashGrid | Waves, width: int, *, waves: bool, attention: bool, highest: float | None
    ) -> None:
        super().__init__()
        self.encoding, self.highest = encoding, highest
        sizes = (encoding.width, width), (width, width), (width + encoding.width, width), (width, 1)
        self.layers = nn.ModuleList(skip_init(nn.Linear, *size) for size in sizes)
        self.attention = LineAttention(width) if attention else None
        self.activation: Activation = silu if waves else leaky_relu

    def forward(self, points: Tensor) -> Tensor:
        odd = points.shape[1] % _SEGMENT if self.attention is not None else 0
        encoded = self.encoding(torch.cat((points, points[:, -odd:]), 1) if odd else points)
        x = self.activation(self.layers[1](self.activation(self.layers[0](encoded))))
        if self.attention is not None:
            x = self.attention(x)
        x = self.activation(self.layers[2](torch.cat((x, encoded), -1)))
        raw = self.layers[3](x).squeeze(-1)
        density = raw if self.highest is None else self.highest * raw.sigmoid()
        return density[:, : points.shape[1]]

    def start(self, rng: torch.Generator, mean: float) -> None:
        """Set initial values from `rng`. The density begins at about `mean`, because a sigmoid would soon be flat."""
        for part in self.modules():
            if isinstance(part, nn.Linear):
                for values in part.parameters(recurse=False):
                    nn.init.uniform_(values, -(part.in_features**-0.5), part.in_features**-0.5, rng)
            elif isinstance(part, HashGrid):
                nn.init.uniform_(part.table, -_SMALL, _SMALL, rng)
        share = 0.0 if self.highest is None else min(max(mean / self.highest, _LEAST), 0.5)
        with torch.no_grad():
            *_, bias = self.layers[-1].parameters()
            bias.fill_(mean if self.highest is None else math.log(share / (1 - share)))


Places = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Rays:
    """The parts of rays within a box whose widest edge is 1.

    Attributes:
        start: float32 [n, 3], point (x, y, z) at which the ray enters.
        path: float32 [n, 3], vector to the point at which it leaves; zero for a ray that misses the box.
    """

    start: F32
    path: F32

    def samples(self, places: F32) -> F32:
        """Points [n, m, 3] at the fractions `places` [n, m] or [m] of the paths, within the box."""
        return np.clip(self.start[:, None] + places[..., None] * self.path[:, None], 0, 1)

    @property
    def lengths(self) -> F32:
        return np.linalg.norm(self.path, axis=1)


def rays_of(geometry: Geometry, view: int, pixels: Places, grid: Grid) -> Rays:
    """Rays through the box of `grid` to pixels of a projection; pixels are counted along rows."""
    rows, cols = np.divmod(pixels, geometry.detector_shape[1])
    along_col, along_row, beam = geometry.axes(view)
    col, row = geometry.origin(view)
    on_detector = geometry.pixel_pitch * (np.outer(cols - col, along_col) + np.outer(rows - row, along_row))
    if geometry.is_cone:
        source = geometry.centres[view] - geometry.sod * beam
        start, run = np.tile(source, (pixels.size, 1)), on_detector + geometry.sdd * beam
    else:
        start, run = on_detector, np.tile(beam, (pixels.size, 1))
    if geometry.skew:
        start, run = (_turned(vectors, rows * geometry.skew) for vectors in (start, run))
    low, high = grid.edges
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.stack(((low - start) / run, (high - start) / run))
    # A ray parallel to a side of the box is between its ends, or misses them.
    flat = np.broadcast_to(run == 0, ends.shape)
    inside = np.broadcast_to((start >= low) & (start <= high), ends.shape)
    ends = np.where(flat, np.where(inside, np.array([-np.inf, np.inf])[:, None, None], np.inf), ends)
    enter, leave = ends.min(0).max(1), ends.max(0).min(1)
    missed = ~(leave > enter)
    enter, leave = np.where(missed, 0, enter)[:, None], np.where(missed, 0, leave)[:, None]
    edge = (high - low).max()
    return Rays(*((part / edge).astype(np.float32) for part in (start + enter * run - low, (leave - enter) * run)))


def _turned(vectors: NDArray[np.float64], angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Vectors (x, y, z), each rotated about z by its angle."""
    c, s, (x, y, z) = np.cos(angles), np.sin(angles), vectors.T
    return np.stack((c * x - s * y, s * x + c * y, z), 1)


def drawn(rng: np.random.Generator, candidates: NDArray[np.bool_], count: int, windows: int, side: int) -> Places:
    """Pixels of a projection for one step: `windows` squares of `side` pixels, and `count` candidates outside of them.

    Args:
        candidates: [row, col], for pixels outside of windows; windows may be anywhere. There are at most as many pixels
            outside as candidates.
    """
    (rows, cols), places = candidates.shape, []
    free = candidates
    if windows:
        side = min(side, rows, cols)
        top, left = rng.integers(0, rows - side + 1, windows), rng.integers(0, cols - side + 1, windows)
        within = np.arange(side)
        pixels = (top[:, None, None] + within[:, None]) * cols + left[:, None, None] + within
        places.append(pixels.ravel())
        free = candidates.copy()
        free.reshape(-1)[pixels.ravel()] = False
    left_over = np.flatnonzero(free)
    if left_over.size > count:
        left_over = left_over[rng.integers(0, left_over.size, count)]
    return np.concatenate((*places, left_over))
