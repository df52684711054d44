"""Scenes of packed balls that change, their truth and views (not by recon's projector), and figures of a volume.

A state is the scene after it moved (a turn, a shift, a swelling, three smooth bumps), with grey levels of particles
that changed each by its own, cracks, two particles that are gone, a new one and a pore. The truth has 4 x 4 x 2 samples
a voxel at inverse-mapped places; projections are sums of boxes of a quarter voxel, with Poisson noise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import ndimage as ndi

F = np.float32
F32 = NDArray[np.float32]
OVER, ZOVER = 4, 2  # samples of the truth along each edge of a voxel


@dataclass
class State:
    """A scene at one moment. balls [k, 5]: x, y, z, radius, level; cracks [k, 5]: normal, offset, width (0: none)."""

    n: int
    rows: int
    balls: np.ndarray
    matrix: tuple[float, float]  # radius, level
    can: tuple[float, float, float]  # inner, outer radius, level
    cracks: np.ndarray
    shown: np.ndarray  # [k] bool
    pores: np.ndarray = field(default_factory=lambda: np.zeros((0, 4)))
    inverse: np.ndarray = field(default_factory=lambda: np.eye(2, 3))  # state -> reference, affine
    bumps: np.ndarray = field(default_factory=lambda: np.zeros((0, 5)))  # x, y, width, ux, uy, added to that


@njit(cache=True)
def _paint(  # type: ignore[no-untyped-def]
    n, rows, over, zover, balls, cracks, shown, matrix, can, pores, inverse, bumps, cells, fine, label
):
    m, half = n * over, (n - 1) / 2
    for jf in range(m):
        for i_f in range(m):
            x0, y0 = (i_f + 0.5) / over - 0.5 - half, (jf + 0.5) / over - 0.5 - half
            x = inverse[0, 0] * x0 + inverse[0, 1] * y0 + inverse[0, 2]
            y = inverse[1, 0] * x0 + inverse[1, 1] * y0 + inverse[1, 2]
            ux, uy = 0.0, 0.0
            for b in range(len(bumps)):
                w = math.exp(-((x - bumps[b, 0]) ** 2 + (y - bumps[b, 1]) ** 2) / (2 * bumps[b, 2] ** 2))
                ux += w * bumps[b, 3]
                uy += w * bumps[b, 4]
            x, y = x + ux, y + uy
            radius = math.sqrt(x * x + y * y)
            ground = matrix[1] if radius < matrix[0] else 0.0
            if can[0] <= radius < can[1]:
                ground = can[2]
            ci, cj = int((x + half + 8) / 8), int((y + half + 8) / 8)
            near = cells[min(max(cj, 0), len(cells) - 1), min(max(ci, 0), len(cells) - 1)]
            for k in range(rows):
                total = 0.0
                for kz in range(zover):
                    z = k + (kz + 0.5) / zover - rows / 2
                    value, owner = ground, 0
                    for b in near:
                        if b < 0:
                            break
                        dx, dy, dz = x - balls[b, 0], y - balls[b, 1], z - balls[b, 2]
                        if shown[b] and dx * dx + dy * dy + dz * dz < balls[b, 3] ** 2:
                            value, owner = balls[b, 4], b + 1
                            c = cracks[b]
                            if c[4] > 0 and abs(c[0] * dx + c[1] * dy + c[2] * dz - c[3]) < c[4] / 2:
                                value = matrix[1]
                            break
                    for b in range(len(pores)):
                        if (x - pores[b, 0]) ** 2 + (y - pores[b, 1]) ** 2 + (z - pores[b, 2]) ** 2 < pores[b, 3] ** 2:
                            value = 0.0
                    total += value
                    here = label[jf // over, i_f // over, k]
                    if here == -1:
                        label[jf // over, i_f // over, k] = owner
                    elif here != owner:
                        label[jf // over, i_f // over, k] = 0
                fine[jf, i_f, k] = total / zover


def paint(s: State) -> tuple[F32, F32, NDArray[np.int32]]:
    """Fine truth [y, x, row], truth [z, y, x], and the ball (from 1) that fills each voxel whole, else 0."""
    count = (s.n + 16) // 8 + 1
    cells = np.full((count, count, 24), -1)
    for b, (x, y, z, r, _) in enumerate(s.balls):
        if abs(z) < r + s.rows / 2:
            low = ((np.array([y, x]) - r + (s.n - 1) / 2 + 8) // 8).astype(int).clip(0, count - 1)
            high = ((np.array([y, x]) + r + (s.n - 1) / 2 + 8) // 8).astype(int).clip(0, count - 1)
            for j in range(low[0], high[0] + 1):
                for i in range(low[1], high[1] + 1):
                    cells[j, i, (cells[j, i] >= 0).sum()] = b
    fine = np.zeros((s.n * OVER, s.n * OVER, s.rows), F)
    label = np.full((s.n, s.n, s.rows), -1, np.int32)
    _paint(s.n, s.rows, OVER, ZOVER, s.balls, s.cracks, s.shown, np.array(s.matrix), np.array(s.can), s.pores,
           s.inverse, s.bumps, cells, fine, label)  # fmt: skip
    truth = fine.reshape(s.n, OVER, s.n, OVER, s.rows).mean((1, 3))
    return fine, np.ascontiguousarray(truth.transpose(2, 0, 1)), np.ascontiguousarray(label.transpose(2, 0, 1))


@njit(cache=True)
def _views(  # type: ignore[no-untyped-def]
    fine, over, angles, out
):
    m, cols, rows = fine.shape[0], out.shape[1], fine.shape[2]
    half = (cols - 1) / 2
    for v in range(len(angles)):
        c, s = math.cos(angles[v]), math.sin(angles[v])
        wide = max(abs(c), abs(s)) / over  # footprint: a box
        for j in range(m):
            y = (j + 0.5) / over - 0.5 - half
            for i in range(m):
                if fine[j, i, 0] == 0 and fine[j, i, rows - 1] == 0:
                    continue
                at = ((i + 0.5) / over - 0.5 - half) * c + y * s + half + 0.5
                first = math.floor(at - wide / 2)
                share = min(1.0, (first + 1 - (at - wide / 2)) / wide) / over**2
                for k in range(rows):
                    if 0 <= first < cols:
                        out[v, first, k] += share * fine[j, i, k]
                    if 0 <= first + 1 < cols:
                        out[v, first + 1, k] += (1 / over**2 - share) * fine[j, i, k]


def scanned(fine: F32, angles: NDArray[np.float64], photons: float, rng: np.random.Generator) -> F32:
    """Noisy line integrals [view, row, col]."""
    out = np.zeros((len(angles), fine.shape[0] // OVER, fine.shape[2]), F)
    _views(fine, OVER, angles, out)
    counts = rng.poisson(photons * np.exp(-out.astype(float)))
    return np.ascontiguousarray(-np.log(np.maximum(counts, 0.5) / photons).transpose(0, 2, 1), F)


def packed(n: int, rows: int, radii: NDArray[np.float64], fill: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Balls [k, 4] in a cylinder of radius 0.42 n, pushed apart until few overlap; periodic along z."""
    wide, high = 0.42 * n, max(2.6 * radii[1], rows + 2 * radii[1])
    r = rng.uniform(radii[0], radii[1], size=4000)
    r = r[np.cumsum(4 / 3 * np.pi * r**3) < fill * np.pi * wide**2 * high]
    x = rng.uniform(-wide, wide, (len(r), 3)) * [0.7, 0.7, 0]
    x[:, 2] = rng.uniform(-high / 2, high / 2, len(r))
    for _ in range(400):
        d = x[:, None] - x
        d[..., 2] -= high * np.round(d[..., 2] / high)
        away = np.linalg.norm(d, axis=2) + 1e-9
        deep = np.maximum(r[:, None] + r - away + 0.3, 0)
        np.fill_diagonal(deep, 0)
        x += 0.3 * ((deep / away)[..., None] * d).sum(1)
        out = np.hypot(x[:, 0], x[:, 1]) + r - wide
        x[:, :2] *= np.where(out > 0, 1 - out / np.maximum(np.hypot(x[:, 0], x[:, 1]), 1e-9), 1)[:, None]
        x[:, 2] -= high * np.round(x[:, 2] / high)
    return np.column_stack((x, r * 0.97))


