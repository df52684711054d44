"""Rules on pixel values: they are counts, transmission or line integrals as stated, and they were measured."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.monitor.digest import LARGEST
from beamline.storage.hdf5 import UnreadableError
from beamline.storage.readers.base import read_known
from beamline.storage.readers.transforms import WRAPPED, wrapped_edges
from beamline.storage.rules import Finding
from beamline.storage.rules.evidence import ScanEvidence
from drivers.base.frame import FrameKind
from recon.base.units import look_like_counts, look_like_transmission
from recon.base.views import spread

CONSTANT_DARKS = "constant-darks"  # a rule whose finding is not a fault; `info` shows it
# shares of the range that lies below 0, and of the pixels below 0; noise and single spots stay below them
_SURELY_BELOW, _FEW = 0.1, 0.005
_SAMPLES = 4  # frames of a kind that are examined
SHAPES = 32  # projections whose shape is examined
_FALLS = (
    "Give --quantity transmission, which takes the logarithm: the values are about 1 at the edges of the "
    "projections and lower in the sample, like transmission. Line integrals would be 0 at the edges and "
    "higher in the sample."
)


def numbers_wrapped(scan: ScanEvidence) -> Iterator[Finding]:
    """Counts must fit into their integer type. A pixel that exceeds the largest value of the type continues at the
    smallest value.
    """
    kinds = (FrameKind.PROJECTION, FrameKind.FLAT, FrameKind.DARK) if scan.source.dtype.itemsize == 2 else ()
    samples = {kind: images for kind in kinds if (images := sample(scan, kind)) is not None}
    frames, flats = samples.values(), samples.get(FrameKind.FLAT)
    flat = None if flats is None else np.median(flats, axis=0)
    signed = scan.source.dtype.kind == "i" and scan.in_counts
    below = _SURELY_BELOW * np.iinfo(np.int16).min if signed else -np.inf
    dark_too = FrameKind.DARK in samples and samples[FrameKind.DARK].min() < below
    low = 0 if dark_too else sum(int((images < below).sum()) for images in frames)
    edges = sum(wrapped_edges(images, scan.source.dtype, flat) for images in frames)
    if not edges and low <= _FEW * sum(images.size for images in frames):
        return
    lowest, highest = np.iinfo(scan.source.dtype).min, np.iinfo(scan.source.dtype).max
    finding = (
        f"{edges} pixels with values near {highest} are next to pixels with values near {lowest}"
        if edges
        else f"{low} pixels are below {below:.0f}"
    )
    n_frames = sum(map(len, frames))
    yield Finding(
        "error",
        WRAPPED,
        "Convert the frames of the camera again, to 32-bit integers or to floats: the 16-bit integers "
        f"overflowed. In {n_frames} frames checked, {finding}. Two things cause this. A sum of pixels or "
        f"frames went above {highest} and wrapped to {lowest}. Or a dark was subtracted and the result went below "
        f"{lowest}. The true values of these pixels are lost, and other "
        "flats or darks do not help.",
    )


def quantity_stated(scan: ScanEvidence) -> Iterator[Finding]:
    """The quantity of the pixels must be known. If the logarithm is missing or applied twice, the volume is wrong, and
    nothing else shows it.
    """
    if scan.source.quantity == "unknown":
        note = scan.source.attributes.get("quantity")
        remark = "" if note is None else f"The file has only a remark on the pixels ({str(note)[:80]!r}). "
        yield Finding(
            "error",
            "quantity",
            f"{remark}The file does not state whether pixels are counts, transmission or line integrals: give "
            "--quantity counts, --quantity transmission or --quantity line-integrals."
            + (f" {_FALLS}" if _falls(scan) else ""),
        )


def darks_computed(scan: ScanEvidence) -> str:
    """Finds darks that were computed and not recorded: in a dark that a camera recorded, pixels have different
    values.
    """
    darks = sample(scan, FrameKind.DARK) if scan.source.dtype.kind in "ui" else None
    return "" if darks is None or darks.min() < darks.max() else (
        f"The darks are {darks.min():g} in every pixel checked: a constant, not what the camera measures without "
        "beam. If darks were taken, give these darks with --darks."
    )  # fmt: skip


def pixels_measured(scan: ScanEvidence) -> Iterator[Finding]:
    """Projections contain finite numbers that are not all the same."""
    views = sample(scan, FrameKind.PROJECTION)
    if views is None:
        return
    finite = np.abs(views, dtype=np.float64) <= LARGEST
    if not finite.any():
        message = f"The checked projections have no finite pixel: all are NaN, infinite or beyond {LARGEST:g}."
        yield Finding("error", "pixels", message)
    elif float(views[finite].min()) == float(views[finite].max()):
        value = views[finite][0]
        yield Finding("error", "pixels", f"In the checked projections, every pixel is {value:g}.")
    elif not finite.all():
        bad_share = 1 - finite.mean()
        yield Finding(
            "warning",
            "pixels",
            f"{bad_share:.3%} of the pixels checked are NaN, infinite or beyond {LARGEST:g}.",
        )
    if scan.source.quantity == "line_integrals" and _falls(scan):
        yield Finding(
            "error", "quantity", f"The pixels are stated to be line integrals, but look like transmission. {_FALLS}"
        )
    elif scan.source.quantity == "line_integrals" and look_like_counts(views):
        yield Finding(
            "warning",
            "pixels",
            f"The line integrals have a median of {np.nanmedian(views):.4g}. No measurable beam passes through so "
            "much material. If the pixels are counts, give --quantity counts, with darks and flats.",
        )


def _falls(scan: ScanEvidence) -> bool:
    """True if the projections are real numbers and look like transmission."""
    views = sample(scan, FrameKind.PROJECTION, SHAPES) if scan.source.dtype.kind == "f" else None
    return views is not None and look_like_transmission(views)


def sample(scan: ScanEvidence, kind: FrameKind, count: int = _SAMPLES) -> NDArray[Any] | None:
    """A few frames of one kind, spread over the scan; only the middle rows, at most 256. None if there is no such
    frame.
    """
    rows = scan.table.of_kind(kind)
    if rows.size == 0:
        return None
    rows = spread(rows, count)
    middle = scan.source.shape[0] // 2
    images = read_known(scan.source, rows, slice(max(middle - 128, 0), middle + 128)).astype(np.float64)
    known = ~np.isin(rows, sorted(scan.source.unreadable))
    if not known.any():
        raise UnreadableError(next(iter(scan.source.unreadable.values())))
    return images[known]
