"""Any one field of geometry changed in a file, with the frames as that field says, gives the volume or a refusal.

The frames of the scan are those that an instrument with that pixel, distance, mirror or order would have written. What
is reconstructed is within 0.5 dB of the plain scan; what is refused names the cause.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray

import recon
from beamline.core.errors import ConfigError, DataError
from beamline.projections.corrections.air import Air
from beamline.projections.selection import Selection
from recon.base.volume import Volume
from tests.beamline.prepared_views import prepare
from tests.slow_cases import others_slow

# (x, y, z, radius) in mm, and 1/mm; the field is 4 x 2.4 mm
BALLS = (
    (0.0, 0.0, 0.0, 1.1, 0.4),
    (0.5, 0.2, 0.3, 0.35, 0.5),
    (-0.4, 0.5, -0.3, 0.3, -0.3),
    (-0.3, -0.5, 0.2, 0.25, 0.8),
)
ROWS, COLS, VIEWS, PITCH = 24, 40, 72, 0.1
DARK, BEAM = 100.0, 30000.0


@dataclass(frozen=True)
class Instrument:
    """The frames of BALLS: pixels (width, height) in mm, a cone's (sod, sdd), and how the file stores them."""

    pixel: tuple[float, float] = (PITCH, PITCH)
    cone: tuple[float, float] | None = None
    turn: float = 180.0
    store: Callable[[NDArray[Any]], NDArray[Any]] = field(default=lambda frames: frames)

    @property
    def degrees(self) -> NDArray[np.float64]:
        return np.arange(VIEWS) * self.turn / VIEWS

    @property
    def shape(self) -> tuple[int, int]:
        return round(ROWS * PITCH / self.pixel[1]), COLS

    def frames(self) -> NDArray[np.uint16]:
        """[dark, flat, views]."""
        rows, cols = self.shape
        scale = 1.0 if self.cone is None else self.cone[1] / self.cone[0]
        sub = (np.arange(2) + 0.5) / 2 - 0.5
        u = ((np.arange(cols) - (cols - 1) / 2)[:, None] + sub).ravel() * self.pixel[0] * scale
        v = ((np.arange(rows) - (rows - 1) / 2)[:, None] + sub).ravel() * self.pixel[1] * scale
        out = [np.zeros((rows, cols)) + 50, np.zeros((rows, cols))]
        for theta in np.radians(self.degrees):
            across, along = np.array([np.cos(theta), np.sin(theta), 0]), np.array([-np.sin(theta), np.cos(theta), 0])
            target = u[None, :, None] * across + v[:, None, None] * np.array([0, 0, 1.0])
            if self.cone is None:
                start, ray = target, along + 0 * target
            else:
                start = 0 * target - self.cone[0] * along
                ray = target + self.cone[1] * along
                ray = ray / np.linalg.norm(ray, axis=-1, keepdims=True)
            total = np.zeros(target.shape[:2])
            for x, y, z, radius, mu in BALLS:
                to = np.array([x, y, z]) - start
                near = (to * to).sum(-1) - (to * ray).sum(-1) ** 2
                total += 2 * mu * np.sqrt(np.clip(radius**2 - near, 0, None))
            out.append(total.reshape(rows, 2, cols, 2).mean((1, 3)))
        counts = np.random.default_rng(5).poisson(BEAM * np.exp(-np.array(out))) + DARK
        return self.store(counts.astype(np.uint16))


Put = tuple[str, Any, str | None]


def nxtomo(path: Path, made: Instrument, *more: Put) -> Path:
    scale = 1.0 if made.cone is None else made.cone[1] / made.cone[0]
    places: dict[str, tuple[Any, str | None]] = {
        "instrument/detector/data": (made.frames(), None),
        "instrument/detector/image_key": (np.r_[2, 1, [0] * VIEWS], None),
        "instrument/detector/x_pixel_size": (made.pixel[0] * scale, "mm"),
        "instrument/detector/y_pixel_size": (made.pixel[1] * scale, "mm"),
        "sample/rotation_angle": (np.r_[0, 0, made.degrees], "degree"),
    }
    if made.cone is not None:
        places["instrument/source/distance"] = -made.cone[0] * 1e-3, "m"
        places["instrument/detector/distance"] = made.cone[1] - made.cone[0], "mm"
    places |= {where: (value, units) for where, value, units in more}
    with h5py.File(path, "w") as file:
        entry = file.create_group("entry")
        for where, (value, units) in places.items():
            if value is not None:
                entry[where] = value
                if units is not None:
                    entry[where].attrs["units"] = units
    return path


def volume(path: Path) -> Volume:
    """By the direct method, in mm."""
    prepared, _ = prepare(path, Selection(steps=(Air("none"),)))
    assert prepared.origin.length_unit == "mm"
    return prepared.with_true_heights(recon.reconstruct(prepared.seen.data, prepared.geometry, "fbp").volume)


