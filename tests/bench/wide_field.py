"""A sample wider than the field of view: dB, density, axis and CPU seconds by method, on packed balls in a can.

    python -m tests.bench.wide_field [--seeds 7,8] [--over 1.0,1.5,2.0,3.0] [--methods fbp,fista-tv,auto]
        [--columns 192] [--rows 12] [--views 90] [--offset-views 4]

Line integrals are exact chords, nine in a pixel, with the noise of 30 000 photons; the darkest ray keeps exp(-2). PSNR
is within 0.95 of the field, over the largest density; the density is the mean in the middle half of the field over the
true one. "known" is FISTA-TV where what lies outside is known and taken off the views: no method can expect more.
With `--offset-views` the sample is stepped aside by 0.9 of the field at so many angles.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from itertools import product

import numpy as np

import recon
from recon.auto import Auto
from recon.base.reach import SAMPLE
from recon.voxels.projector import Projector

MATRIX, WALL, THICK, FILLED, DEPTH, PHOTONS, SUB = 0.25, 0.9, 3.0, 0.4, 2.0, 3e4, 3


@dataclass(frozen=True, eq=False)
class Scene:
    """Views [view, row, col] with noise and without, the density [z, y, x] in the field, and the views' geometry."""

    views: np.ndarray
    clean: np.ndarray
    truth: np.ndarray
    geometry: recon.Geometry


