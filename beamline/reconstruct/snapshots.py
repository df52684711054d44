"""Snapshots of a growing volume, and slices of its views: a file and a picture, each replacing the last in one step."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.events import Sink
from beamline.core.files import write_whole
from beamline.core.recon_events import SlicesDrawn, SnapshotWritten
from beamline.core.sinks import Warnings
from beamline.plan.plan import one_way
from beamline.projections.correction import ScanCorrection
from beamline.reconstruct.followed_views import FollowedViews
from beamline.reconstruct.options import ReconOptions
from beamline.report.figures import GreyWindow, bright_centre, grey_window, round_length
from beamline.storage.readers.base import ScanSource
from beamline.storage.recon_record import ReconRecord
from beamline.storage.writers.recon_file import write_reconstruction
from drivers.base.clock import Clock
from recon.base.arrays import F32
from recon.base.greys import matter_window
from recon.base.noise import noise_level
from recon.base.views import spread
from recon.base.volume import Volume
from recon.prep.correct import Projections
from recon.splatting.anytime import BetterVolume
from recon.splatting.stream import StreamingFit
from recon.voxels.direct import Fbp
from recon.voxels.slices import OrthogonalSlices, orthogonal_slices
from recon.voxels.view_weights import Wedge, unseen_wedges

if TYPE_CHECKING:
    from PIL.Image import Image
    from PIL.ImageDraw import ImageDraw
    from PIL.ImageFont import FreeTypeFont


class Snapshots:
    """The files `<output>.snapshot.h5` and `<output>.live.png` of a followed scan."""

    def __init__(self, options: ReconOptions, source: ScanSource, sink: Sink, clock: Clock, warn: Warnings) -> None:
        self._options, self._source, self._sink, self._clock, self._warn = options, source, sink, clock, warn
        self._begin = clock.now()
        self._sample = str(source.attributes.get("sample", "not stated"))
        output = options.target.output
        self.path: Path = output.with_name(f"{output.stem}.snapshot.h5")
        self.picture_path = options.target.live_picture
        self.drawn = False  # the picture is of this scan
        self._slices: tuple[PictureRow, ...] = ()  # of the picture, as drawn last: by FBP, and of the volume
        self._grown: tuple[PictureRow, ...] = ()
        self._at: Sequence[float] | None = None  # z, y and x of the slices by FBP
        self._unseen: Wedge | None = None  # of the views of these slices
        self._unit = "mm" if source.pixel_size_mm or options.selection.pixel_size_mm else "px"

    def write(self, fit: StreamingFit, axis_col: float) -> None:
        """Write the current volume and its picture, replacing the last ones."""
        shown = fit.shown()
        (method, errors), unseen = self._method(shown), self._unseen
        record = ReconRecord(
            volume=shown.volume,
            length_unit=self._unit,
            raw_file=str(self._source.path.resolve()),
            title=f"Snapshot from {fit.n_views} views",
            sample=self._sample,
            time=self._clock.now(),
            parameters={
                "axis_col": axis_col,
                "n_views": fit.n_views,
                "method": method,
                "chosen_because": _why(errors),
                "unseen_deg": np.array(
                    [] if unseen is None else np.degrees((unseen.first, unseen.first + unseen.size))
                ),
            },
        )
        try:
            write_reconstruction(self.path, record, replace=True)
            self._grown = self._rows(fit, record.volume, f"{method}, {_why(errors)}")
            self._write_picture()
        except DataError as error:
            # Windows does not replace a file that a viewer holds open: the next snapshot will.
            self._warn(f"A snapshot could not be written: {error}")
            return
        now = self._clock.now()
        written = self.path, self.picture_path, fit.n_views, now - self._begin, fit.unlearnt
        self._sink(SnapshotWritten(*written, method, errors or None, time=now))

    def write_slices(self, slices: OrthogonalSlices, n_views: int, heading: str, unseen: Wedge | None) -> None:
        """Write the picture with these slices by FBP above the last drawn slices of the volume, if there are any."""
        self._at, self._unseen = slices.at, unseen
        panels = _slice_panels(slices.images, slices.at, slices.pixel, self._unit, unseen)
        self._slices = (PictureRow(heading, panels),)
        try:
            self._write_picture()
        except DataError as error:
            self._warn(f"A picture could not be written: {error}")
            return
        self._sink(SlicesDrawn(self.picture_path, n_views, math.degrees(slices.covered), time=self._clock.now()))

    def remove(self) -> None:
        """Remove the snapshot after the final volume is written. The live picture stays."""
        with suppress(PermissionError):  # Windows removes no file that a viewer holds open
            self.path.unlink(missing_ok=True)

    def _method(self, shown: BetterVolume) -> tuple[str, dict[str, float]]:
        """Whose volume is shown, and the errors of both in views held out; none where they were not compared."""
        fit, found = self._options.streaming.name, shown.errors
        errors = {fit: found.fit, Fbp.name: found.direct} if math.isfinite(found.direct) else {}
        return Fbp.name if shown.direct else fit, errors

    def _rows(self, fit: StreamingFit, volume: Volume, shown: str) -> tuple[PictureRow, ...]:
        heading = (
            f"{fit.n_views} views so far by {shown}; {fit.progress().n_gaussians} Gaussians, "
            f"{self._clock.now() - self._begin:.0f} s after the first look"
        )
        return volume_rows(volume, *fit.newest_view(), heading, self._unit, (self._at, self._unseen))

    def _write_picture(self) -> None:
        write_whole(self.picture_path, live_picture((*self._slices, *self._grown)), replace=True)
        self.drawn = True


def _why(errors: Mapping[str, float]) -> str:
    """Why a method's volume is shown, for people."""
    if not errors:
        return "the only one so far"
    each = ", ".join(f"{name} {error:.3f}" for name, error in errors.items())
    return f"which predicts views held out better (error of the volume along them: {each})"


