"""Scans of the first users' samples with known ground truth: packed cans (exact chords) and the simulator's cathode.

The cans have cracks or not, the cathode has fringes or not. Other bodies are in tests.bench.first_users_shapes.

Lengths are in detector pixels (voxels have the same size), densities in 1/pixel. A line integral is the mean of nine
rays per pixel. A can within the field of view is 0.96 times as wide as the field; wider cans are `over` times as wide.
The darkest ray has a transmission of exp(-2) for any width (cathode: about a twentieth). `drift`, `rings` and
`hardening` use the same cans as `packed`: `drift` moves sideways by a pixel during the scan, `rings` has pixel
sensitivities that are wrong by 1 % (a few by 5 %), `hardening` has two energies. `cone` are ellipsoids in a cone beam
whose source is four field widths away.
"""

from __future__ import annotations

import hashlib
import math
import os
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import yaml
from numpy.typing import NDArray

from recon.base.geometry import Geometry
from recon.base.jit import njit
from recon.base.volume import Grid
from simulators.effects.scattering.phase_fringes import PhaseFringes
from simulators.frame.shot import Detector
from simulators.light import Beam
from simulators.samples.composed import build_sample
from tests.bench import first_users_shapes as shapes
from tests.simulators import shots

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
MATRIX, WALL, THICK, FILLED, DEPTH = 0.25, 0.9, 3.0, 0.4, 2.0
"""Densities of electrolyte and wall, thickness of the wall, share of grains in the can, largest line integral."""
SMALL, LARGE, PLATES, FLAT, GAP = 4.0, 13.0, 0.2, 0.25, 0.5
"""Smallest and largest radius, share of plates in the grain volume, half thickness / radius, smallest distance."""
CRACKED, OFF, WIDTHS = 8.0, 0.3, (0.5, 2.0)
"""Smallest radius of a ball with a crack (every second such ball has one); largest distance of the crack from the
middle, divided by the radius; widths of cracks."""
SUB, TRIES = 3, 4000
MOVED, GAINS, FEW, SOFT, SOURCE = 1.0, (0.01, 0.05), 0.02, 0.3, 4.0
"""Drift in pixels; errors of most and of a few pixel sensitivities; share of these few; deviation of the two
attenuations from their mean; distance of a cone's source, divided by the number of columns."""
PITCH, ENERGY, DISTANCE, DELTA_BETA, FIELD = 4.6e-3, 25.0, 30.0, 90.0, 0.96
"""Cathode: pixel in mm, energy in keV, distance in mm and delta/beta of the fringes. FIELD: width of can / field."""


class Bodies(NamedTuple):
    """Balls; some are cut to plates by two planes around their middle, some have a crack between two planes.

    Attributes:
        centre: [body, 3], x, y, z.
        radius: [body].
        density: [body], difference from the matrix.
        plate: [body, 5], unit normal, 0, half thickness (infinite: a ball).
        crack: [body, 5], unit normal, distance from the centre, half width (0: none).
    """

    centre: F64
    radius: F64
    density: F64
    plate: F64
    crack: F64


@dataclass(frozen=True, eq=False)
class Planes:
    """Discs through balls: [disc, 3] centres and unit normals, [disc] radii and widths; width 0: no crack, for
    control."""

    centre: F64
    normal: F64
    radius: F64
    width: F64


@dataclass(frozen=True, eq=False)
class Scene:
    """A sample with its ground truth and its projections.

    Attributes:
        clean: line integrals [view, row, col].
        truth: densities [z, y, x] in the field of view, averaged over voxels.
        levels: densities of matrix and grains.
        inner: inner radius of the can in pixels.
        planes: where crack depths are measured; None: the scene is not `cracks`.
    """

    clean: F32
    truth: F32
    levels: tuple[float, float]
    inner: float
    geometry: Geometry
    planes: Planes | None = None


