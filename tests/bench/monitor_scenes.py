"""Scenes for the monitor's detection rates: difficult clean scans, and anomalies of a stated strength, without files.

Frames come from the simulator and are processed as in a scan. Anomalies come from the simulator's effects, whose labels
state their positions. Anomalies for which there is no effect (dark rows, a step of the gain) are added to the counts
here.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import gaussian_filter

from beamline.monitor.digest import FrameDigest, digest
from drivers.base.frame import Frame, FrameKind
from simulators.effects.beam.open_beam import Ghost, LostBeam
from simulators.effects.catalogue import Domain
from simulators.effects.chain import AnomalyLabel, AnyEffect, Chain
from simulators.effects.detector.pixels import Zingers
from simulators.effects.scattering.deflected import Floaters
from simulators.effects.stage.errors import Jump
from simulators.frame.shot import Detector, Image, Pose, Shot, fixed_rng
from simulators.samples.sample import Sample
from simulators.scenes.expose import Scan, expose
from simulators.scenes.scene import Scene, load_scene

ROWS, COLS, PITCH = 128, 512, 2.6  # um
WIDTH, HEIGHT = COLS * PITCH * 1e-3, ROWS * PITCH * 1e-3
SATURATION = 65535
BIN = 4
LIGHT = {"photons_per_s": 1.0e5}
SENSOR: tuple[Any, ...] = (
    "photon_noise",
    "dark_current",
    {"kind": "hot_pixels", "fraction": 2.0e-4, "rate": 2000.0, "seed": 3},
    {"kind": "zingers", "rate": 5.0},
    "read_noise",
    "offset",
)
PROFILE = {"kind": "beam_profile", "sigma": [1.6, 0.8], "stripes": 0.03, "stripe_period": 0.09, "drift": 2.0e-5}


def battery(width: float = 1.2, n_particles: int = 400, seed: int = 11) -> dict[str, Any]:
    """A battery that fills all rows, as a part of a longer can does."""
    return {"kind": "battery", "field_of_view": [width, 1.2], "n_particles": n_particles, "seed": seed}


def scene(
    phantom: Mapping[str, Any], *effects: Any, beam: Mapping[str, float] = LIGHT, views: int = 900, **more: Any
) -> dict[str, Any]:
    detector = {"shape": [ROWS, COLS], "pixel_size_um": PITCH, "exposure_s": 0.05} | more.pop("detector", {})
    scan = {"views": views, "range_deg": 180.0, "period_s": 0.1, "darks": 10, "flats": 10}
    return {"phantom": dict(phantom), "beam": dict(beam), "axis_offset_px": 3.4, "detector": detector, "scan": scan} | {
        "effects": list(effects) + more.pop("sensor", list(SENSOR))
    }


def _solids(*solids: Mapping[str, Any]) -> dict[str, Any]:
    return {"kind": "solids", "solids": list(solids)}


SPARSE = _solids(
    {"kind": "cylinder", "radius": 0.6, "height": 1.2, "attenuation": 1.5},  # a tube: its bore is subtracted
    {"kind": "cylinder", "radius": 0.57, "height": 1.2, "attenuation": -1.5},
    {"kind": "ellipsoid", "semi_axes": [0.03, 0.03, 0.03], "attenuation": 9.0, "centre": [0.4, 0.1, 0.02]},
    {"kind": "ellipsoid", "semi_axes": [0.02, 0.02, 0.02], "attenuation": 9.0, "centre": [-0.2, 0.45, -0.05]},
    {"kind": "box", "edges": [0.12, 0.1, 0.14], "attenuation": 4.0, "centre": [-0.2, -0.12, 0.05]},
)
FLAT_FACES = _solids(  # faces along the beam, so that the silhouette changes abruptly
    {"kind": "box", "edges": [0.9, 0.5, 1.2], "attenuation": 1.5},
    {"kind": "box", "edges": [0.3, 0.1, 0.14], "attenuation": 5.0, "centre": [-0.2, -0.12, 0.05]},
)

CLEAN: dict[str, Callable[[int], dict[str, Any]]] = {
    # n = 0, 1, ... gives different samples
    "battery": lambda n: scene(battery(seed=100 + n), PROFILE, {"kind": "ring_current", "lifetime": 36000.0}),
    "coarse": lambda n: scene(battery(seed=200 + n), PROFILE, views=180),
    "sparse": lambda n: scene(SPARSE, PROFILE),
    "faces": lambda n: scene(FLAT_FACES, PROFILE),
    "interior": lambda n: scene(battery(3.0, 1500, seed=300 + n), PROFILE),  # dense particles enter by rotation
    "top_up": lambda n: scene(
        battery(seed=400 + n),
        {"kind": "ring_current", "lifetime": 3600.0, "top_up_every": 36.0, "refill": (2.0, 0.0)[n % 2]},
    ),
    "starved": lambda n: scene(battery(seed=500 + n), PROFILE, beam={"photons_per_s": 1200.0}),
    "fringes": lambda n: scene(
        battery(seed=600 + n),
        {"kind": "phase_fringes", "delta_beta": 4.0, "distance": 30.0, "energy": 8.3485, "method": "wave"},
        views=450,
    ),
    "rings": lambda n: scene(
        battery(seed=700 + n),
        PROFILE,
        {"kind": "flat_structure", "specks": 500, "radius_um": 8.0},
        "prnu",
        sensor=[
            "photon_noise",
            "dark_current",
            {"kind": "hot_pixels", "fraction": 1.0e-3, "rate": 4000.0, "seed": n},
            {"kind": "zingers", "rate": 40.0},
            {"kind": "dead_pixels", "fraction": 2.0e-4, "seed": n},
            "read_noise",
            "offset",
        ],
    ),
    "shaky": lambda n: scene(
        battery(seed=800 + n),
        {"kind": "runout", "radial": [[2, 0.2, 30.0]], "radial_random_um": 0.1, "axial_random_um": 0.1},
        PROFILE | {"wander": [0.0, 1.0e-3]},
    ),
}
"""Clean scans, by the difficulty they contain."""


class Remembered:
    """A sample whose line integrals are stored for each pose, so that many scans take the time of one."""

    def __init__(self, sample: Sample) -> None:
        self._sample, self._kept = sample, dict[bytes, NDArray[np.float32]]()

    @property
    def radius(self) -> float:
        return self._sample.radius

    @property
    def names(self) -> tuple[str, ...]:
        return self._sample.names

    def line_integrals(self, angle: ArrayLike | Pose, detector: Detector) -> NDArray[np.float64]:
        if not isinstance(angle, Pose):
            return self._sample.line_integrals(angle, detector)
        parts = (angle.angle, angle.shift, angle.tilt)
        key = repr(detector).encode() + b"".join(b"-" if part is None else part.tobytes() for part in parts)
        if key not in self._kept:
            self._kept[key] = self._sample.line_integrals(angle, detector).astype(np.float32)
        return self._kept[key].astype(np.float64)

    def __getattr__(self, name: str) -> Any:
        if name in ("attenuation", "labels"):
            return getattr(self._sample, name)
        raise AttributeError(name)


@dataclass(frozen=True)
class Several:
    """Several effects of one kind combined, because a scene may contain each kind only once."""

    parts: tuple[Any, ...]

    name: ClassVar[str] = "several"
    final: ClassVar[bool] = False

    @property
    def domain(self) -> Domain:
        return self.parts[0].domain

    def apply(self, image: Image, shot: Shot) -> Image:
        for part in self.parts:
            image = part.apply(image, shot)
        return image

    def labels(self, shot: Shot) -> Sequence[AnomalyLabel]:
        return [replace(label, which=i) for i, part in enumerate(self.parts) for label in part.labels(shot)]


@dataclass(frozen=True)
class Steps:
    """The intensity or the gain changes by `share` at one projection and stays. The label is for that projection."""

    view: int
    share: float

    name: ClassVar[str] = "steps"
    domain: ClassVar[Domain] = Domain.PHOTONS
    final: ClassVar[bool] = False

    def apply(self, image: Image, shot: Shot) -> Image:
        if shot.sample and shot.view >= self.view:
            image *= 1 + self.share
        return image

    def labels(self, shot: Shot) -> Sequence[AnomalyLabel]:
        rows, cols = shot.detector.shape
        return [AnomalyLabel("gain", (0, rows, 0, cols))] if shot.sample and shot.view == self.view else []


@dataclass(frozen=True)
class Blurred:
    """The intensity is blurred by a Gaussian of (down, across) pixels in a range of projections."""

    sigma: tuple[float, float]
    views: tuple[int, int]

    name: ClassVar[str] = "blurred"
    domain: ClassVar[Domain] = Domain.PHOTONS
    final: ClassVar[bool] = False

    def apply(self, image: Image, shot: Shot) -> Image:
        if shot.sample and self.views[0] <= shot.view < self.views[1]:
            image[:] = gaussian_filter(image, self.sigma, mode="nearest")
        return image

    def labels(self, shot: Shot) -> Sequence[AnomalyLabel]:
        rows, cols = shot.detector.shape
        shown = shot.sample and self.views[0] <= shot.view < self.views[1]
        return [AnomalyLabel("blur", (0, rows, 0, cols))] if shown else []


@dataclass(frozen=True)
class DarkLines:
    """Rows or columns without intensity in a range of projections; the offset and its noise stay."""

    lines: slice
    axis: int
    views: tuple[int, int]
    share: float = 0.0

    name: ClassVar[str] = "dark_lines"
    domain: ClassVar[Domain] = Domain.PHOTONS
    final: ClassVar[bool] = False

    def apply(self, image: Image, shot: Shot) -> Image:
        if shot.sample and self.views[0] <= shot.view < self.views[1]:
            image[self.lines if self.axis == 0 else (slice(None), self.lines)] *= self.share
        return image

    def labels(self, shot: Shot) -> Sequence[AnomalyLabel]:
        if not (shot.sample and self.views[0] <= shot.view < self.views[1]):
            return []
        rows, cols = shot.detector.shape
        ends = self.lines.start, self.lines.stop
        return [AnomalyLabel("band", (*ends, 0, cols) if self.axis == 0 else (0, rows, *ends))]


@dataclass(frozen=True)
class Storm:
    """Zingers in a range of projections, in addition to those of the scene."""

    zingers: Zingers
    views: tuple[int, int]

    name: ClassVar[str] = "storm"
    domain: ClassVar[Domain] = Domain.ELECTRONS
    final: ClassVar[bool] = False

    def apply(self, image: Image, shot: Shot) -> Image:
        return self.zingers.apply(image, shot) if self.labels(shot) else image

    def labels(self, shot: Shot) -> Sequence[AnomalyLabel]:
        rows, cols = shot.detector.shape
        shown = shot.sample and self.views[0] <= shot.view < self.views[1]
        return [AnomalyLabel("zingers", (0, rows, 0, cols))] if shown else []


Make = Callable[[np.random.Generator, int], Any]
"""Function that draws an anomaly from a generator, for a scan with a given number of projections."""
CALIBRATION = 40  # projections before the first anomaly


def _views(rng: np.random.Generator, views: int, least: int = CALIBRATION, spare: int = 30) -> int:
    return int(rng.integers(min(least, views // 4), views - spare))


def floater(radius: float, depth: float, motion: str = "turning", away: tuple[float, float] = (1.5, 3.75)) -> Make:
    """A cloud with the standard deviation of a ball of `radius` px (radius / 2 along each axis), `depth` at its middle.

    "turning": `away` times as far from the axis as the edge of the frame; loose: it moves 2 to 20 px per projection.
    """

    def make(rng: np.random.Generator, views: int) -> Floaters:
        seed, half = int(rng.integers(2**31)), WIDTH / 2
        distance, size = (away[0] * half, away[1] * half), radius / 2 * PITCH * 1e-3
        share = fixed_rng("floaters", seed).uniform(0.5, 1.0, 4)[3]  # the fourth draw, as in Floaters.crumbs
        speed, first = float(rng.uniform(2, 20)) * PITCH * 1e-3, _views(rng, views)
        span = int(2 * WIDTH / speed) + 1
        return Floaters(
            distance=distance,
            count=1,
            size=(size, size),
            depth=depth / share,
            heights=(-0.4 * HEIGHT, 0.4 * HEIGHT),
            motion="turning" if motion == "turning" else "loose",
            speed=speed,
            views=None if motion == "turning" else (first, first + span),
            seed=seed,
        )

    return make


def ghost(gain: float) -> Make:
    """A ghost that is an eighth to a third of the frame wide and crosses it in 10 to 60 projections."""

    def make(rng: np.random.Generator, views: int) -> Ghost:
        width = WIDTH * rng.uniform(0.125, 0.33)
        speed = (WIDTH + 2 * width) / rng.uniform(10, 60)
        return Ghost(_views(rng, views, spare=70), width, speed, gain * rng.choice([-1, 1]))

    return make


def jump(pixels: float, down: bool) -> Make:
    """A jump across the beam (at the angle at which it happens) or vertically."""

    def make(rng: np.random.Generator, views: int) -> Jump:
        view = _views(rng, views)
        angle, um = math.pi * view / views, pixels * PITCH * rng.choice([-1, 1])
        across = (um * math.cos(angle), um * math.sin(angle), 0.0)
        return Jump(view, (0.0, 0.0, um) if down else across)

    return make


def gain(share: float) -> Make:
    return lambda rng, views: Steps(_views(rng, views), share * rng.choice([-1, 1]))


def lost(share: float) -> Make:
    def make(rng: np.random.Generator, views: int) -> LostBeam:
        first = _views(rng, views)
        return LostBeam((first, first + int(rng.integers(1, 20))), share=share)

    return make


def blur(down: float, across: float) -> Make:
    def make(rng: np.random.Generator, views: int) -> Blurred:
        first = _views(rng, views)
        return Blurred((down, across), (first, first + int(rng.integers(1, 20))))

    return make


def band(lines: int, axis: int) -> Make:
    def make(rng: np.random.Generator, views: int) -> DarkLines:
        at, first = int(rng.integers((ROWS, COLS)[axis] - lines)), _views(rng, views)
        return DarkLines(slice(at, at + lines), axis, (first, first + int(rng.integers(1, 20))))

    return make


def storm(share: float, charge: float) -> Make:
    """`share` zingers per pixel on average, with `charge` electrons on average (exponentially distributed)."""

    def make(rng: np.random.Generator, views: int) -> Storm:
        first = _views(rng, views)
        zingers = Zingers(share * ROWS * COLS / 0.05, charge=charge)  # 0.05 s is the exposure of `scene`
        return Storm(zingers, (first, first + int(rng.integers(1, 20))))

    return make


@dataclass(frozen=True, eq=False)
class Seen:
    """A frame as the monitor sees it, with its labels."""

    frame: Frame
    digest: FrameDigest
    labels: Sequence[AnomalyLabel]


def with_anomalies(base: Scene, anomalies: Sequence[Any]) -> Scene:
    """The scene with anomalies inserted before the noise, each in its domain."""
    effects: list[AnyEffect] = list(base.chain.effects)
    for domain in {anomaly.domain for anomaly in anomalies}:
        added = [anomaly for anomaly in anomalies if anomaly.domain == domain]
        at = next(
            (
                i
                for i, effect in enumerate(effects)
                if effect.domain > domain or (effect.final and effect.domain == domain)
            ),
            len(effects),
        )
        effects[at:at] = added if domain == Domain.MOTION else [cast(AnyEffect, Several(tuple(added)))]
    return replace(base, chain=Chain(tuple(effects)))


def seen(scene: Scene, seed: int, preview_bin: int = BIN, views: Sequence[int] | None = None) -> Iterator[Seen]:
    """The frames of a scan of the scene, or only some `views` after the darks and flats."""
    row, scan = 0, Scan.of(scene, seed)
    for planned in scan:
        shot, projection = planned.shot, planned.kind is FrameKind.PROJECTION
        if projection and views is not None and shot.view not in views:
            continue
        counts = expose(scene, shot)
        angle = shot.angle if projection else math.nan
        trigger = shot.view - (views[0] if views else 0) if projection else row
        frame = Frame(counts, planned.kind, row, trigger, row, angle, shot.time, shot.exposure)
        row += 1
        yield Seen(frame, digest(counts, SATURATION, preview_bin), scene.chain.labels(shot))


def base_scene(name: str, n: int) -> Scene:
    read = load_scene(CLEAN[name](n))
    return replace(read, sample=Remembered(read.sample))
