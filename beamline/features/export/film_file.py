"""Films: grey images in an animated GIF, or in an MP4 where there is ffmpeg; and the Gaussians as a PLY file."""

from __future__ import annotations

import math
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import GifImagePlugin, Image

from beamline.core.errors import ConfigError, DataError
from beamline.core.files import whole_file
from beamline.core.sinks import Warn
from beamline.gaussians import Model
from beamline.projections.correction import NoViewError, ScanCorrection
from beamline.projections.selection import Selection
from beamline.storage.readers.base import ScanSource
from beamline.storage.recon_record import ReconRecord
from drivers.base.frame import FrameKind
from recon.base.arrays import some_values
from recon.base.greys import matter_window
from recon.base.views import spread

F32 = NDArray[np.float32]
MOST_IMAGES = 600  # of a film: of more slices or views every second, third ... is shown
HELD_BYTES = 2**28  # bytes of the images across y or x that one pass over the volume fills
_LOOKED_AT, _VALUES = 9, 2**18  # slices or views, and values of each, that tell the grey window
_GIF_TICK = 0.01  # s; a GIF states the time of an image in whole ones


@dataclass(frozen=True)
class FilmImages:
    """The images of a film as arrays, read one after another.

    Attributes:
        shown: which slices along the axis, or frames of the scan, in the order of the film.
        read: their values, float32 [row, col] each.
        samples: values [row, col] of a few of them, or of slices along z, which tell the grey window.
        ratio: height of a pixel over its width.
    """

    shown: Sequence[int]
    read: Callable[[], Iterator[F32]]
    samples: Callable[[], Iterator[F32]]
    ratio: float = 1.0


@dataclass(frozen=True)
class FilmStyle:
    """Style of a film.

    Attributes:
        side: pixels of the longer side of an image, at most. Images are never enlarged.
        fps: images a second.
        window: values that become black and white; None: by 99.8 % of the values of a few images.
    """

    side: int = 640
    fps: float = 20.0
    window: tuple[float, float] | None = None


@dataclass(frozen=True)
class WrittenFilm:
    """A written film: number of images, their shape (rows, cols), images a second, and the grey window."""

    images: int
    shape: tuple[int, int]
    fps: float
    window: tuple[float, float]


def thinned(n: int) -> range:
    """Every k-th of n images, at most MOST_IMAGES."""
    return range(0, n, math.ceil(n / MOST_IMAGES))