def balls(rng: np.random.Generator, radius: float, cols: int, rows: int) -> np.ndarray:
    """[ball, 4] places x, y, z and radii of balls that do not meet, in a can, two fifths of its volume."""
    small, large = 4 * cols / 192, 13 * cols / 192
    half = rows / 2 + large
    cell, near, taken, volume = 2 * large + 1, dict[tuple[int, ...], list[np.ndarray]](), list[np.ndarray](), 0.0
    for _ in range(400_000):
        if volume >= FILLED * np.pi * radius**2 * 2 * half:
            break
        r, turn = rng.uniform(small, large), rng.uniform(0, 2 * np.pi)
        away = (radius - 4 - r) * np.sqrt(rng.uniform())
        ball = np.array([away * np.cos(turn), away * np.sin(turn), rng.uniform(-half, half), r])
        at = (ball[:3] // cell).astype(int)
        around = [near.get(tuple(at + step), []) for step in product((-1, 0, 1), repeat=3)]
        if all(((other[:3] - ball[:3]) ** 2).sum() >= (r + other[3] + 0.5) ** 2 for some in around for other in some):
            near.setdefault(tuple(at), []).append(ball)
            taken.append(ball)
            volume += 4 / 3 * np.pi * r**3
    return np.array(taken)


def scene(seed: int, over: float, cols: int, rows: int, geometry: recon.Geometry) -> Scene:
    """A can `over` times as wide as a field of so many columns, in pixels."""
    rng, radius = np.random.default_rng(seed), over * cols / 2
    packed = balls(rng, radius, cols, rows)
    densities = rng.uniform(0.85, 1.0, len(packed))
    shares = (np.arange(SUB) - (SUB - 1) / 2) / SUB
    z = (np.arange(rows)[:, None] - (rows - 1) / 2 + shares).ravel()
    clean = np.zeros((geometry.n_views, rows, cols))
    for view, (turn, shift) in enumerate(zip(geometry.angles, geometry.shifts[:, 0], strict=True)):
        u = (np.arange(cols)[:, None] + shares - geometry.axis_col - shift).ravel()
        outer, inner = (2 * np.sqrt(np.maximum(r**2 - u**2, 0)) for r in (radius, radius - THICK))
        lines = np.tile(WALL * (outer - inner) + MATRIX * inner, (z.size, 1))
        middles = packed[:, 0] * np.cos(turn) + packed[:, 1] * np.sin(turn)
        for (_, _, height, r), at, density in zip(packed, middles, densities, strict=True):
            i, k = (slice(*np.searchsorted(axis, (c - r, c + r))) for axis, c in ((u, at), (z, height)))
            left = r * r - (u[i] - at) ** 2 - (z[k, None] - height) ** 2
            lines[k, i] += (density - MATRIX) * 2 * np.sqrt(np.maximum(left, 0))
        clean[view] = lines.reshape(rows, SUB, cols, SUB).mean((1, 3))
    x = (np.arange(cols)[:, None] - (cols - 1) / 2 + shares).ravel()
    away = np.hypot(x[:, None], x)
    truth = np.broadcast_to(
        np.where(away > radius, 0, np.where(away > radius - THICK, WALL, MATRIX)), (z.size, *away.shape)
    )
    truth = np.array(truth, np.float32)
    for ball, density in zip(packed, densities, strict=True):
        i, j, k = (
            slice(*np.searchsorted(axis, (c - ball[3], c + ball[3]))) for axis, c in zip((x, x, z), ball, strict=False)
        )
        inside = (x[i] - ball[0]) ** 2 + (x[j, None] - ball[1]) ** 2 + (z[k, None, None] - ball[2]) ** 2 < ball[3] ** 2
        truth[k, j, i][inside] = density
    scale = DEPTH / clean.max()
    counts = rng.poisson(PHOTONS * np.exp(-clean * scale))
    views = -np.log(np.maximum(counts, 1) / PHOTONS)
    truth = truth.reshape(rows, SUB, cols, SUB, cols, SUB).mean((1, 3, 5)) * scale
    return Scene(views.astype(np.float32), (clean * scale).astype(np.float32), truth.astype(np.float32), geometry)


def geometry_of(cols: int, rows: int, views: int, wide: int, over: float) -> recon.Geometry:
    """Half a turn, and so many offset views."""
    steps = [k * 0.9 * cols for k in range(-9, 10) if k and abs(k) * 0.9 - 0.5 < over / 2]
    angles = np.concatenate(
        (np.arange(views) * np.pi / views, np.repeat(np.arange(wide) * np.pi / max(wide, 1), len(steps)))
    )
    shifts = np.zeros((angles.size, 2))
    shifts[views:, 0] = np.tile(steps, wide)
    return recon.Geometry.parallel(angles, (rows, cols), shifts=shifts)


def judged(volume: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """PSNR in dB within 0.95 of the field, and the density in its middle over the true one."""
    x = np.arange(truth.shape[1]) - (truth.shape[1] - 1) / 2
    away = np.hypot(x[:, None], x) / (truth.shape[1] / 2)
    error = np.mean(np.square(volume - truth)[:, away < 0.95])
    return 10 * np.log10(truth.max() ** 2 / error), volume[:, away < 0.5].mean() / truth[:, away < 0.5].mean()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for name, default in (("seeds", "7,8"), ("over", "1.0,1.5,2.0,3.0"), ("methods", "fbp,fista-tv,auto")):
        parser.add_argument(f"--{name}", default=default)
    for name, number in (("columns", 192), ("rows", 12), ("views", 90), ("offset-views", 0)):
        parser.add_argument(f"--{name}", type=int, default=number)
    given = parser.parse_args()
    print("over  seed  method      dB  density  radius/field   CPU s")
    for over, seed in ((float(o), int(s)) for o in given.over.split(",") for s in given.seeds.split(",")):
        geometry = geometry_of(given.columns, given.rows, given.views, given.offset_views, over)
        made = scene(seed, over, given.columns, given.rows, geometry)
        ordinary = np.flatnonzero(geometry.is_centred)
        axis = recon.find_axis(made.views[ordinary], geometry.angles[ordinary])
        known = Projector(geometry, recon.Grid.matching(geometry)).forward(made.truth) + made.views - made.clean
        for name in ("known", *given.methods.split(",")):
            method, views = Auto() if name == "auto" else "fista-tv" if name == "known" else name, made.views
            began = time.process_time()
            result = recon.reconstruct(known if name == "known" else views, geometry, method)
            spent, (db, density) = time.process_time() - began, judged(result.volume.data, made.truth)
            reach = result.settings.get(SAMPLE, 0.0) / geometry.reach
            print(f"{over:4g}{seed:6d}  {name:9s}{db:6.2f}{density:9.3f}{reach:14.2f}{spent:8.1f}", flush=True)
        off = axis.value - geometry.axis_col
        print(f"{over:4g}{seed:6d}  axis off by {off:.2f} columns, {'certain' if axis.confident else 'uncertain'}")


if __name__ == "__main__":
    main()
