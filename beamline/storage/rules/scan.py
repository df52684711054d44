"""Conditions for trust in a scan of any format, one function a rule. Public validators accept NaN angles, not these."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.core.files import run_of
from beamline.core.text import count, spans
from beamline.monitor.digest import LARGEST
from beamline.plan.passes import Choice
from beamline.storage.hdf5 import UnreadableError
from beamline.storage.interrupted import next_step
from beamline.storage.parts import is_joined, joined_file_of, other_parts, to_join
from beamline.storage.readers.base import ScanSource, read_known
from beamline.storage.rules import Finding
from beamline.storage.rules.angles import angles_known, angles_spread
from beamline.storage.rules.angles_shown import angles_shown
from beamline.storage.rules.light import exposures_agree, light_one, one_energy, views_scaled
from drivers.base.frame import FrameKind
from recon.base.units import look_like_counts, look_like_light, look_like_transmission, look_negative
from recon.base.views import spread

CONSTANT_DARKS = "constant-darks"  # a rule whose finding is no fault, but which `info` shows
SAMPLES = 4  # frames of a kind that are looked at
SHAPES = 32  # views whose shape is looked at
TURNED = 12  # views by which the direction of the axis is found
_LEAST = 8  # views, rows and columns: fewer tell nothing of it
_SWAPPED = 2.0  # times as rough as with bytes exchanged; sound counts are smoother than that
_LEAST_SQUARE = 16  # views and rows, as many
_ON_A_SINE, _OFF_A_SINE, _OTHER_MASS = 0.9, 4.0, 4.0  # share of a change; times what is left of it; times a variance
_HORIZONTAL = 10.0  # of the change of rows over that of columns; real scans have 0.001 to 0.03, turned ones the inverse


def scan_findings(source: ScanSource) -> list[Finding]:
    """Findings of the rules in this module on an open scan."""
    return [finding for rule in SOURCE_RULES for finding in rule(source)]


def scan_ended(source: ScanSource) -> Iterator[Finding]:
    """The writer closed the file, and the scan ended as planned; else a remedy."""
    ending, n = source.ending, count(source.image_key.size, "frame")
    if not source.finished:
        sentence = f"The file was not closed: {n} can be trusted."
    elif ending.status in ("stopped", "failed"):
        planned, taken = source.plan.get("angles_deg", ()), int((source.image_key == FrameKind.PROJECTION).sum())
        of_plan = f", with {taken} of {len(planned)} views" if isinstance(planned, list) and planned else ""
        if any(each.get("choice") == Choice.ENOUGH for each in source.decisions):
            of_plan += "; it had decided against the others"
        sentence = f"The scan ended as {ending.status!r} after {n}{of_plan}. {ending.reason}".strip()
    else:
        return
    yield Finding("warning", "unfinished", f"{sentence} {next_step(source.path)}".strip())


def altered_sentence(source: ScanSource) -> str:
    """Sentences on the rows of a scan whose record differs from its checksum."""
    rows = sorted(source.altered)
    return (
        f"{source.path}: what is said of {count(len(rows), 'frame')} (kind, angle, time, trigger) differs from the "
        f"checksum written with it: {spans(rows)}. Nothing uses {'it' if len(rows) == 1 else 'them'}. Look for a good "
        "copy."
    )


def enough_views(source: ScanSource) -> Iterator[Finding]:
    """A reconstruction needs at least two projections."""
    n = int((source.image_key == FrameKind.PROJECTION).sum())
    if n < 2:
        yield Finding("error", "views", f"{n} projections: a reconstruction needs at least 2, a good one hundreds.")


def quantity_stated(source: ScanSource) -> Iterator[Finding]:
    """The quantity of the pixels is known: a missing or a second logarithm ruins a volume unnoticed."""
    if source.quantity == "unknown":
        note = source.attributes.get("quantity")
        note_text = "Nothing says" if note is None else f"The file says only in its own words ({str(note)[:80]!r})"
        yield Finding(
            "error",
            "quantity",
            f"{note_text} whether pixels are counts, transmission or line integrals: say --quantity counts, "
            "--quantity transmission or --quantity line-integrals." + (f" {_FALLS}" if _falls(source) else ""),
        )


def references_present(source: ScanSource) -> Iterator[Finding]:
    """Scans of counts have darks and flats."""
    if source.quantity != "counts":
        return
    for name, kind in (("flats", FrameKind.FLAT), ("darks", FrameKind.DARK)):
        if not (source.image_key == kind).any():
            yield Finding(
                "error",
                "references",
                f"Counts without {name}: give --{name} FILE (or a folder). If the frames were divided by their flats, "
                "say --quantity transmission, or line-integrals where their logarithm was taken.",
            )


def darks_measured(source: ScanSource) -> Iterator[Finding]:
    """Darks are images of the camera: no two of its pixels read the same without light."""
    darks = _sample(source, FrameKind.DARK) if source.dtype.kind in "ui" else None
    if darks is not None and darks.min() == darks.max():
        yield Finding(
            "info",
            CONSTANT_DARKS,
            f"The darks are {darks.min():g} in every pixel looked at: a constant, not what the camera reads without "
            "light. If its darks were taken, give them with --darks.",
        )


def pixels_measured(source: ScanSource) -> Iterator[Finding]:
    """Projections hold finite numbers that are not all the same."""
    views = _sample(source, FrameKind.PROJECTION)
    if views is None:
        return
    finite = np.abs(views, dtype=np.float64) <= LARGEST
    if not finite.any():
        message = f"No finite pixel in the projections looked at: they are all NaN, infinite or beyond {LARGEST:g}."
        yield Finding("error", "pixels", message)
    elif float(views[finite].min()) == float(views[finite].max()):
        yield Finding("error", "pixels", f"Every pixel of the projections looked at is {views[finite][0]:g}.")
    elif not finite.all():
        yield Finding(
            "warning",
            "pixels",
            f"{1 - finite.mean():.3%} of the pixels looked at are NaN, infinite or beyond {LARGEST:g}.",
        )
    if source.quantity == "line_integrals" and (problem := _not_line_integrals(source)):
        yield Finding("error", "quantity", problem)
    elif source.quantity == "line_integrals" and look_like_counts(views):
        yield Finding(
            "warning",
            "pixels",
            f"The line integrals have a median of {np.nanmedian(views):.4g}, which no light passes: are they counts? "
            "If so, say --quantity counts, with darks and flats.",
        )
    elif source.quantity == "counts" and _rises(source):
        yield Finding("error", "quantity", _RISES)


def pixels_as_labelled(source: ScanSource) -> Iterator[Finding]:
    """Counts have the byte order and sign of their type; counts beyond a signed type are read as unsigned."""
    views = _sample(source, FrameKind.PROJECTION) if source.dtype.kind in "ui" and source.dtype.itemsize > 1 else None
    if views is not None and _roughness(views) > _SWAPPED * _roughness(views.astype(source.dtype).byteswap()):
        yield Finding(
            "error",
            "pixels",
            "From pixel to pixel the counts change without order, as bytes do that are read in the wrong order; with "
            "the bytes of each number exchanged they are smooth. Write the images with the other order of bytes "
            "(numpy: images.byteswap()).",
        )
    if wrapped := source.attributes.get("pixels"):
        yield Finding("warning", "pixels", f"The file's label is wrong: counts are {wrapped}.")


def axis_vertical(source: ScanSource) -> Iterator[Finding]:
    """The rotation axis is parallel to the columns: each detector row then shows the same matter in every view."""
    views = np.flatnonzero((source.image_key == FrameKind.PROJECTION) & np.isfinite(source.angles))
    if source.shifts is not None or views.size < _LEAST or min(source.shape) < _LEAST:
        return
    depths = _depths(source, spread(views, TURNED))
    if not depths.size:
        return
    ratio = change_of_rows(depths)
    if ratio > _HORIZONTAL:
        yield Finding(
            "warning",
            "axis",
            f"From view to view the matter in a row changes {ratio:.3g} times as much as the matter in a column, as if "
            f"the rotation axis were horizontal; it is expected along the columns. {_exchanged(source)}If it is "
            "horizontal, say --horizontal-axis.",
        )


_EXCHANGE = (("angle", "theta"), ("dark", "data_dark"), ("flat", "data_white"))


def _exchanged(source: ScanSource) -> str:
    """How rows and columns of stacks in HDF5 are exchanged, as a sentence; "" for other formats.

    MATLAB writes dimensions in reverse. A quarter turn would show the mirror image of these.
    """
    data, dimensions = source.attributes.get("data"), str(source.attributes.get("dimensions", "frame,row,col"))
    others = ""
    if source.format == "data_exchange":
        data, others = "exchange/data", "".join(f" --{name}s-path exchange/{at}" for name, at in _EXCHANGE)
    order = ",".join({"row": "col", "col": "row"}.get(axis, axis) for axis in dimensions.split(","))
    say = f"If rows and columns are exchanged, as MATLAB writes them, say --data-path {data}:{order}{others}. "
    return "" if data is None else say


def change_of_rows(depths: NDArray[np.float64]) -> float:
    """Squared change of the row sums of [view, row, col] from view to view, relative to that of the column sums.

    About 1 where there is noise alone. Rotation about the columns moves matter along the rows, whose sums stay as they
    are. What a drifting beam does to rows is in their ends, too, and so is matter that leaves a narrow field, from each
    row in proportion to what is in it: a parabola over the rows and their mean profile, fitted to the ends, are taken
    off.
    """
    change = depths - depths.mean(axis=0)
    ends = max(1, depths.shape[2] // 16)
    beside = np.median(np.concatenate([change[..., :ends], change[..., -ends:]], axis=2), axis=2)
    parabola = np.polynomial.legendre.legvander(np.linspace(-1, 1, depths.shape[1]), 2)
    profiles = np.column_stack([parabola, depths.mean(axis=(0, 2))])
    change = change - (beside @ np.linalg.pinv(profiles, rcond=1e-6).T @ profiles.T)[..., None]
    of_rows, of_cols = (float(change.sum(axis=axis).var(axis=0).sum()) for axis in (2, 1))
    rounding = 1e-20 * float((np.abs(depths).sum(axis=2) ** 2).sum())
    return of_rows / max(of_cols, rounding) if of_rows > rounding else 0.0


def _depths(source: ScanSource, views: NDArray[np.int64]) -> NDArray[np.float64]:
    """Line integrals of some views [view, row, col], coarse, but for what all views share."""
    block = max(1, min(max(source.shape) // 128, min(source.shape) // _LEAST))
    rows, cols = (n // block for n in source.shape)
    darks = np.flatnonzero(source.image_key == FrameKind.DARK)[:1]
    dark = read_known(source, darks)[0].astype(np.float64) if darks.size and source.quantity == "counts" else 0.0
    bits = []
    for view in views.tolist():
        image = read_known(source, [view])[0].astype(np.float64)
        if view in source.unreadable or not np.isfinite(image).all():
            continue
        image = image if source.quantity == "line_integrals" else image - dark
        coarse = image[: rows * block, : cols * block].reshape(rows, block, cols, block).mean(axis=(1, 3))
        bits.append(coarse)
    depths = np.array(bits).reshape(-1, rows, cols)
    if source.quantity == "line_integrals" or not len(depths):
        return depths
    if not depths.max() > 0:  # neither counts nor transmission
        return depths[:0]
    return -np.log(np.maximum(depths, 1e-3 * np.max(depths)))


def views_first(source: ScanSource) -> Iterator[Finding]:
    """If there are as many views as rows, the first dimension is that of the views, and the second that of the rows.

    In sinograms it is the other way round: of each image the rows are views, so that they have one mass, and the first
    moments of all go along a sine of their angles (Helgason 1965; Ludwig 1966), while from image to image they do not.
    """
    views = np.flatnonzero(source.image_key == FrameKind.PROJECTION)
    angles = source.angles[views]
    if source.shifts is not None or not views.size == source.shape[0] >= _LEAST_SQUARE:
        return
    some = np.arange(views.size)[:: -(-views.size // SHAPES)]
    depths = _depths(source, views[some]) if np.isfinite(angles).all() and source.shape[1] >= _LEAST else np.zeros(0)
    if len(depths) != some.size:
        return
    ends = max(1, depths.shape[2] // 16)
    depths = depths - np.median(np.concatenate([depths[..., :ends], depths[..., -ends:]], axis=2), axis=2)[..., None]
    mass, first = depths.sum(axis=2), depths @ (np.arange(depths.shape[2]) - (depths.shape[2] - 1) / 2)
    rows = len(mass[0])
    along_rows = _explained(first.T, np.array([part.mean() for part in np.array_split(angles, rows)]))
    along_frames = _explained(first, angles[some])
    if mass.var(axis=0).sum() / len(mass[0]) > _OTHER_MASS * mass.var(axis=1).sum() / len(mass) and (
        along_rows > _ON_A_SINE and 1 - along_frames > _OFF_A_SINE * (1 - along_rows)
    ):
        yield Finding(
            "warning",
            "axis",
            f"The {views.size} images look like sinograms: the rows of each hold one mass, whose centre goes along a "
            f"sine of the angles ({along_rows:.0%} of its change), as views do, and from image to image it does not "
            f"({along_frames:.0%}). Then the first dimension counts rows of the detector. Say so by the attribute axes "
            "of the dataset (y:theta:x), or write a copy as [view, row, column].",
        )


def _explained(values: NDArray[np.float64], angles: NDArray[np.float64]) -> float:
    """Share of the change of values [view, of each] that is a sine of the angles [view]."""
    parts = np.column_stack([np.ones_like(angles), np.cos(angles), np.sin(angles)])
    rest = values - parts @ np.linalg.lstsq(parts, values, rcond=None)[0]
    change = float(values.var(axis=0).sum())
    return 1 - float((rest**2).mean(axis=0).sum()) / change if change > 0 else 0.0


def _roughness(views: NDArray[Any]) -> float:
    """Change from pixel to pixel over the spread of all; 0 where they are all the same."""
    spread_of_all = float(views.std())
    return float(np.abs(np.diff(views.astype(np.float64), axis=2)).mean()) / spread_of_all if spread_of_all else 0.0


def series_complete(source: ScanSource) -> Iterator[Finding]:
    """Every trigger has a frame, and no number is missing in a series of files."""
    missing = source.attributes.get("missing_triggers", 0)
    if missing:
        yield Finding("warning", "missing-frames", f"{missing} triggers gave no frame; the file lists them.")
    numbers = source.attributes.get("missing_numbers", "")
    if numbers:
        yield Finding("warning", "missing-frames", f"The series of files leaves out the numbers {numbers}.")


def scale_known(source: ScanSource) -> Iterator[Finding]:
    """The pixel size is known; without it a volume has no scale."""
    if source.pixel_size_mm is None:
        yield Finding("info", "pixel-size", "No pixel size: lengths will be in pixels, densities per pixel.")
    elif not 0 < source.pixel_size_mm < 10:
        yield Finding("error", "pixel-size", f"A pixel size of {source.pixel_size_mm:g} mm cannot be.")


def stated_used(source: ScanSource) -> Iterator[Finding]:
    """Everything that the file states is used or reported: as a warning if it may change the volume."""
    for field in source.not_used:
        message = f"The file states {field.where}, {field.value}, which is not used: {field.why}."
        yield Finding("warning" if field.doubt else "info", "not-used", message)


def pixels_square(source: ScanSource) -> Iterator[Finding]:
    """Pixels are square, or each row is a separate slice."""
    width, height = source.pixel_size_mm, source.row_pitch_mm
    if height is None or width == 0:  # a width of 0 is another rule's
        return
    if not width or not 0.01 < height / width < 100:
        width_text = "unknown" if width is None else f"{width:g} mm"
        yield Finding(
            "error", "pixel-height", f"The pixels are {height:g} mm high; their width is {width_text}. That cannot be."
        )
    elif source.cone is not None:
        yield Finding(
            "error",
            "pixel-height",
            f"The pixels are {width:g} mm wide and {height:g} mm high, in a cone beam: square pixels are expected. Bin "
            "the columns or the rows of a copy of the file.",
        )
    else:
        yield Finding(
            "info",
            "pixel-height",
            f"The pixels are {width:g} mm wide and {height:g} mm high: slices will be {height:g} mm apart.",
        )


def parts_joined(source: ScanSource) -> Iterator[Finding]:
    """The file is not a single part of a resumed scan."""
    if source.part_starts.size > 1:
        return
    if (joined_file := joined_file_of(source.path)) is not None and is_joined(joined_file[0]):
        joined, n = joined_file
        sentence = f"This file is one of {n} parts of a scan: give {joined}, which has the frames of all"
    elif others := other_parts(source.path):
        sentence = f"This file is a part of a run, as {others[0]} is, and no file has the frames of all its parts"
        sentence += f": {to_join(run_of(source.path.resolve().parent))}"
    else:
        return
    yield Finding("error", "parts", f"{sentence}. For this part alone, copy it out of the folder of its run.")


SOURCE_RULES: tuple[Callable[[ScanSource], Iterator[Finding]], ...] = (
    enough_views,
    angles_known,
    angles_spread,
    angles_shown,
    quantity_stated,
    references_present,
    darks_measured,
    exposures_agree,
    one_energy,
    light_one,
    pixels_measured,
    pixels_as_labelled,
    views_scaled,
    axis_vertical,
    views_first,
    series_complete,
    scale_known,
    pixels_square,
    stated_used,
    parts_joined,
)


_FALLS = (
    "The values are about 1 at the edges of the views and fall where the sample is, as transmission does; line "
    "integrals are 0 there and rise. Say --quantity transmission: its logarithm is then taken."
)
_DIMS = (
    "The values are far above 1 at the edges of the views and fall where the sample is, as counts do; line integrals "
    "are 0 there and rise. Say --quantity counts, with --darks and --flats; or divide them by the light without a "
    "sample, and say --quantity transmission."
)
_NEGATIVE = (
    "The values are 0 at the edges of the views and below 0 where the sample is, as the logarithm of transmission is; "
    "line integrals are its negative, and rise there. Write them with the other sign."
)
_RISES = (
    "The frames are divided by flats of 1, but they are 0 at the edges of the views and rise where the sample is, as "
    "line integrals do; transmission is 1 there and falls. Say --quantity line-integrals, without --darks and --flats."
)


def _falls(source: ScanSource) -> bool:
    """The views look like transmission, which real numbers can be."""
    views = _sample(source, FrameKind.PROJECTION, SHAPES) if source.dtype.kind == "f" else None
    return views is not None and look_like_transmission(views)


def _not_line_integrals(source: ScanSource) -> str:
    """What the values are that are given as line integrals; "": they may be."""
    views = _sample(source, FrameKind.PROJECTION, SHAPES)
    if views is None:
        return ""
    if source.dtype.kind == "f" and look_like_transmission(views):
        return f"Transmission is given as line integrals. {_FALLS}"
    if look_like_light(views):
        return f"Light is given as line integrals. {_DIMS}"
    return _NEGATIVE if look_negative(views) else ""


def _rises(source: ScanSource) -> bool:
    """The views look like line integrals, though they are to be divided by a beam of about 1."""
    flats = _sample(source, FrameKind.FLAT) if source.dtype.kind == "f" else None
    if flats is None or not 0.5 < np.nanmedian(flats) < 2:
        return False
    views = _sample(source, FrameKind.PROJECTION, SHAPES)
    return views is not None and look_like_transmission(np.exp(-np.maximum(views, -1)))


def _sample(source: ScanSource, kind: FrameKind, count: int = SAMPLES) -> NDArray[Any] | None:
    """A few frames of a kind, spread over the scan, at most 256 rows of the middle; None where there is none."""
    rows = np.flatnonzero(source.image_key == kind)
    if rows.size == 0:
        return None
    rows = spread(rows, count)
    middle = source.shape[0] // 2
    images = read_known(source, rows, slice(max(middle - 128, 0), middle + 128)).astype(np.float64)
    known = ~np.isin(rows, sorted(source.unreadable))
    if not known.any():
        raise UnreadableError(next(iter(source.unreadable.values())))
    return images[known]
