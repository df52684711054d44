"""Small analytic scans of all kinds, with and without a fault; test_findings.py stores their findings."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.storage.readers.base import Quantity
from tests.beamline.array_source import ArraySource
from tests.bench.clean_scans import lines_of

F64 = NDArray[np.float64]
SHAPE, AXIS, VIEWS = (20, 64), 31.2, 60
LIGHT, DARK, READ = 5000.0, 100.0, 1.5
HALF = np.linspace(0, np.pi, VIEWS, endpoint=False)

# x, y, z, radius in pixels, attenuation in 1/pixel
WITHIN: Any = [(0, 0, 0, 19, 0.01), (8, 4, 2, 5, 0.06), (-9, 6, -3, 4, 0.05), (-4, -11, 1, 4, 0.08)]
WIDE: Any = [(0, 0, 0, 60, 0.008), (10, 4, 2, 7, 0.04), (-13, 6, -3, 6, 0.05), (40, -5, 0, 9, 0.03)]
BESIDE: Any = [(20, 6, 0, 9, 0.05), (-6, 3, 2, 5, 0.05)]
ROUND: Any = [(0, 0, 0, 22, 0.02)]
FAINT: Any = [(0, 0, 0, 19, 0.0005), (8, 4, 2, 5, 0.002)]
OPAQUE: Any = [(0, 0, 0, 19, 0.1), (8, 4, 2, 5, 0.8)]


@dataclass
class Parts:
    """A scan before it is written: counts [frame, row, col], angles in radians, and the values stated in the file."""

    darks: F64
    flats: F64
    views: F64
    angles: F64
    last_flats: F64 = field(default_factory=lambda: np.zeros((0, *SHAPE)))
    exposures: F64 | None = None
    dtype: type = np.uint16
    quantity: Quantity = "counts"
    stated: dict[str, Any] = field(default_factory=dict)

    def source(self) -> ArraySource:
        groups = self.darks, self.flats, self.views, self.last_flats
        keys = np.repeat([2, 1, 0, 1], [len(group) for group in groups])
        frames = np.concatenate(groups)
        if np.issubdtype(self.dtype, np.integer):
            frames = frames.round().clip(np.iinfo(self.dtype).min, np.iinfo(self.dtype).max)
        angles = np.full(len(keys), np.nan)
        angles[keys == 0] = self.angles
        exposures = None if self.exposures is None else self.exposures[keys]
        if exposures is not None and self.exposures is not None and self.exposures.size > 3:
            exposures = self.exposures
        source = ArraySource(frames.astype(self.dtype), keys.tolist(), angles, exposures)
        source.quantity = self.quantity
        for name, value in self.stated.items():
            setattr(source, name, value)
        return source


def light_of(shape: tuple[int, int] = SHAPE) -> F64:
    row, col = (np.linspace(-1, 1, n) for n in shape)
    return LIGHT * np.exp(-0.2 * col**2 - 0.1 * row[:, None] ** 2)


def camera(light: F64, seed: int) -> F64:
    rng = np.random.default_rng(seed)
    return rng.poisson(light) + DARK + rng.normal(0, READ, light.shape)


def right(
    balls: Any = None, angles: F64 = HALF, axis: float = AXIS, sod: float | None = None, seed: int = 0, **change: Any
) -> Parts:
    """A correct scan of balls."""
    open_beam = np.broadcast_to(light_of(), (6, *SHAPE))
    lines = lines_of(np.array(WITHIN if balls is None else balls), angles, SHAPE, axis, sod, **change)
    parts = Parts(
        camera(0 * open_beam, seed),
        camera(open_beam, seed + 1),
        camera(open_beam[0] * np.exp(-lines), seed + 2),
        angles,
    )
    if sod is not None:
        parts.stated = {"cone": (sod * 0.001, 2 * sod * 0.001), "pixel_size_mm": 0.002}
    return parts


def turn(degrees: float, views: int = VIEWS, endpoint: bool = False) -> F64:
    return np.radians(np.linspace(0, degrees, views, endpoint=endpoint))


def passes(step: int) -> F64:
    return np.concatenate([HALF[at::step] for at in range(step)])


def shrinking(time: float, balls: Any) -> Any:
    return np.array(balls) * [1, 1, 1, 1 - 0.25 * time, 1]


def sinking(time: float, balls: Any) -> Any:
    return np.array(balls) + np.array([0, 0, 3.0 * (time > 0.5), 0, 0])


RIGHT: Mapping[str, Callable[[], Parts]] = {
    "half turn": lambda: right(),
    "half turn, wide": lambda: right(WIDE),
    "full turn": lambda: right(angles=turn(360)),
    "full turn, endpoint": lambda: right(angles=turn(360, 61, True)),
    "full turn, wide, axis at the side": lambda: right(WIDE, turn(360), axis=9.5),
    "cone": lambda: right(angles=turn(360), sod=200.0),
    "cone, wide": lambda: right(WIDE, turn(360), sod=300.0),
    "golden angles": lambda: right(angles=np.radians(np.arange(VIEWS) * 111.246 % 180)),
    "passes": lambda: right(angles=passes(4)),
    "backwards": lambda: right(angles=HALF[::-1].copy()),
    "limited angle": lambda: right(angles=turn(110)),
    "few views": lambda: right(angles=turn(180, 9)),
    "two turns": lambda: right(angles=turn(720, 90)),
    "each angle three times": lambda: right(angles=np.repeat(HALF[::3], 3)),
    "random angles": lambda: right(angles=np.sort(np.random.default_rng(4).uniform(0, np.pi, VIEWS))),
    "beside the axis": lambda: right(BESIDE),
    "round": lambda: right(ROUND),
    "faint": lambda: right(FAINT),
    "opaque": lambda: right(OPAQUE),
    "nothing": lambda: right([(0, 0, 0, 5, 0.0)]),
    "axis off": lambda: right(axis=40.3),
    "axis at the edge": lambda: right(axis=58.0),
}


Attack = Callable[[Parts], None]


def lit(parts: Parts, factors: Any, name: str = "views") -> None:
    """Multiply the intensity of each frame by a factor."""
    frames = getattr(parts, name)
    setattr(parts, name, (frames - DARK) * np.broadcast_to(factors, len(frames))[:, None, None] + DARK)


def put(name: str, change: Callable[[F64], F64]) -> Attack:
    """Replace frames."""
    return lambda parts: setattr(parts, name, change(getattr(parts, name).copy()))


def light(factors: Any, name: str = "views") -> Attack:
    return lambda parts: lit(parts, factors, name)


def stated(angles: Callable[[F64], Any]) -> Attack:
    """State angles (radians) that differ from the rotation of the sample."""
    return lambda parts: setattr(parts, "angles", np.asarray(angles(parts.angles), np.float64))


def some(at: Any, value: Any) -> Callable[[F64], F64]:
    def change(frames: F64) -> F64:
        frames[at] = value(frames[at]) if callable(value) else value
        return frames

    return change


def both(*attacks: Attack) -> Attack:
    def attack(parts: Parts) -> None:
        for each in attacks:
            each(parts)

    return attack


def with_sample(degrees: float, moved: float = 0.0, n: int = 6) -> Attack:
    """The sample is in all flats, or in the first one."""

    def attack(parts: Parts) -> None:
        lines = lines_of(np.array(WITHIN), np.radians([degrees]), SHAPE, AXIS + moved)[0]
        parts.flats[:n] = camera(light_of() * np.exp(-np.broadcast_to(lines, (n, *SHAPE))), 31)

    return attack


def exposed(darks: float, flats: float, views: float) -> Attack:
    """State exposure times in s of darks, flats and projections."""
    return lambda parts: setattr(parts, "exposures", np.array([views, flats, darks]))


def each_exposed(parts: Parts) -> None:
    """Projections with two alternating exposure times, flats without a stated exposure time."""
    seconds = np.where(np.arange(len(parts.views)) % 2, 0.1, 0.3)
    lit(parts, seconds / 0.3)
    parts.exposures = np.concatenate([np.full(len(parts.darks) + len(parts.flats), np.nan), seconds])


def scaled(dtype: type) -> Attack:
    """Scale each projection separately."""

    def attack(parts: Parts) -> None:
        low, high = (bound(parts.views, axis=(1, 2), keepdims=True) for bound in (np.min, np.max))
        whole = np.iinfo(dtype).max if np.issubdtype(dtype, np.integer) else 1
        parts.views, parts.dtype = (parts.views - low) / (high - low) * whole, dtype
        parts.darks, parts.flats = parts.darks[:0], parts.flats[:0]

    return attack


def transmission(parts: Parts) -> None:
    """Float images of transmission without flats and darks; air is 1."""
    parts.views, parts.dtype = (parts.views - DARK) / light_of(), np.float32
    parts.flats, parts.darks = np.ones_like(parts.flats[:1]), np.zeros_like(parts.darks[:1])


def integrals(parts: Parts) -> None:
    """Line integrals without flats and darks."""
    parts.views = -np.log(np.maximum((parts.views - DARK) / light_of(), 1e-3))
    parts.dtype, parts.quantity = np.float32, "line_integrals"
    parts.darks, parts.flats = parts.darks[:0], parts.flats[:0]


def last(n: int, factor: float = 1.0, change: Callable[[F64], F64] = lambda frames: frames) -> Attack:
    """A second group of flats at the end."""

    def attack(parts: Parts) -> None:
        flats = camera(np.broadcast_to(light_of(), (n, *SHAPE)) * factor, 77)
        parts.last_flats = change(flats)

    return attack


def crumb(parts: Parts) -> None:
    """A particle crosses the beam in ten projections."""
    for step, view in enumerate(range(20, 30)):
        parts.views[view, 6:10, 5 * step : 5 * step + 6] *= 0.7


def shaking(parts: Parts) -> None:
    away = np.random.default_rng(5).integers(-1, 2, len(parts.views))
    parts.views = np.stack([np.roll(view, by, axis=1) for view, by in zip(parts.views, away, strict=True)])


def jumps(cols: int, rows: int) -> Attack:
    return put("views", some(slice(30, None), lambda views: np.roll(views, (rows, cols), axis=(1, 2))))


def uneven(parts: Parts) -> None:
    """A slit in front of the right half in all flats and projections."""
    for name in ("flats", "views"):
        frames = getattr(parts, name)
        frames[:, :, 44:] = camera(0 * frames[:, :, 44:], 5)


ATTACKS: Mapping[str, Attack] = {
    # light
    "flats doubled": light(2.0, "flats"),
    "flats halved": light(0.5, "flats"),
    "flats a tenth brighter": light(1.1, "flats"),
    "flats a twentieth darker": light(0.95, "flats"),
    "sums of four frames": put("flats", lambda flats: 4 * flats),
    "views shifted by four bits": put("views", lambda views: 16 * views.round()),
    "views shifted by two bits": put("views", lambda views: 4 * views.round()),
    "an offset of signed numbers": put("views", lambda views: views + 32768),
    "flats multiplied by ten": light(10.0, "flats"),
    "darks above the views": put("darks", lambda darks: darks + 2500),
    "darks of zeros": put("darks", lambda darks: 0 * darks),
    "darks of one number": put("darks", lambda darks: 0 * darks + 100),
    "darks as bright as the flats": put("darks", lambda darks: darks + light_of()),
    "one dark with light": put("darks", some(2, lambda dark: dark + 0.3 * light_of())),
    "all darks with some light": put("darks", lambda darks: darks + 0.05 * light_of()),
    "flats of one number": put("flats", lambda flats: 0 * flats + 3500),
    "flats saturated": put("flats", lambda flats: 0 * flats + 65535),
    "flats at 12 bits": put("flats", lambda flats: np.minimum(flats, 4095)),
    "flats and views at one count": both(
        *(put(name, lambda part: np.minimum(part, 3000)) for name in ("flats", "views"))
    ),
    "views alone at one count": put("views", lambda views: np.minimum(views, 3000)),
    "dark and bright exchanged": put("views", lambda views: 2 * DARK + 1.1 * LIGHT - views),
    "a step of the light": light(np.r_[np.ones(25), 0.7 * np.ones(35)]),
    "two lights in turn": light(np.resize([1, 0.6], VIEWS)),
    "two lights in turn, also in flats": both(
        light(np.resize([1, 0.6], VIEWS)), light(np.resize([1, 0.6], 6), "flats")
    ),
    "three lights in turn": light(np.resize([1, 0.6, 0.3], VIEWS)),
    "a view of another light": light(np.where(np.arange(VIEWS) == 30, 1.4, 1.0)),
    "a drift of the light": light(np.linspace(1, 0.8, VIEWS)),
    "a drift of the light, flats at the end": both(light(np.linspace(1, 0.8, VIEWS)), last(6, 0.8)),
    "half a beam": light(0.5),
    "views without light": light(np.where(np.isin(np.arange(VIEWS), [7, 8, 40]), 0.0, 1.0)),
    "a closed shutter in most views": light(np.where(np.arange(VIEWS) > 20, 0.0, 1.0)),
    "views never written": put("views", some(slice(50, None), 0.0)),
    "few photons": both(light(0.002), light(0.002, "flats")),
    "no beam in the flats": light(0.0, "flats"),
    "flats that flicker": light(1 - 0.05 * np.arange(6), "flats"),
    "something moves in a flat": put("flats", some((0, slice(None), slice(0, 12)), lambda part: 0.5 * part)),
    "a slit": uneven,
    "flats with the sample in": with_sample(47.0),
    "flats with the sample beside its place": with_sample(20.0, 9.0),
    "first flat with the sample in": with_sample(47.0, n=1),
    "good flats, last ones with the sample": last(
        4, 1.0, lambda flats: DARK + (flats - DARK) * np.exp(-lines_of(np.array(WITHIN), np.ones(1), SHAPE, AXIS))
    ),
    "good flats, last ones dark": last(4, 0.0),
    "good flats, last ones weaker": last(4, 0.6),
    "no flats": lambda parts: setattr(parts, "flats", parts.flats[:0]),
    "no darks": lambda parts: setattr(parts, "darks", parts.darks[:0]),
    "one flat": lambda parts: setattr(parts, "flats", parts.flats[:1]),
    "exposures as they should be": exposed(0.1, 0.1, 0.1),
    "flats exposed for half, and half as bright": both(light(0.5, "flats"), exposed(0.1, 0.05, 0.1)),
    "flats stated for half, and as bright": exposed(0.1, 0.05, 0.1),
    "darks exposed longer": exposed(0.2, 0.1, 0.1),
    "views of two exposures, flats of none": each_exposed,
    "views scaled each by itself, 8 bits": scaled(np.uint8),
    "views scaled each by itself, real": scaled(np.float32),
    "transmission": transmission,
    "line integrals": integrals,
    "line integrals, darker by a tenth": both(integrals, put("views", lambda views: views + 0.1)),
    "line integrals with a view of zeros": both(integrals, put("views", some(30, 0.0))),
    # pixels
    "not a number in a view": both(
        lambda parts: setattr(parts, "dtype", np.float32), put("views", some((30, slice(0, 9)), np.nan))
    ),
    "a view without a number": both(
        lambda parts: setattr(parts, "dtype", np.float32), put("views", some(30, np.inf))
    ),
    "dead columns": both(*(put(name, some((..., slice(10, 12)), DARK)) for name in ("flats", "views"))),
    "hot pixels": both(*(put(n, some((..., slice(0, 20, 5), 9), 60000.0)) for n in ("darks", "flats", "views"))),
    "zingers": put("views", lambda views: views + 30000 * (np.random.default_rng(2).random(views.shape) < 3e-3)),
    "dark rows in some views": put("views", some((slice(20, 26), slice(4, 8)), DARK)),
    "the same view twice": put("views", lambda views: np.concatenate([views[:30], views[29:30], views[31:]])),
    "blurred views": put("views", some(slice(20, 26), lambda v: (v + np.roll(v, 2, 2) + np.roll(v, -2, 2)) / 3)),
    "a crumb crosses": crumb,
    # sample
    "a jump across": jumps(3, 0),
    "a jump down": jumps(0, 2),
    "a sample that shakes": shaking,
    "frames upside down": put("views", some(slice(1, None, 2), lambda views: views[:, ::-1])),
    "a rod in a few views": put("views", some((slice(20, 24), slice(None), slice(40, 44)), lambda part: 0.2 * part)),
    "upside down from the middle": put("views", some(slice(30, None), lambda views: views[:, ::-1])),
    # angles
    "degrees as radians": stated(np.degrees),
    "radians as degrees": stated(np.radians),
    "gradians": stated(lambda angles: angles / 0.9),
    "twice the angles": stated(lambda angles: 2 * angles),
    "half the angles": stated(lambda angles: angles / 2),
    "angles that count frames": stated(lambda angles: np.radians(np.arange(angles.size))),
    "angles 1.06 times": stated(lambda angles: 1.06 * angles),
    "angles shifted": stated(lambda angles: np.roll(angles, 10)),
    "angles of passes": stated(lambda angles: passes(4)),
    "angles shuffled": stated(lambda angles: np.random.default_rng(1).permutation(angles)),
    "angles not written at the end": stated(lambda angles: np.where(np.arange(angles.size) > 49, 0, angles)),
    "one wrong angle": stated(lambda angles: np.where(np.arange(angles.size) == 40, 0, angles)),
    "angles that stand": stated(lambda angles: np.repeat(angles[::6], 6)),
    "angles all the same": stated(lambda angles: 0 * angles + 0.5),
    "an angle that is missing": stated(lambda angles: np.where(np.arange(angles.size) == 40, np.nan, angles)),
    "halves exchanged": stated(lambda angles: np.roll(angles, angles.size // 2)),
    "angles of encoder counts": stated(lambda angles: angles * 1000),
    "angles beyond all": stated(lambda angles: angles * 1e6),
}  # fmt: skip

MOVING: Mapping[str, Callable[[], Parts]] = {
    "a sample that shrinks": lambda: right(angles=turn(720), change=shrinking),
    "a sample that shrinks in half a turn": lambda: right(change=shrinking),
    "a sample that sinks": lambda: right(change=sinking),
    "passes taken, even angles stated": lambda: replaced(right(angles=passes(4)), angles=HALF),
    "a full turn as half of one": lambda: replaced(right(angles=turn(360)), angles=HALF),
    "half a turn as a full one": lambda: replaced(right(), angles=turn(360)),
}


def replaced(parts: Parts, **values: Any) -> Parts:
    for name, value in values.items():
        setattr(parts, name, value)
    return parts


def attacked(name: str, balls: Any = None) -> Parts:
    parts = right(balls)
    ATTACKS[name](parts)
    return parts


SCANS: Mapping[str, Callable[[], Parts]] = {
    **RIGHT,
    **{name: (lambda name=name: attacked(name)) for name in ATTACKS},  # type: ignore[misc]
    **{f"{name}, wide": (lambda name=name: attacked(name, WIDE)) for name in ATTACKS},  # type: ignore[misc]
    **MOVING,
}
"""Functions that make the scans, by name."""