_KEYS = "radii", "fill", "matrix", "can", "spread", "local", "swell"
SCENES: dict[str, dict[str, Any]] = {
    name: dict(zip(_KEYS, values, strict=True))
    for name, values in {
        "can": ((0.045, 0.085), 0.56, 0.25, 0.8, 0.10, 1.5, 0.015),
        "air": ((0.05, 0.09), 0.58, 0.0, 0.0, 0.05, 1.0, 0.01),
        "fine": ((0.03, 0.05), 0.54, 0.2, 0.0, 0.10, 1.5, 0.015),
        "swell": ((0.04, 0.09), 0.56, 0.3, 1.3, 0.15, 2.0, 0.02),
    }.items()
}
"""Radii of the balls over the width, share of the cylinder that they fill, levels of the matrix and of the can over
that of balls, spread of the levels of balls, size of the bumps in pixels of 160 columns, and swelling."""


def scene(name: str, n: int = 160, rows: int = 4, seed: int = 0) -> tuple[list[State], dict[str, Any]]:
    """State 0 and states 1 to 3."""
    rng, s = np.random.default_rng([seed, list(SCENES).index(name)]), SCENES[name]
    balls = packed(n, rows, np.array(s["radii"]) * n, s["fill"], rng)
    unit = 3.2 / n  # particle level: line integrals up to about 2
    k = len(balls)
    balls = np.column_stack((balls, unit * (1 + s["spread"] * rng.uniform(-1, 1, k))))
    cut = np.sqrt(np.maximum(balls[:, 3] ** 2 - balls[:, 2] ** 2, 0))  # radius of the section in the middle
    seen = rng.permutation(np.flatnonzero(cut > 0.03 * n))
    gone, new, cracked = seen[:2], seen[2:3], seen[3 : 3 + max(3, round(0.2 * len(seen)))]
    can = (0.43 * n, 0.46 * n, s["can"] * unit) if s["can"] else (0.0, 0.0, 0.0)
    first = State(n, rows, balls, (0.43 * n, s["matrix"] * unit), can, np.zeros((k, 5)), np.ones(k, bool))
    first.shown[new] = False
    cracks = np.zeros((k, 5))
    for b in cracked:
        normal = rng.normal(size=3) * [1, 1, 0.25]
        cracks[b] = *(normal / np.linalg.norm(normal)), rng.uniform(-0.25, 0.25) * balls[b, 3], rng.uniform(0.7, 1.5)
    cracks[:, 3] += (cracks[:, :3] * (np.array([0, 0, 0]) - balls[:, :3] * [0, 0, 1])).sum(1)  # at the middle row
    change = rng.uniform(-0.1, 0.1, k)
    turn, shift = np.radians(rng.choice([-1, 1])), rng.uniform(-1, 1, 2)
    shift *= 3 * n / 160 / np.abs(shift).max()
    places, widths = rng.uniform(-0.25, 0.25, (3, 2)) * n, rng.uniform(0.12, 0.2, 3) * n
    sizes = rng.choice([-1, 1], (3, 2)) * rng.uniform(0.5, 1, (3, 2)) * s["local"] * n / 160
    bumps = np.column_stack((places, widths, sizes))
    free = seen[-1]
    pores = np.array([[*(balls[free, :2] + balls[free, 3] * np.array([0.5, 0.5])), 0.0, 0.022 * n]])
    states = [first]
    for share in (0.5, 0.75, 1.0):
        c, sn, scale = math.cos(share * turn), math.sin(share * turn), 1 / (1 + share * s["swell"])
        inverse = np.array([[c * scale, sn * scale, -share * shift[0]], [-sn * scale, c * scale, -share * shift[1]]])
        moved, now, shown = bumps.copy(), balls.copy(), np.ones(k, bool)
        moved[:, 3:] *= share
        now[:, 4] *= 1 + share * change
        shown[gone] = False
        opened = cracks * [1, 1, 1, 1, 0.4 + 0.6 * share]
        states.append(State(n, rows, now, first.matrix, can, opened, shown, pores, inverse, moved))
    return states, {"gone": gone, "new": new, "cracked": cracked, "change": change}