def slices_along(record: ReconRecord, axis: int, side: int) -> FilmImages:
    """The slices of a volume along an axis (0, 1, 2: z, y, x), index 0 at the top left.

    The volume is read slice by slice along z. Of images across y or x, as many are held as fit `HELD_BYTES`; the
    volume is read once more for the next.
    """
    data, grid = record.volume.data, record.volume.grid
    shown, (pitch_z, _, pitch) = thinned(grid.shape[axis]), grid.spacing

    def slice_at(z: int) -> F32:
        return np.asarray(data[z : z + 1][0], np.float32)

    def lines(z: int, part: Sequence[int]) -> F32:
        return slice_at(z)[part] if axis == 1 else slice_at(z)[:, part].T

    def across() -> Iterator[F32]:
        at_once = max(1, HELD_BYTES // (4 * grid.shape[0] * cols))
        for first in range(0, len(shown), at_once):
            part = shown[first : first + at_once]
            images = np.empty((len(part), grid.shape[0], cols), np.float32)
            for z in range(grid.shape[0]):
                images[:, z] = resized(lines(z, part), (len(part), cols))
            yield from images

    width = grid.shape[3 - axis] if axis else grid.shape[2]
    cols = min(width, side)
    looked_at = spread(np.arange(grid.shape[0]), _LOOKED_AT).tolist()
    return FilmImages(
        shown=shown,
        read=across if axis else lambda: map(slice_at, shown),
        samples=lambda: map(slice_at, looked_at),
        ratio=pitch_z / pitch * cols / width if axis else 1.0,
    )


def write_film(path: Path, images: FilmImages, style: FilmStyle, progress: Callable[[int, int], None]) -> WrittenFilm:
    """Write a film in the format that the suffix of `path` names, image by image: as a whole, or not at all.

    Args:
        progress: is told how many of how many images are written.

    Raises:
        DataError: `path` exists, the disk refuses, or ffmpeg failed.
        ConfigError: an MP4 without ffmpeg, or images of one value, which have no grey window.
    """
    write, fps = _writers[path.suffix.lower()](style.fps)
    low, high = window = style.window or _window(images.samples())

    written = 0

    def greys() -> Iterator[NDArray[np.uint8]]:
        nonlocal written
        for written, image in enumerate(images.read(), 1):
            values = np.nan_to_num(resized(image, _size(image.shape, images.ratio, style.side)), nan=low)
            yield np.rint(255 * ((np.clip(values, low, high) - low) / (high - low))).astype(np.uint8)
            progress(written, len(images.shown))

    with whole_file(path) as partial:
        shape = write(partial, greys())
    return WrittenFilm(written, shape, fps, window)


def resized(image: F32, shape: tuple[int, int]) -> F32:
    """The image averaged down to a shape (rows, cols)."""
    if image.shape == shape:
        return image
    whole = Image.fromarray(np.ascontiguousarray(image, np.float32))
    return np.asarray(whole.resize(shape[::-1], Image.Resampling.BOX))


def _size(shape: tuple[int, ...], ratio: float, side: int) -> tuple[int, int]:
    """(rows, cols) in the film of an image whose pixels are `ratio` times as high as wide."""
    rows, cols = shape[0] * ratio, shape[1]
    scale = min(1.0, side / max(rows, cols))
    return max(1, round(rows * scale)), max(1, round(cols * scale))


def _window(some: Iterator[F32]) -> tuple[float, float]:
    values = [some_values(image, _VALUES) for image in some]
    finite = np.concatenate([part[np.isfinite(part)] for part in values])
    if not finite.size or finite.min() == finite.max():
        low = float(finite[0]) if finite.size else 0.0
        raise ConfigError(
            f"Every value of the {len(values)} images looked at is {low:g}, or not finite: give --window LOW:HIGH. "
            "Nothing was written."
        )
    return matter_window(finite)


_Write = Callable[[Path, Iterator[NDArray[np.uint8]]], tuple[int, int]]


def _gif(fps: float) -> tuple[_Write, float]:
    """The writer of a GIF, and the images a second that it can state: 100, 50, 33.3, 25, 20 ..."""
    ticks = max(2, round(1 / fps / _GIF_TICK))  # browsers show what is faster than 50 a second at 10 a second

    def write(path: Path, greys: Iterator[NDArray[np.uint8]]) -> tuple[int, int]:
        shape = (0, 0)
        with path.open("wb") as file:
            for n, grey in enumerate(greys):
                image = Image.fromarray(grey)
                if n == 0:
                    shape = grey.shape
                    file.writelines(GifImagePlugin.getheader(image, info={"loop": 0, "optimize": False})[0])
                file.writelines(GifImagePlugin.getdata(image, duration=round(1000 * ticks * _GIF_TICK)))
            file.write(b";")
        return shape

    return write, 1 / (ticks * _GIF_TICK)


def _mp4(fps: float) -> tuple[_Write, float]:
    """The writer of an MP4 by ffmpeg, which gets the images through a pipe."""
    program = shutil.which("ffmpeg")
    if program is None:
        raise ConfigError("Writing an .mp4 needs the program ffmpeg, which is not on the PATH: install it, or name "
                          "a .gif. Nothing was written.")  # fmt: skip

    def write(path: Path, greys: Iterator[NDArray[np.uint8]]) -> tuple[int, int]:
        first = next(greys)
        rows, cols = first.shape
        words = [program, "-loglevel", "error", "-nostdin", "-f", "rawvideo", "-pix_fmt", "gray", "-s",
                 f"{cols}x{rows}", "-r", f"{fps:g}", "-i", "-", "-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2",
                 "-pix_fmt", "yuv420p", "-f", "mp4", "-y", str(path)]  # fmt: skip
        with tempfile.TemporaryFile() as complaints:
            ffmpeg = subprocess.Popen(words, stdin=subprocess.PIPE, stderr=complaints)
            assert ffmpeg.stdin is not None
            try:
                with ffmpeg.stdin:
                    for grey in chain((first,), greys):
                        ffmpeg.stdin.write(grey.tobytes())
            except BrokenPipeError:
                pass
            except BaseException:
                ffmpeg.kill()
                raise
            finally:
                code = ffmpeg.wait()
            if code:
                complaints.seek(0)
                why = complaints.read().decode(errors="replace").strip().splitlines()
                raise DataError(f"ffmpeg could not make the film ({why[-1] if why else code}). Nothing was written.")
        return rows, cols

    return write, fps


_writers: dict[str, Callable[[float], tuple[_Write, float]]] = {".gif": _gif, ".mp4": _mp4}


_BYTES = 2**26  # of views that are corrected together
_LOOKED_AT_VIEWS = 9  # views that tell the grey window


def views_by_angle(source: ScanSource, side: int, warn: Warn) -> FilmImages:
    """Corrected views of a scan by angle, binned if that leaves `side` pixels or more; unlit views are omitted.

    Raises:
        DataError: it has no view whose angle is known; while the images are read: none of these views can be used.
    """
    views = np.flatnonzero((source.image_key == FrameKind.PROJECTION) & np.isfinite(source.angles))
    if not views.size:
        raise DataError(f"{source.path} has no projection whose angle is known. Nothing was written.")
    views = views[np.argsort(source.angles[views], kind="stable")]
    shown = views[list(thinned(views.size))].tolist()
    binning = max(1, max(source.shape) // side)
    correction = ScanCorrection(source, Selection(binning=min(binning, *source.shape)), warn)
    at_once = max(1, _BYTES // (4 * source.shape[0] * source.shape[1]))

    def images(frames: Sequence[int]) -> Iterator[NDArray[np.float32]]:
        unusable, given = None, 0
        for first in range(0, len(frames), at_once):
            batch = np.sort(np.asarray(frames[first : first + at_once], np.int64))
            try:
                corrected = correction.at_once(batch)
            except NoViewError as error:
                unusable = error
                continue
            by_frame = dict(zip(corrected.view_ids.tolist(), corrected.data, strict=True))
            given += len(by_frame)
            yield from (by_frame[frame] for frame in frames[first : first + at_once] if frame in by_frame)
        if unusable is not None and not given:
            raise unusable

    few = spread(np.asarray(shown), _LOOKED_AT_VIEWS).tolist()
    height, width = source.row_pitch_mm, source.pixel_size_mm
    ratio = 1.0 if height is None or width is None else height / width
    return FilmImages(shown, lambda: images(shown), lambda: images(few), ratio)


def write_ply(path: Path, model: Model) -> None:
    """The Gaussians as a binary PLY: x y z, scale_0..2 (standard deviations), rot_0..3 (w x y z), density.

    Raises:
        DataError: `path` exists, or the disk refuses; nothing is left.
    """
    arrays, unit = model.gaussians.physical(), model.record.length_unit
    names = ("x", "y", "z", *(f"scale_{k}" for k in range(3)), *(f"rot_{k}" for k in range(4)), "density")
    columns = (arrays["centres"], arrays["widths"], arrays["rotations"], arrays["densities"][:, None])
    rows = np.concatenate(columns, axis=1).astype("<f4")
    head = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment lengths in {unit}, densities in {model.record.unit}, kernel {model.gaussians.kernel}",
        f"element vertex {len(rows)}",
        *(f"property float {name}" for name in names),
        "end_header",
    ]
    with whole_file(path) as partial, partial.open("wb") as file:
        file.write(("\n".join(head) + "\n").encode())
        file.write(rows.tobytes())