def psnr(path: Path) -> float:
    """dB of the volume in 1/mm against BALLS, at the heights of its slices."""
    made = volume(path)
    return float(10 * np.log10(0.8**2 / np.mean((made.data - _truth(made)) ** 2)))


def _truth(made: Volume) -> NDArray[np.float64]:
    sub = (np.arange(3) + 0.5) / 3 - 0.5
    z, y, x = (
        (at[:, None] + sub * edge).ravel() for at, edge in zip(made.grid.coordinates(), made.grid.spacing, strict=True)
    )
    out = np.zeros((z.size, y.size, x.size))
    for bx, by, bz, radius, mu in BALLS:
        inside = (x - bx) ** 2 + (y[:, None] - by) ** 2 + (z[:, None, None] - bz) ** 2 < radius**2
        out += mu * inside
    nz, ny, nx = made.grid.shape
    return out.reshape(nz, 3, ny, 3, nx, 3).mean((1, 3, 5))


PLAIN = Instrument()
CONE = Instrument(cone=(12.0, 30.0), turn=360.0)
ANGLE = "sample/rotation_angle"
DETECTOR = "instrument/detector"


@pytest.fixture(scope="module")
def expected(tmp_path_factory: pytest.TempPathFactory) -> float:
    found = psnr(nxtomo(tmp_path_factory.mktemp("plain") / "s.nx", PLAIN))
    assert found > 27
    return found


SAME: dict[str, tuple[Instrument, tuple[Put, ...]]] = {
    "pixels at the sample": (
        PLAIN,
        (
            (f"{DETECTOR}/x_pixel_size", 1.0, "mm"), (f"{DETECTOR}/y_pixel_size", 1.0, "mm"),
            ("sample/x_pixel_size", 100.0, "um"), ("sample/y_pixel_size", 100.0, "um"),
        ),
    ),
    "pixels twice as high": (replace(PLAIN, pixel=(PITCH, 2 * PITCH)), ()),
    "pixels half as high": (replace(PLAIN, pixel=(PITCH, PITCH / 2)), ()),
    "mirrored": (replace(PLAIN, store=lambda f: f[..., ::-1]), ((f"{DETECTOR}/x_flipped", True, None),)),
    "a cone": (CONE, ()),
    "a cone without a sign": (CONE, (("instrument/source/distance", 1.2, "cm"),)),
    "a source far away": (PLAIN, (("instrument/source/distance", -52.0, "m"), (f"{DETECTOR}/distance", 30.0, "mm"))),
    "two turns more": (PLAIN, ((ANGLE, np.r_[0, 0, PLAIN.degrees + 720], "degree"),)),
    "subtract whole turns": (PLAIN, ((ANGLE, np.r_[0, 0, (PLAIN.degrees + 300) % 360 - 300], "degree"),)),
    "backwards": (
        replace(PLAIN, store=lambda f: f[np.r_[0, 1, 73:1:-1]]),
        ((ANGLE, np.r_[0, 0, PLAIN.degrees[::-1]], "degree"),),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", others_slow(SAME, 2))
def test_a_field_that_is_used_gives_the_volume(tmp_path: Path, expected: float, name: str) -> None:
    made, more = SAME[name]
    assert psnr(nxtomo(tmp_path / "s.nx", made, *more)) > expected - 0.5


REFUSED: dict[str, tuple[Instrument, tuple[Put, ...], str]] = {
    "radians as degrees": (PLAIN, ((ANGLE, np.radians(np.r_[0, 0, PLAIN.degrees]), "degree"),), "look like radians"),
    "a detector before the sample": (CONE, ((f"{DETECTOR}/distance", -5.0, "mm"),), "-5 mm behind it"),
    "high pixels of a cone": (CONE, ((f"{DETECTOR}/y_pixel_size", 0.5, "mm"),), "a cone beam needs square pixels"),
    "a pixel of a metre": (PLAIN, ((f"{DETECTOR}/x_pixel_size", 1.0, "m"),), "pixel"),
}


@pytest.mark.parametrize("name", others_slow(REFUSED))
def test_a_field_that_cannot_be_is_refused_by_its_name(tmp_path: Path, name: str) -> None:
    made, more, said = REFUSED[name]
    with pytest.raises((DataError, ConfigError), match=said):
        psnr(nxtomo(tmp_path / "s.nx", made, *more))


def test_the_height_of_a_pixel_is_the_distance_of_slices(tmp_path: Path) -> None:
    grid = volume(nxtomo(tmp_path / "s.nx", replace(PLAIN, pixel=(PITCH, 2 * PITCH)))).grid
    assert grid.spacing == pytest.approx((2 * PITCH, PITCH, PITCH))
    assert grid.shape == (ROWS // 2, COLS, COLS)