class Judge:
    """Figures of a volume [z, y, x] of one state against the truth."""

    def __init__(self, states: list[State], what: dict[str, Any], at: int) -> None:
        s = states[at]
        self.truth = paint(s)[1]
        whole, present, absent = replace(s, cracks=0 * s.cracks), s.shown.copy(), s.shown.copy()
        present[what["gone"]], absent[what["new"]] = True, False
        filled, inside = paint(whole)[1:]
        crack = filled - self.truth  # more than nothing in cracks
        self.ghost = paint(replace(s, shown=present))[1] - self.truth
        fresh = self.truth - paint(replace(s, shown=absent))[1]
        pore = paint(replace(s, pores=np.zeros((0, 4))))[1] - self.truth
        level = float(np.median(s.balls[:, 4]))
        touched = sum(np.abs(e) for e in (crack, self.ghost, fresh, pore)) > 0.05 * level
        self.changed = ndi.binary_dilation(touched, iterations=1)
        self.cracks = {}
        near = ndi.binary_dilation(crack > 0, iterations=2)
        for b in what["cracked"]:
            own = ndi.binary_erosion(inside == b + 1, np.ones((1, 3, 3)))
            if (own & (crack > 0)).sum() > 10 and (own & ~near).sum() > 10:
                self.cracks[int(b)] = own, own & ~near, crack

    def psnr(self, x: F32, where: NDArray[np.bool_] | None = None) -> float:
        e = np.square(x - self.truth)
        return float(10 * np.log10(self.truth.max() ** 2 / (e.mean() if where is None else e[where].mean())))

    def depths(self, x: F32) -> NDArray[np.float64]:
        """Of each crack, the share of its true depth: of what is missing to the particle's level beside it."""
        return np.array([
            ((np.median(x[beside]) - x[own]) * crack[own]).sum() / np.square(crack[own]).sum()
            for own, beside, crack in self.cracks.values()
        ])  # fmt: skip

    def ghosts(self, x: F32) -> float:
        """Of what was there and is gone, the share that remains."""
        return float(((x - self.truth) * self.ghost).sum() / np.square(self.ghost).sum())
