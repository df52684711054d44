"""The picture of a growing volume: slices and the newest projection, drawn fast enough for each update."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING

import numpy as np

from beamline.report.figures import GreyWindow, bright_centre, grey_window, round_length
from recon.base.arrays import F32
from recon.base.greys import material_window
from recon.base.method import Preview
from recon.base.noise import noise_level
from recon.base.volume import Volume
from recon.voxels.view_weights import Wedge

if TYPE_CHECKING:
    from PIL.Image import Image
    from PIL.ImageDraw import ImageDraw
    from PIL.ImageFont import FreeTypeFont

# pixels: space between panels, height of a line of text, largest width of a letter of a heading
_GAP, _LINE, _LETTER = 14, 15, 9
# pixels: the longest side of an image has this length or up to twice this length; a label needs the same space
_SIDE = 256
# smallest range of the differences, and the percentile that the range reaches, so that shapes stay visible
_SIGMAS, _MOST = 5.0, 99.0
_ORANGE = (255, 127, 14)
_DIAL = 0.08  # radius of the dial of missing rays, as a share of the side of an image


@dataclass(frozen=True, eq=False)
class PictureRow:
    """Panels side by side under a heading; "" if there is no heading."""

    heading: str
    panels: Sequence[_Panel]


def live_picture(rows: Sequence[PictureRow]) -> bytes:
    """The rows as PNG. Axes and layout are left out, because they would take ten times as long, and the picture is
    drawn during the fit."""
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
    """A font that has arrows, `size` pixels high."""
    import matplotlib
    from PIL import ImageFont

    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(Path(matplotlib.get_data_path(), "fonts", "ttf", name), size)


def volume_rows(
    volume: Volume, view: F32, render: F32, heading: str, unit: str,
    drawn: tuple[Sequence[float] | None, Wedge | None] = (None, None),
) -> tuple[PictureRow, PictureRow]:  # fmt: skip
    """Slices of a volume; and the newest projection, the forward projection of the volume at its angle, and their
    difference.

    Args:
        volume: the volume so far, in 1/unit. view, render: the newest projection [row, col] and the forward projection
            of the volume at the same angle, as line integrals. heading: heading of the picture, one line. unit: unit of
            length, "mm" or "px". drawn: z, y and x of the slices (None: through the bright parts), and the wedge of
            angles without projections.
    """
    place, unseen = drawn
    grid, data = volume.grid, volume.data
    if place is None:
        k, j, i = (1 + n // 100 for n in data.shape)  # the middle of the bright parts need not be exact to a voxel
        z, y, x = np.multiply((k, j, i), bright_centre(data[::k, ::j, ::i])).tolist()
    else:
        z, y, x = (int(np.abs(axis - to).argmin()) for axis, to in zip(grid.coordinates(), place, strict=True))
    positions = [axis[i] for axis, i in zip(grid.coordinates(), (z, y, x), strict=True)]
    panels = slice_panels((data[z], data[:, y], data[:, :, x]), positions, grid.voxel_size, unit, unseen)
    return PictureRow(heading, panels), PictureRow("", _view_panels(view, render))


def slice_panels(
    images: Sequence[F32], positions: Sequence[float], pixel: float, unit: str, unseen: Wedge | None = None
) -> list[_Panel]:
    """Slices across z, y and x at these places, in the same greys."""
    window = material_window(*images)
    grey = f"{window[0]:.3g} to {window[1]:.3g} 1/{unit}"
    labels = (
        f"x → y ↓ at z = {positions[0]:.3g} {unit}",
        f"x → z ↓ at y = {positions[1]:.3g}",
        f"y → z ↓ at x = {positions[2]:.3g}",
    )
    notes = (grey, "the same greys and scale", "the same greys and scale")
    pixels, zoom = _sized(images)
    bar = pixel / zoom, unit
    return [
        _Panel(image, window, label, note, None if k else bar, unseen=None if k else unseen)
        for k, (image, label, note) in enumerate(zip(pixels, labels, notes, strict=True))
    ]


def reference_row(shown: Preview, n_views: int, unit: str) -> PictureRow:
    """Middle slices of three volumes: the moved reference, the FBP volume of the residual that the reference leaves in
    the projections, and the sum of both.

    Args:
        n_views: number of projections so far.
    """
    middle, grid = len(shown.volume.data) // 2, shown.volume.grid
    moved, volume = shown.moved.data[middle], shown.volume.data[middle]
    change = volume - moved
    window, reach = material_window(moved, volume), float(np.percentile(np.abs(change), _MOST)) or 1.0
    (moved, volume, change), zoom = _sized((moved, volume, change))
    grey = f"{window[0]:.3g} to {window[1]:.3g} 1/{unit}"
    heading = (
        "The reference, moved to the present position of the sample, and FBP of the residual, that is, of what the "
        f"moved reference does not explain in {n_views} projections ({shown.left:.1%} of the norm of the projections; "
        "the smaller, the better the reference fits)"
    )
    panels = [
        _Panel(moved, window, "the moved reference, x → y ↓", grey, (grid.voxel_size / zoom, unit)),
        _Panel(volume, window, "the reference plus FBP of the residual", "the same greys and scale"),
        _Panel(
            change, (-reach, reach), "FBP of the residual: what changed", f"black {-reach:.2g} to white {reach:.2g}"
        ),
    ]
    return PictureRow(heading, panels)


def _view_panels(view: F32, render: F32) -> list[_Panel]:
    window = grey_window([view], 0.5, 99.5)
    noise = noise_level(view[None]) or 0.01 * (window[1] - window[0])
    difference = (view - render) / np.float32(noise)
    greys = f"line integral {window[0]:.3g} to {window[1]:.3g}"
    reach = max(_SIGMAS, float(np.percentile(np.abs(difference), _MOST)))
    spread = f"black {-reach:.2g} to white {reach:.2g}; RMS {math.sqrt(float(np.mean(difference**2))):.2f}"
    (view, render, difference), _ = _sized((view, render, difference))
    return [
        _Panel(view, window, "newest projection, u → z ↓", greys),
        _Panel(render, window, "the fit, projected at the same angle", "the same greys"),
        _Panel(difference, (-reach, reach), "difference, in units of the pixel noise", spread),
    ]


@dataclass(frozen=True, eq=False)
class _Panel:
    """An image, row 0 at the top, below two lines of text.

    Attributes:
        pixels: pixels of the screen [row, col]. limits: values that are black and white. label, note: the two lines of
            text. bar: width of a pixel and its unit, for a scale bar of a round length; None: no bar. unseen: for a
            dial of the rays in a slice across z that no projection has measured yet; None: no dial.
    """

    pixels: F32
    limits: GreyWindow
    label: str
    note: str
    bar: tuple[float, str] | None = None
    unseen: Wedge | None = None

    def draw(self, picture: Image, left: int, top: int) -> None:
        """Draw the image into the picture. Its text begins at this offset in pixels from the left and the top."""
        from PIL import Image, ImageDraw

        draw = ImageDraw.Draw(picture)
        for line, (text, colour) in enumerate(((self.label, "black"), (self.note, "#595959"))):
            draw.text((left, top + line * _LINE), text, colour, _font(11))
        top += 2 * _LINE
        shares = (self.pixels - self.limits[0]) / (self.limits[1] - self.limits[0])
        picture.paste(Image.fromarray((255 * np.clip(shares, 0, 1)).astype(np.uint8)), (left, top))
        if self.bar is not None:
            pixel, unit = self.bar
            length = round_length(pixel * self.pixels.shape[1] / 3)  # at most a third of the image
            x, y = left + 6, top + self.pixels.shape[0] - 6
            draw.line((x, y, x + length / pixel, y), _ORANGE, 4)
            draw.text((x, y - 18), f"{length:g} {unit}", _ORANGE, _font(11, bold=True))
        if self.unseen is not None:
            self._dial(draw, left + self.pixels.shape[1] - 6, top + 6, self.unseen)

    def _dial(self, draw: ImageDraw, right: int, top: int, unseen: Wedge) -> None:
        """Rays in a slice (y downwards) that no projection has measured yet, drawn as a double wedge. Edges along these
        rays are unknown."""
        side = 2 * _DIAL * min(self.pixels.shape)
        place, (first, last) = (right - side, top, right, top + side), unseen.rays
        draw.ellipse(place, outline="#999999")
        for turn in (0, 180):  # a ray has two directions
            draw.pieslice(place, first + turn, last + turn, _ORANGE)
        draw.text((right - side - 4, top), "rays not yet measured", _ORANGE, _font(11), anchor="ra")


def _sized(images: Sequence[F32]) -> tuple[list[F32], float]:
    """The images with repeated or averaged pixels, so that the longest side has _SIDE to 2 _SIDE pixels; and the factor
    between the sizes."""
    longest = max(max(image.shape) for image in images)
    if longest < _SIDE:
        factor = math.ceil(_SIDE / longest)
        return [np.repeat(np.repeat(image, factor, 0), factor, 1) for image in images], factor
    step = longest // _SIDE
    return [_means(image, step) for image in images], 1 / step


def _means(image: F32, step: int) -> F32:
    """Means of step x step pixels, or of fewer if the image is smaller. Pixels that do not fill a block at the ends are
    left out."""
    rows, cols = (max(1, n // step) for n in image.shape)
    each = min(step, image.shape[0]), min(step, image.shape[1])
    cut = image[: rows * each[0], : cols * each[1]]
    return cut.reshape(rows, each[0], cols, each[1]).mean(axis=(1, 3))