_GAP, _LINE, _LETTER = 14, 15, 9  # pixels: between panels, a line of text, a letter of a heading at most
_SIDE = 256  # pixels: the longest side of an image is so long, to twice that; a label takes as much room
_SIGMAS, _MOST = 5.0, 99.0  # least range of the differences, and the percentile that it reaches: shapes stay seen
_ORANGE = (255, 127, 14)
_DIAL = 0.08  # radius of the dial of unseen rays, of the side of an image


@dataclass(frozen=True, eq=False)
class PictureRow:
    """Panels side by side under a heading; "" for none."""

    heading: str
    panels: Sequence[_Panel]


def live_picture(rows: Sequence[PictureRow]) -> bytes:
    """The rows as PNG, without axes and layout, which would take ten times as long: it is drawn during the fit."""
    from PIL import Image, ImageDraw

    across = max(_SIDE, *(panel.pixels.shape[1] for row in rows for panel in row.panels)) + _GAP
    tall = [max(panel.pixels.shape[0] for panel in row.panels) for row in rows]
    headings = [wrap(row.heading, (3 * across - _GAP) // _LETTER) for row in rows]
    above = sum((1 + len(lines)) * _LINE for lines in headings if lines)
    size = 3 * across + _GAP, sum(tall) + len(rows) * (2 * _LINE + _GAP) + above + _GAP
    picture, top, file = Image.new("RGB", size, "white"), 0, io.BytesIO()
    for row, lines, pixels in zip(rows, headings, tall, strict=True):
        for line in lines:
            top += _LINE
            ImageDraw.Draw(picture).text((_GAP, top), line, "black", _font(13, bold=True))
        top += _LINE * bool(lines)
        for k, panel in enumerate(row.panels):
            panel.draw(picture, _GAP + k * across, top + _GAP)
        top += _GAP + 2 * _LINE + pixels
    picture.save(file, "PNG", compress_level=1)
    return file.getvalue()


@cache
def _font(size: int, bold: bool = False) -> FreeTypeFont:
    """A font with arrows, of so many pixels."""
    import matplotlib
    from PIL import ImageFont

    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(Path(matplotlib.get_data_path(), "fonts", "ttf", name), size)


def volume_rows(
    volume: Volume, view: F32, render: F32, heading: str, unit: str,
    drawn: tuple[Sequence[float] | None, Wedge | None] = (None, None),
) -> tuple[PictureRow, PictureRow]:  # fmt: skip
    """Slices of a volume; the newest view, the projection of the volume at its angle, their difference.

    Args:
        volume: so far, 1/unit.
        view, render: the newest view [row, col] and the same view of the volume, line integrals.
        heading: of the whole, one line.
        unit: of length, "mm" or "px".
        drawn: z, y and x of the slices (None: through what is bright), and the wedge of angles without views.
    """
    place, unseen = drawn
    grid, data = volume.grid, volume.data
    if place is None:
        k, j, i = (1 + n // 100 for n in data.shape)  # the middle of what is bright need not be known to a voxel
        z, y, x = np.multiply((k, j, i), bright_centre(data[::k, ::j, ::i])).tolist()
    else:
        z, y, x = (int(np.abs(axis - to).argmin()) for axis, to in zip(grid.coordinates(), place, strict=True))
    at = [axis[i] for axis, i in zip(grid.coordinates(), (z, y, x), strict=True)]
    panels = _slice_panels((data[z], data[:, y], data[:, :, x]), at, grid.voxel_size, unit, unseen)
    return PictureRow(heading, panels), PictureRow("", _view_panels(view, render))


def _slice_panels(
    images: Sequence[F32], at: Sequence[float], pixel: float, unit: str, unseen: Wedge | None = None
) -> list[_Panel]:
    """Slices across z, y and x at these places, in the same greys."""
    window = matter_window(*images)
    grey = f"{window[0]:.3g} to {window[1]:.3g} 1/{unit}"
    labels = f"x → y ↓ at z = {at[0]:.3g} {unit}", f"x → z ↓ at y = {at[1]:.3g}", f"y → z ↓ at x = {at[2]:.3g}"
    notes = (grey, "the same greys and scale", "the same greys and scale")
    pixels, zoom = _sized(images)
    bar = pixel / zoom, unit
    return [
        _Panel(image, window, label, note, None if k else bar, unseen=None if k else unseen)
        for k, (image, label, note) in enumerate(zip(pixels, labels, notes, strict=True))
    ]


def _view_panels(view: F32, render: F32) -> list[_Panel]:
    window = grey_window([view], 0.5, 99.5)
    noise = noise_level(view[None]) or 0.01 * (window[1] - window[0])
    difference = (view - render) / np.float32(noise)
    greys = f"line integral {window[0]:.3g} to {window[1]:.3g}"
    reach = max(_SIGMAS, float(np.percentile(np.abs(difference), _MOST)))
    spread = f"black {-reach:.2g} to white {reach:.2g}; RMS {math.sqrt(float(np.mean(difference**2))):.2f}"
    (view, render, difference), _ = _sized((view, render, difference))
    return [
        _Panel(view, window, "newest view, u → z ↓", greys),
        _Panel(render, window, "the fit seen from there", "the same greys"),
        _Panel(difference, (-reach, reach), "difference in noise of a pixel", spread),
    ]


@dataclass(frozen=True, eq=False)
class _Panel:
    """An image, row 0 at the top, below two lines of text.

    Attributes:
        pixels: of the screen [row, col].
        limits: values that are black and white.
        label, note: the two lines.
        bar: width of a pixel and its unit, for a bar of a round length; None: no bar.
        unseen: for a dial of the rays in a slice across z that no view has taken yet; None: no dial.
    """

    pixels: F32
    limits: GreyWindow
    label: str
    note: str
    bar: tuple[float, str] | None = None
    unseen: Wedge | None = None

    def draw(self, picture: Image, left: int, top: int) -> None:
        """Draw it so many pixels from the left and the top of the picture, which is where its text begins."""
        from PIL import Image, ImageDraw

        draw = ImageDraw.Draw(picture)
        for line, (text, colour) in enumerate(((self.label, "black"), (self.note, "#595959"))):
            draw.text((left, top + line * _LINE), text, colour, _font(11))
        top += 2 * _LINE
        shares = (self.pixels - self.limits[0]) / (self.limits[1] - self.limits[0])
        picture.paste(Image.fromarray((255 * np.clip(shares, 0, 1)).astype(np.uint8)), (left, top))
        if self.bar is not None:
            pixel, unit = self.bar
            length = round_length(pixel * self.pixels.shape[1] / 3)  # a third of the image at most
            x, y = left + 6, top + self.pixels.shape[0] - 6
            draw.line((x, y, x + length / pixel, y), _ORANGE, 4)
            draw.text((x, y - 18), f"{length:g} {unit}", _ORANGE, _font(11, bold=True))
        if self.unseen is not None:
            self._dial(draw, left + self.pixels.shape[1] - 6, top + 6, self.unseen)

    def _dial(self, draw: ImageDraw, right: int, top: int, unseen: Wedge) -> None:
        """Rays in a slice (y downwards) that no view has taken yet, as a double wedge: edges along them are unknown."""
        side = 2 * _DIAL * min(self.pixels.shape)
        place, (first, last) = (right - side, top, right, top + side), unseen.rays
        draw.ellipse(place, outline="#999999")
        for turn in (0, 180):  # a ray runs both ways
            draw.pieslice(place, first + turn, last + turn, _ORANGE)
        draw.text((right - side - 4, top), "rays to come", _ORANGE, _font(11), anchor="ra")


def _sized(images: Sequence[F32]) -> tuple[list[F32], float]:
    """The images with pixels repeated, or means of several, so that the longest side is _SIDE pixels or more, less than
    twice as many. Then how many pixels one became."""
    longest = max(max(image.shape) for image in images)
    if longest < _SIDE:
        factor = math.ceil(_SIDE / longest)
        return [np.repeat(np.repeat(image, factor, 0), factor, 1) for image in images], factor
    step = longest // _SIDE
    return [_means(image, step) for image in images], 1 / step


def _means(image: F32, step: int) -> F32:
    """Means of step x step pixels, or of as many as there are; what is left over at the ends is left out."""
    rows, cols = (max(1, n // step) for n in image.shape)
    each = min(step, image.shape[0]), min(step, image.shape[1])
    cut = image[: rows * each[0], : cols * each[1]]
    return cut.reshape(rows, each[0], cols, each[1]).mean(axis=(1, 3))


_FEWEST, _BEFORE_AXIS = 8, 32  # views; of them, those that are corrected before the axis is known


class LiveSlices:
    """Draws the slices when there are new views and enough time has passed; drawing takes at most half of the time."""

    def __init__(self, views: FollowedViews, snapshots: Snapshots, clock: Clock) -> None:
        self._views, self._snapshots, self._clock = views, snapshots, clock
        self._newest, self._next = -1, -math.inf  # the last view drawn; the time from which they are drawn again

    def draw(self, parts: Sequence[Projections], axis_col: float | None, pause: float | None, of: int = 0) -> None:
        """Draw slices of corrected views about the axis (a column of the file; None: the middle of the detector).

        Views of a cone, or that lean or climb, have no slices.

        Args:
            pause: s until they are drawn again, at least; None: they are drawn now.
            of: number of views so far; 0 where `parts` holds all of them.
        """
        n, begin = sum(part.view_ids.size for part in parts), self._clock.now()
        if n < _FEWEST or (pause is not None and begin < self._next) or int(parts[-1].view_ids[-1]) == self._newest:
            return
        ids = np.concatenate([part.view_ids for part in parts])
        col = (self._views.source.shape[1] - 1) / 2 if axis_col is None else axis_col
        geometry, _ = self._views.geometry(col, ids)
        with suppress(ValueError):
            slices = orthogonal_slices([view for part in parts for view in part.data], geometry)
            count = f"{n} of {of}" if of > n else str(n)
            place = (
                "the middle, not known yet: crescents are no fault of the scan (optics.axis_col or --axis states it)"
                if axis_col is None
                else f"column {col:.1f}"
            )
            unseen = max(unseen_wedges(geometry), key=lambda wedge: wedge.size, default=None)
            heading = f"FBP of {count} views so far{_coverage(unseen, geometry.angles)}, axis at {place}"
            self._snapshots.write_slices(slices, n, heading, unseen)
        end = self._clock.now()
        self._newest, self._next = int(ids[-1]), end + max(pause or 0.0, end - begin)

    def draw_about_middle(self, correction: Callable[[], ScanCorrection], pause: float | None) -> None:
        """Draw slices before the axis is known, from some of the views, corrected only for this."""
        views = self._views.chosen(self._views.usable().frames)
        early = pause is not None and self._clock.now() < self._next
        if views.size < _FEWEST or early or int(views[-1]) == self._newest:
            return
        with suppress(DataError):  # views without light, say: the scan goes on, and so does the fit
            self.draw([correction().at_once(spread(views, _BEFORE_AXIS))], None, pause, views.size)


def _coverage(unseen: Wedge | None, angles: NDArray[np.float64]) -> str:
    """What a heading says where the views leave a wedge out."""
    if unseen is None:
        return ""
    order = "sequential: " if one_way(angles) else ""
    return f", {order}{180 - math.degrees(unseen.size):.0f} of 180 degrees so far"
