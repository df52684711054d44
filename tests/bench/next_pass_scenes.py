"""Twenty fixed scenes of scans in passes: ten for development, ten to be used once.

Lengths are in detector pixels (voxels have the same size), densities in 1/pixel. A scan has 128 columns x 8 rows and
720 projections over 180° in 8 interlaced passes. Line integrals are means of nine rays per pixel, with the noise of the
given number of photons per pixel in the open beam. A sample that is wider than the field also has laterally offset
projections: at 4 angles it is moved by 0.9 of the field to either side. A drifting sample moves steadily across the
beam by `DRIFT` pixels from the first projection to the last. A particle crosses the field in `CRUMBED` projections of
the third pass; these are flagged, and no volume uses them unless they were repeated.

The ground truth is the density, averaged over each voxel; for a drifting sample, at its position in the first
projection. Projections with fringes show more than the density: bright rims, which a volume from more projections shows
better, and which are not an error. So the ground truth of such a scene is the density plus the contribution of the
fringes to a volume without noise. This contribution is the FISTA-TV volume of noiseless projections with fringes at
twice as many angles, minus that without fringes, clipped at 0 like the evaluated volumes. The volume with fringes alone
would not be suitable: it is the limit of the method itself and contains no error of the method, so gains would seem
larger than in scenes without fringes. FBP of the fringes alone would not be suitable either, because it is smoother
than the volumes of the methods, and all of them differ more from it with more projections.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

import recon
from beamline.plan.plan import interlaced
from recon.base.geometry import Geometry
from recon.base.volume import Grid
from simulators.effects.catalogue import load_effect
from simulators.effects.chain import ImageEffect
from simulators.frame.shot import Detector, Pose
from simulators.light import Beam
from simulators.samples.composed import build_sample
from simulators.samples.sample import Sample
from tests.simulators import shots

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
COLS, ROWS, VIEWS, PASSES, WIDE_ANGLES = 128, 8, 720, 8, 4
PASS = VIEWS // PASSES
PITCH, FIELD, SUB, EDGE = 4.6e-3, 0.96, 3, 2
"""Pixel in mm; width of a fitting sample / field; rays per pixel and axis; extra pixels, because fringes move
intensity."""
DRIFT, CRUMBED, CRUMB_DEPTH, CRUMB_SIZE = 0.1, range(200, 224), 0.8, 6.0
PARTICLE, TALL = 6.0, 100.0
"""Batteries: median radius of a particle, and height of the electrolyte."""


@dataclass(frozen=True)
class Recipe:
    """A scene; `over`: width of the sample / field, `photons`: per pixel in the open beam."""

    sample: str
    over: float = 1.0
    photons: float = 2e4
    fringes: bool = False
    drift: bool = False
    crumb: bool = False

    def __str__(self) -> str:
        size = f", {self.over:g} x field" if self.over > 1 else ""
        extra = "".join(f", {name}" for name in ("fringes", "drift", "crumb") if getattr(self, name))
        return f"{self.sample}{size}, {self.photons:.0e} photons{extra}".replace("e+0", "e")


RECIPES = (
    Recipe("battery"),
    Recipe("battery", photons=2e3, fringes=True),
    Recipe("battery", 1.5, 2e3),
    Recipe("battery", 2.0),
    Recipe("battery", crumb=True),
    Recipe("cathode", photons=2e3),
    Recipe("cathode", fringes=True),
    Recipe("cathode", 1.5),
    Recipe("cathode", 2.0, 2e3),
    Recipe("cathode", drift=True),
    Recipe("battery", photons=2e3),
    Recipe("battery", fringes=True),
    Recipe("battery", 1.5),
    Recipe("battery", 2.0, 2e3),
    Recipe("battery", drift=True),
    Recipe("cathode"),
    Recipe("cathode", photons=2e3, fringes=True),
    Recipe("cathode", 1.5, 2e3),
    Recipe("cathode", 2.0),
    Recipe("cathode", crumb=True),
)
DEV, ONCE = range(10), range(10, 20)
OPTICS = {"battery": (5.0, 30.0, 8.3485), "cathode": (90.0, 10.0, 25.0)}
"""delta/beta, distance in mm and energy in keV of the fringes, as in the shipped scenes.