@njit(cache=True)
def _place(
    rng: np.random.Generator,
    spheres: F64,
    first: NDArray[np.intp],
    volumes: F64,
    can: float,
    half: float,
    wanted: float,
) -> F64:
    """Positions [body, 3] of bodies that do not touch, found by trial until their volume is `wanted` (NaN: no room).

    `spheres` [sphere, 4] cover them: body b at the origin is within spheres first[b] to first[b + 1]. The space repeats
    above and below with the period 2 half."""
    cell = 2 * spheres[:, 3].max() + GAP
    across, tall = int(2 * can / cell) + 3, max(1, int(2 * half / cell))
    head = np.full(across * across * tall, -1)
    follower = np.full(len(spheres), -1)
    taken = np.empty((len(spheres), 4))
    places = np.full((len(first) - 1, 3), np.nan)
    for b in range(len(first) - 1):
        for _ in range(TRIES if volumes[b] <= wanted else 0):
            turn, away = rng.uniform(0, 2 * np.pi), can * np.sqrt(rng.uniform(0, 1))
            x, y, z = away * np.cos(turn), away * np.sin(turn), rng.uniform(-half, half)
            free = True
            for s in range(first[b], first[b + 1]):
                px, py, pz, r = x + spheres[s, 0], y + spheres[s, 1], z + spheres[s, 2], spheres[s, 3]
                free = math.hypot(px, py) + r + GAP <= can
                i, j, k = int((px + can) / cell) + 1, int((py + can) / cell) + 1, _layer(pz, half, tall)
                for c in range(9 * min(tall, 3) if free else 0):
                    layer = (k + c // 9 - 1) % tall
                    n = head[(layer * across + j + c // 3 % 3 - 1) * across + i + c % 3 - 1]
                    while n >= 0 and free:
                        up = taken[n, 2] - pz
                        up -= 2 * half * np.rint(up / (2 * half))
                        far = (taken[n, 0] - px) ** 2 + (taken[n, 1] - py) ** 2 + up**2
                        free = far >= (taken[n, 3] + r + GAP) ** 2
                        n = follower[n]
                if not free:
                    break
            if free:
                places[b], wanted = (x, y, z), wanted - volumes[b]
                for s in range(first[b], first[b + 1]):
                    taken[s] = x + spheres[s, 0], y + spheres[s, 1], z + spheres[s, 2], spheres[s, 3]
                    i, j = int((taken[s, 0] + can) / cell) + 1, int((taken[s, 1] + can) / cell) + 1
                    at = (_layer(taken[s, 2], half, tall) * across + j) * across + i
                    follower[s], head[at] = head[at], s
                break
    return places


@njit(cache=True)
def _layer(z: float, half: float, tall: int) -> int:
    return math.floor((z + half) / (2 * half) * tall) % tall


@njit(cache=True)
def _add_view(bodies: Bodies, angle: float, u: F64, v: F64, out: F64) -> None:
    """Add the line integrals [v, u] of the bodies, rays at equally spaced u and v."""
    c, s, step = np.cos(angle), np.sin(angle), u[1] - u[0]
    for b in range(len(bodies.radius)):
        x, y, z = bodies.centre[b]
        r, at, plate, crack = bodies.radius[b], x * c + y * s, bodies.plate[b], bodies.crack[b]
        for k in range(max(0, math.ceil((z - r - v[0]) / step)), min(len(v), math.floor((z + r - v[0]) / step) + 1)):
            dv = v[k] - z
            reach = np.sqrt(max(r * r - dv * dv, 0.0))
            first, end = math.ceil((at - reach - u[0]) / step), math.floor((at + reach - u[0]) / step) + 1
            for i in range(max(0, first), min(len(u), end)):
                du = u[i] - at
                high = np.sqrt(max(r * r - dv * dv - du * du, 0.0))
                low = -high
                if plate[4] < r:
                    low, high = _between(du, dv, c, s, plate, low, high)
                length = high - low
                if crack[4] > 0:
                    low, high = _between(du, dv, c, s, crack, low, high)
                    length -= high - low
                out[k, i] += bodies.density[b] * length


@njit(cache=True)
def _between(du: float, dv: float, c: float, s: float, n: F64, low: float, high: float) -> tuple[float, float]:
    """The part of the range low to high, on a ray at (du, dv) from the body's centre, between two planes of
    `Bodies`."""
    at, slope = du * (n[0] * c + n[1] * s) + dv * n[2] - n[3], n[1] * c - n[0] * s
    if abs(slope) < 1e-9:
        return (low, high) if abs(at) <= n[4] else (low, low)
    one, other = (-n[4] - at) / slope, (n[4] - at) / slope
    low, high = max(low, min(one, other)), min(high, max(one, other))
    return low, max(low, high)


@njit(cache=True)
def _fill(bodies: Bodies, x: F64, z: F64, sub: int, out: F32) -> None:
    """Add the densities of the bodies to voxels [z, y, x]; a voxel that a surface may cross is the mean of sub³
    points."""
    for b in range(len(bodies.radius)):
        middle, r, plate, crack = bodies.centre[b], bodies.radius[b], bodies.plate[b], bodies.crack[b]
        for k in range(max(0, math.ceil(middle[2] - r - z[0] - 0.5)), min(len(z), int(middle[2] + r - z[0] + 1.5))):
            for j in range(max(0, math.ceil(middle[1] - r - x[0] - 0.5)), min(len(x), int(middle[1] + r - x[0] + 1.5))):
                first, end = math.ceil(middle[0] - r - x[0] - 0.5), int(middle[0] + r - x[0] + 1.5)
                for i in range(max(0, first), min(len(x), end)):
                    away = math.sqrt((x[i] - middle[0]) ** 2 + (x[j] - middle[1]) ** 2 + (z[k] - middle[2]) ** 2)
                    if away > r + 0.87:
                        continue
                    points = 1 if away < r - 0.87 and plate[4] >= r and crack[4] == 0 else sub
                    inside = 0
                    for p in range(points**3):
                        dx = x[i] - middle[0] + (p % points + 0.5) / points - 0.5
                        dy = x[j] - middle[1] + (p // points % points + 0.5) / points - 0.5
                        dz = z[k] - middle[2] + (p // points**2 + 0.5) / points - 0.5
                        across = abs(dx * plate[0] + dy * plate[1] + dz * plate[2])
                        from_crack = abs(dx * crack[0] + dy * crack[1] + dz * crack[2] - crack[3])
                        if dx * dx + dy * dy + dz * dz <= r * r and across <= plate[4] and from_crack >= crack[4]:
                            inside += 1
                    out[k, j, i] += bodies.density[b] * inside / points**3


def _directions(rng: np.random.Generator, n: int) -> F64:
    there = rng.normal(size=(n, 3))
    return np.asarray(there / np.linalg.norm(there, axis=1, keepdims=True))


def packed_bodies(rng: np.random.Generator, can: float, half: float) -> Bodies:
    """Balls and plates in a can of this inner radius and half height; plates and large balls are placed first.

    Small balls replace those that find no room.
    """
    volume = np.pi * can**2 * 2 * half
    radii: list[F64] = []
    for share, low, high, flat in (
        (PLATES, (SMALL + LARGE) / 2, LARGE, FLAT), (1 - PLATES, SMALL, LARGE, 1.0), (0.5, SMALL, 1.5 * SMALL, 1.0)
    ):  # fmt: skip
        drawn = rng.uniform(low, high, int(FILLED * volume / low**3) + 1)
        radii.append(-np.sort(-drawn[np.cumsum(_volume(drawn, flat)) <= share * FILLED * volume]))
    plates, radius = radii[0].size, np.concatenate(radii)
    plate = np.column_stack((_directions(rng, radius.size), np.zeros(radius.size), np.full(radius.size, np.inf)))
    plate[:plates, 4] = FLAT * radius[:plates]
    covers = [_cover(r, one) for r, one in zip(radius, plate, strict=True)]
    first = np.concatenate(([0], np.cumsum([len(cover) for cover in covers])))
    volumes = _volume(radius, np.where(np.arange(radius.size) < plates, FLAT, 1.0))
    centre = _place(rng, np.concatenate(covers), first, volumes, can, half, FILLED * volume)
    placed = ~np.isnan(centre[:, 0])
    n = int(placed.sum())
    return Bodies(centre[placed], radius[placed], rng.uniform(0.85, 1.0, n) - MATRIX, plate[placed], np.zeros((n, 5)))


def _volume(radius: F64, flat: float | F64) -> F64:
    """Volume of balls between two planes at `flat` radii from their middles."""
    return 2 * np.pi * radius**3 * (flat - flat**3 / 3)


def _cover(radius: float, plate: F64) -> F64:
    """Spheres [sphere, 4] that together contain a ball or plate at the origin."""
    half = float(plate[4])
    if half >= radius:
        return np.array([[0, 0, 0, radius]])
    step = 1.2 * half
    along = np.arange(-math.ceil(radius / step), math.ceil(radius / step) + 1) * step
    a, b = (grid.ravel() for grid in np.meshgrid(along, along))
    there = np.hypot(a, b) < radius + step / 4
    one = np.cross(plate[:3], np.eye(3)[np.argmin(np.abs(plate[:3]))])
    one /= np.linalg.norm(one)
    at = a[there, None] * one + b[there, None] * np.cross(plate[:3], one)
    return np.column_stack((at, np.full(len(at), math.hypot(half, step / math.sqrt(2)))))


def _cracked(rng: np.random.Generator, bodies: Bodies, controls: int = 5) -> tuple[Bodies, Planes]:
    """Add cracks to every second large ball, and choose `controls` planes in the same way in each of the others."""
    large = np.flatnonzero((bodies.radius > CRACKED) & (bodies.plate[:, 4] >= bodies.radius))
    with_crack, without = large[::2], np.repeat(large[1::2], controls)
    ball = np.concatenate((with_crack, without))
    normal, off = _directions(rng, ball.size), rng.uniform(-OFF, OFF, ball.size) * bodies.radius[ball]
    width = np.where(np.arange(ball.size) < with_crack.size, rng.uniform(*WIDTHS, ball.size), 0.0)
    cracks, n = bodies.crack.copy(), with_crack.size
    cracks[with_crack] = np.column_stack((normal[:n], off[:n], width[:n] / 2))
    across = np.sqrt(bodies.radius[ball] ** 2 - off**2)
    planes = Planes(bodies.centre[ball] + off[:, None] * normal, normal, across, width)
    return bodies._replace(crack=cracks), planes


def _packing_rng(cols: int, rows: int, over: float, packing: int) -> np.random.Generator:
    return np.random.default_rng([cols, rows, round(100 * over), *([packing] if packing else [])])


def _packed(
    cols: int, rows: int, over: float, geometry: Geometry, packing: int, with_cracks: bool = False, moved: float = 0.0
) -> Scene:
    rng, radius = _packing_rng(cols, rows, over, packing), can_radius(cols, over)
    bodies, planes = packed_bodies(rng, radius - THICK, rows / 2 + LARGE), None
    if with_cracks:
        bodies, planes = _cracked(rng, bodies)
    u, v = (((np.arange(n * SUB) + 0.5) / SUB - n / 2) for n in (cols, rows))
    clean = np.empty((geometry.n_views, rows, cols))
    for n, (view, angle) in enumerate(zip(clean, geometry.angles, strict=True)):
        at = u + moved * (n / (geometry.n_views - 1) - 0.5)
        outer, inner = (2 * np.sqrt(np.maximum(r**2 - at**2, 0)) for r in (radius, radius - THICK))
        lines = np.tile(WALL * (outer - inner) + MATRIX * inner, (v.size, 1))
        _add_view(bodies, angle, at, v, lines)
        view[:] = lines.reshape(rows, SUB, cols, SUB).mean((1, 3))
    x, z = ((np.arange(n) - (n - 1) / 2) for n in (cols, rows))
    away = np.hypot(u[:, None], u)
    can = np.where(away > radius, 0, np.where(away > radius - THICK, WALL, MATRIX))
    truth = np.tile(can.reshape(cols, SUB, cols, SUB).mean((1, 3)).astype(np.float32), (rows, 1, 1))
    _fill(bodies, x, z, 4, truth)
    scale = DEPTH / clean.max()
    levels = scale * MATRIX, scale * (MATRIX + float(bodies.density.mean()))
    return Scene(
        (scale * clean).astype(np.float32), truth * np.float32(scale), levels, radius - THICK, geometry, planes
    )


def _shapes(
    cols: int, rows: int, over: float, geometry: Geometry, packing: int, kind: str, densities: tuple[float, ...],
    matrix: float = MATRIX,
) -> Scene:  # fmt: skip
    rng, radius = _packing_rng(cols, rows, over, packing), can_radius(cols, over)
    half = rows / 2 * (1 + 1 / SOURCE if geometry.is_cone else 1) + LARGE
    around = packed_bodies(rng, radius - THICK, half)
    ball = around.plate[:, 4] >= around.radius
    bodies = shapes.shapes_of(rng, kind, around.centre[ball], around.radius[ball], densities)
    can = radius, radius - THICK, WALL, matrix
    clean, truth = shapes.views_of(bodies, can, geometry), shapes.truth_of(bodies, can, rows, cols)
    scale, levels = DEPTH / clean.max(), (matrix, matrix + float(bodies.density.mean()))
    return Scene(
        (scale * clean).astype(np.float32), truth * np.float32(scale), (scale * levels[0], scale * levels[1]),
        radius - THICK, geometry,
    )  # fmt: skip


def _rings(cols: int, rows: int, over: float, geometry: Geometry, packing: int) -> Scene:
    made, rng = _packed(cols, rows, over, geometry, packing), np.random.default_rng(packing)
    share = np.where(rng.uniform(size=(rows, cols)) < FEW, GAINS[1], GAINS[0])
    return replace(made, clean=made.clean + (share * rng.normal(size=(rows, cols))).astype(np.float32))


def _hardening(cols: int, rows: int, over: float, geometry: Geometry, packing: int) -> Scene:
    made = _packed(cols, rows, over, geometry, packing)
    seen = -np.log((np.exp(-(1 - SOFT) * made.clean) + np.exp(-(1 + SOFT) * made.clean)) / 2)
    return replace(made, clean=seen.astype(np.float32))


def can_radius(cols: int, over: float) -> float:
    """Outer radius in pixels of a can `over` times as wide as the field; `over` 1: a can that fits into the field."""
    return cols / 2 * (over if over > 1 else FIELD)


def _cathode(cols: int, rows: int, over: float, geometry: Geometry, packing: int, fringes: bool) -> Scene:
    """The simulator's cathode; its lengths grow with the columns; a wider one has more grains of the same size."""
    text = (Path(__file__).parents[2] / "configs" / "scenes" / "cathode.yaml").read_text(encoding="utf-8")
    keys = yaml.safe_load(text)["phantom"]
    factor = 2 * can_radius(cols, 1) * PITCH / keys["diameter"]
    larger = {name: factor * value for name, value in keys.items() if name.endswith("_um") or name == "height"}
    keys |= {**larger, "diameter": 2 * can_radius(cols, over) * PITCH, "seed": keys["seed"] + packing}
    # additional rows, because the fringes move intensity between rows
    sample, edge = build_sample("phantom", keys, Beam(1e5)), 2
    detector = Detector.centred(((rows + 2 * edge) * SUB, cols * SUB), PITCH / SUB)
    effect = PhaseFringes(DELTA_BETA, DISTANCE, ENERGY, method="transport")
    shot = shots.shot(detector=Detector.centred((rows + 2 * edge, cols), PITCH))
    clean = np.empty((geometry.n_views, rows, cols), np.float32)
    for view, angle in zip(clean, geometry.angles, strict=True):
        lines = sample.line_integrals(float(angle), detector).reshape(-1, SUB, cols, SUB).mean((1, 3))
        view[:] = (effect.apply(lines, shot) if fringes else lines)[edge:-edge]
    truth = sample.attenuation(Grid((rows, cols, cols), PITCH)) * np.float32(PITCH)
    grey = 2 * PITCH / keys["diameter"]  # see the simulator's GREY: electrolyte 0.15, grains 2.2
    inner = can_radius(cols, over) - keys["wall_um"] * 1e-3 / PITCH
    return Scene(clean, truth, (0.15 * grey, 2.2 * grey), inner, geometry)


SCENES: dict[str, Callable[[int, int, float, Geometry, int], Scene]] = {
    "cathode": partial(_cathode, fringes=False),
    "packed": _packed,
    "cracks": partial(_packed, with_cracks=True),
    "fringes": partial(_cathode, fringes=True),
    "drift": partial(_packed, moved=MOVED),
    "rings": _rings,
    "hardening": _hardening,
    "ellipsoids": partial(_shapes, kind="ellipsoids", densities=(0.65,)),
    "polyhedra": partial(_shapes, kind="polyhedra", densities=(0.35, 0.7)),
    "pores": partial(_shapes, kind="ellipsoids", densities=(-0.85,), matrix=0.85),
    "cone": partial(_shapes, kind="ellipsoids", densities=(0.65,)),
}
MOST = 180  # projections of a stored scan; 90 and 45 are every second and fourth of them


def scene_of(name: str, cols: int, rows: int, over: float, views: int, packing: int = 0) -> Scene:
    """A scene with projections over 180° (cone: 360°); stored in the temporary folder for reuse by the same code."""
    every = MOST // views if MOST % views == 0 else 1
    angles, shape = np.arange(views * every) * np.pi / (views * every), (rows, cols)
    source = SOURCE * cols
    geometry = (
        Geometry.cone(2 * angles, shape, 1.0, source, source) if name == "cone" else Geometry.parallel(angles, shape)
    )
    files = Path(__file__), Path(str(shapes.__file__))
    code = hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()[:12]
    kept = f"{name}_{cols}x{rows}_{over:g}_{geometry.n_views}_{packing}_{code}.npz"
    path = Path(tempfile.gettempdir()) / "first_users" / kept
    if not path.exists():
        made = SCENES[name](cols, rows, over, geometry, packing)
        planes = {} if made.planes is None else {f"plane_{key}": value for key, value in vars(made.planes).items()}
        path.parent.mkdir(exist_ok=True)
        part = path.with_suffix(f".{os.getpid()}.npz")
        np.savez(part, clean=made.clean, truth=made.truth, levels=made.levels, inner=made.inner, **planes)
        part.replace(path)
    with np.load(path) as file:
        planes = {key[6:]: file[key] for key in file.files if key.startswith("plane_")}
        matrix, grains = file["levels"].tolist()
        return Scene(
            np.ascontiguousarray(file["clean"][::every]), file["truth"], (matrix, grains), float(file["inner"]),
            geometry.select(slice(None, None, every)), Planes(**planes) if planes else None,
        )  # fmt: skip