The cathode is nearer: at 30 mm, some pixels at its rims would have no intensity left, and no meaningful line integral.
"""


@dataclass(frozen=True, eq=False)
class Scene:
    """A scan without noise.

    Attributes:
        clean: line integrals [view, row, col] in the order of acquisition, then of the offset projections; without
            particle.
        crumb: [view, row, col], contribution of the particle to the projections `CRUMBED`; empty in other scenes.
        truth: ground truth [z, y, x], see the module.
        geometry: of the projections, then of the offset ones.
    """

    clean: F32
    crumb: F32
    truth: F32
    geometry: Geometry


def geometry_of(over: float, angles: F64) -> Geometry:
    """Geometry at these angles, with the offset projections of a sample that is wider than the field."""
    places = (-0.9 * COLS, 0.9 * COLS) if over > 1 else ()
    wide = np.arange(WIDE_ANGLES) * np.pi / WIDE_ANGLES
    shifts = np.zeros((angles.size + len(places) * WIDE_ANGLES, 2))
    shifts[angles.size :, 0] = np.repeat(places, WIDE_ANGLES)
    return Geometry.parallel(np.concatenate((angles, *(wide for _ in places))), (ROWS, COLS), shifts=shifts)


def mapping_of(recipe: Recipe, number: int) -> dict[str, object]:
    """The phantom as keys of a scene; a wider sample has more grains of the same size."""
    radius = COLS / 2 * (recipe.over if recipe.over > 1 else FIELD)
    if recipe.sample == "battery":
        inside = 0.95 * radius
        particles = round(0.12 * inside**2 * TALL / (4 / 3 * PARTICLE**3))
        size = [2 * radius * PITCH / 0.88, TALL * PITCH / 0.9]
        return {"kind": "battery", "field_of_view": size, "n_particles": particles, "seed": 70 + number}
    text = (Path(__file__).parents[2] / "configs" / "scenes" / "cathode.yaml").read_text(encoding="utf-8")
    keys: dict[str, object] = yaml.safe_load(text)["phantom"]
    factor = COLS * FIELD * PITCH / float(str(keys["diameter"]))
    larger = {k: factor * float(str(value)) for k, value in keys.items() if k.endswith("_um") or k == "height"}
    return keys | larger | {"diameter": 2 * radius * PITCH, "seed": 70 + number}


def _lines(sample: Sample, geometry: Geometry, moved: F64, fringes: ImageEffect | None) -> tuple[F32, F32 | None]:
    """Line integrals [view, row, col] of a sample that is displaced by `moved` [view] pixels, with fringes."""
    rows, cols = ROWS + 2 * EDGE, COLS + 2 * EDGE
    shot = shots.shot(detector=Detector.centred((rows, cols), PITCH))
    plain = np.empty((geometry.n_views, ROWS, COLS), np.float32)
    fringed = None if fringes is None else np.empty_like(plain)
    for k, (angle, shift) in enumerate(zip(geometry.angles, geometry.shifts[:, 0] + moved, strict=True)):
        fine = Detector.centred((rows * SUB, cols * SUB), PITCH / SUB)
        pose = Pose.turned(angle, rows * SUB).shifted_by([shift * PITCH, 0, 0])
        lines = sample.line_integrals(pose, fine).reshape(rows, SUB, cols, SUB).mean((1, 3))
        plain[k] = lines[EDGE:-EDGE, EDGE:-EDGE]
        if fringes is not None and fringed is not None:
            fringed[k] = fringes.apply(lines, shot)[EDGE:-EDGE, EDGE:-EDGE]
    return plain, fringed


def made(number: int) -> Scene:
    """Compute the scene of this number."""
    recipe = RECIPES[number]
    sample = build_sample("phantom", mapping_of(recipe, number), Beam(1e5))
    phase_fringes = load_effect("phase_fringes")
    fringes = phase_fringes(*OPTICS[recipe.sample], method="transport") if recipe.fringes else None
    truth = sample.attenuation(Grid((ROWS, COLS, COLS), PITCH)) * np.float32(PITCH)
    geometry = geometry_of(recipe.over, interlaced(VIEWS, PASSES))
    moved = np.zeros(geometry.n_views)
    if recipe.drift:
        moved[:VIEWS] = DRIFT * np.arange(VIEWS) / (VIEWS - 1)
    plain, fringed = _lines(sample, geometry, moved, fringes)
    if fringes is not None:
        truth = np.maximum(truth + _shown_by(fringes, sample), 0)
    crumb = _crumb(number) if recipe.crumb else np.zeros((0, ROWS, COLS), np.float32)
    return Scene(plain if fringed is None else fringed, crumb, truth.astype(np.float32), geometry)


def _shown_by(fringes: ImageEffect, sample: Sample) -> F32:
    """[z, y, x] contribution of fringes to a volume of noiseless projections at twice as many angles."""
    twice = Geometry.parallel(np.arange(2 * VIEWS) * np.pi / (2 * VIEWS), (ROWS, COLS))
    without, with_fringes = _lines(sample, twice, np.zeros(2 * VIEWS), fringes)
    assert with_fringes is not None
    volumes = (recon.reconstruct(views, twice, "fista-tv").volume.data for views in (with_fringes, without))
    return np.subtract(*volumes)


def _crumb(number: int) -> F32:
    """The line integrals of a particle that crosses the field in the projections `CRUMBED`."""
    rng = np.random.default_rng(number)
    height, side = rng.uniform(0, ROWS), rng.choice((-1, 1))
    at = side * np.linspace(-COLS / 2, COLS / 2, len(CRUMBED)) + COLS / 2
    across = np.exp(-0.5 * ((np.arange(COLS) - at[:, None]) / CRUMB_SIZE) ** 2)
    down = np.exp(-0.5 * ((np.arange(ROWS) - height) / CRUMB_SIZE) ** 2)
    return (CRUMB_DEPTH * down[:, None] * across[:, None]).astype(np.float32)


def scene_of(number: int) -> Scene:
    """A scene; it is stored in the temporary folder for reuse by the same code."""
    code = hashlib.sha256(Path(__file__).read_bytes()).hexdigest()[:12]
    kept = Path(tempfile.gettempdir()) / "next_pass" / f"{number}_{code}.npz"
    geometry = geometry_of(RECIPES[number].over, interlaced(VIEWS, PASSES))
    if not kept.exists():
        scene = made(number)
        kept.parent.mkdir(exist_ok=True)
        part = kept.with_suffix(f".{os.getpid()}.npz")
        np.savez(part, clean=scene.clean, crumb=scene.crumb, truth=scene.truth)
        part.replace(kept)
    with np.load(kept) as file:
        return Scene(file["clean"], file["crumb"], file["truth"], geometry)


def noisy(number: int, scene: Scene, seed: int, take: int = 0) -> F32:
    """Line integrals [view, row, col] with photon noise; seeds and takes change only the noise.

    Take 0 contains the particle. Repeated projections are takes 1, 2, ..., with other noise and without the particle.
    """
    photons, lines = RECIPES[number].photons, scene.clean.copy()
    if scene.crumb.size and take == 0:
        lines[CRUMBED.start : CRUMBED.stop] += scene.crumb
    counts = np.random.default_rng([number, seed, take]).poisson(photons * np.exp(-lines.astype(np.float64)))
    return -np.log(np.maximum(counts, 1) / photons).astype(np.float32)


def open_beam(number: int, seed: int, frames: int = 20) -> F32:
    """Line integrals [frame, row, col] of frames without the sample (only noise)."""
    photons = RECIPES[number].photons
    counts = np.random.default_rng([number, seed, 99]).poisson(photons, (frames, ROWS, COLS))
    return -np.log(np.maximum(counts, 1) / counts.mean(axis=0)).astype(np.float32)
