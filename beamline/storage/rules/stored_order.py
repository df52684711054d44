"""Rules on the order in which frames are stored: dimensions of a stack, direction of the rotation axis."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from beamline.storage.readers.base import read_known
from beamline.storage.rules import Finding
from beamline.storage.rules.evidence import ScanEvidence
from beamline.storage.rules.pixels import SHAPES
from recon.base.views import spread
from recon.prep.unmeasured import with_borders_filled

_TURNED = 12  # projections from which the direction of the axis is determined
_LEAST = 8  # fewest projections, rows and columns from which it can be determined
_LEAST_SQUARE = 16  # fewest projections, if there are as many rows, with which sinograms are recognised
# limits: a share of a change; a factor on the remaining change; a factor on a variance
_ON_A_SINE, _OFF_A_SINE, _OTHER_MASS = 0.9, 4.0, 4.0
# change of the row sums relative to that of the column sums; real scans have 0.001 to 0.03, rotated images the inverse
_HORIZONTAL = 10.0


def axis_vertical(scan: ScanEvidence) -> Iterator[Finding]:
    """The rotation axis is parallel to the columns, so each detector row shows the same material in all projections."""
    views = scan.table.views_with_angles
    if scan.table.shifts is not None or views.size < _LEAST or min(scan.source.shape) < _LEAST:
        return
    depths = _coarse_line_integrals(scan, spread(views, _TURNED))
    if not depths.size:
        return
    ratio = change_of_rows(depths)
    if ratio > _HORIZONTAL:
        yield Finding(
            "warning",
            "axis",
            "The rotation axis seems to be horizontal; expected along the columns. Between projections, the total "
            f"absorption of a row changes {ratio:.3g} times as much as the total absorption of a column. "
            f"{_advice_on_exchanged_axes(scan)}If the axis is horizontal, give --horizontal-axis.",
        )


def _advice_on_exchanged_axes(scan: ScanEvidence) -> str:
    """A sentence that says how to exchange rows and columns of stacks in HDF5; "" for other formats.

    MATLAB writes dimensions in reverse order. Rotating such images by 90 degrees would give their mirror images.
    """
    data, others = scan.source.stack_options
    dimensions = str(scan.source.attributes.get("dimensions", "frame,row,col"))
    order = ",".join({"row": "col", "col": "row"}.get(axis, axis) for axis in dimensions.split(","))
    advice = f"If rows and columns are exchanged, as MATLAB writes them, give --data-path {data}:{order}{others}. "
    return advice if data else ""


def change_of_rows(depths: NDArray[np.float64]) -> float:
    """Squared change of the row sums of [view, row, col] from projection to projection, relative to that of the column
    sums.

    The value is about 1 if there is only noise. If the rotation axis is parallel to the columns, the rotation moves
    material along the rows, and the row sums do not change. Two other effects change the row sums and the ends of the
    rows: a drifting beam, and material that leaves a narrow field of view, in proportion to the material in each row.
    Therefore a parabola over the rows and the mean profile of the rows are fitted to the ends and subtracted.
    """
    change = depths - depths.mean(axis=0)
    n_edge = max(1, depths.shape[2] // 16)
    edge_change = np.median(np.concatenate([change[..., :n_edge], change[..., -n_edge:]], axis=2), axis=2)
    parabola = np.polynomial.legendre.legvander(np.linspace(-1, 1, depths.shape[1]), 2)
    profiles = np.column_stack([parabola, depths.mean(axis=(0, 2))])
    change = change - (edge_change @ np.linalg.pinv(profiles, rcond=1e-6).T @ profiles.T)[..., None]
    of_rows, of_cols = (float(change.sum(axis=axis).var(axis=0).sum()) for axis in (2, 1))
    rounding = 1e-20 * float((np.abs(depths).sum(axis=2) ** 2).sum())
    return of_rows / max(of_cols, rounding) if of_rows > rounding else 0.0


def views_first(scan: ScanEvidence) -> Iterator[Finding]:
    """If there are as many projections as rows, the first dimension counts the projections and the second one the rows.

    If the images are sinograms, the rows of each image are projections. These have the same total absorption, and their
    first moments follow a sine of the angle (Helgason 1965; Ludwig 1966). Both are not true for successive images.
    """
    views = scan.table.views
    angles = scan.table.angles[views]
    if scan.table.shifts is not None or not views.size == scan.source.shape[0] >= _LEAST_SQUARE:
        return
    chosen = np.arange(views.size)[:: -(-views.size // SHAPES)]
    depths = (
        _coarse_line_integrals(scan, views[chosen])
        if np.isfinite(angles).all() and scan.source.shape[1] >= _LEAST
        else np.zeros(0)
    )
    if len(depths) != chosen.size:
        return
    n_edge = max(1, depths.shape[2] // 16)
    depths = (
        depths - np.median(np.concatenate([depths[..., :n_edge], depths[..., -n_edge:]], axis=2), axis=2)[..., None]
    )
    mass, first_moment = depths.sum(axis=2), depths @ (np.arange(depths.shape[2]) - (depths.shape[2] - 1) / 2)
    rows = len(mass[0])
    along_rows = _explained(first_moment.T, np.array([part.mean() for part in np.array_split(angles, rows)]))
    along_frames = _explained(first_moment, angles[chosen])
    if mass.var(axis=0).sum() / len(mass[0]) > _OTHER_MASS * mass.var(axis=1).sum() / len(mass) and (
        along_rows > _ON_A_SINE and 1 - along_frames > _OFF_A_SINE * (1 - along_rows)
    ):
        yield Finding(
            "warning",
            "axis",
            f"Check whether the {views.size} images are sinograms instead of projections. They look like sinograms, "
            "because all rows of an image have about the same total absorption. The centre of mass of the rows also "
            "follows a sine of the angle, as in a sinogram. From row to row of an image, the sine explains "
            f"{along_rows:.0%} of the variance; from image to image it explains {along_frames:.0%}. If the images "
            "are sinograms, give --order row,view,col, or set the attribute axes of the dataset in the file to "
            "y:theta:x.",
        )


SINOGRAM = "sinogram"  # a rule whose finding is not a fault; `info` and `recon` show it


def sinogram_assumed(scan: ScanEvidence) -> Iterator[Finding]:
    """States which dimension of an array [view, col] is used as that of the projections, and how the user can state
    another order.
    """
    axes = str(scan.source.attributes.get("dimensions", "")).split(",")
    if sorted(axes) == ["col", "frame"]:
        n = scan.table.views.size
        option = scan.source.exchange_sinogram(views_first=axes[0] == "frame")
        n_cols = scan.source.shape[1]
        yield Finding(
            "info",
            SINOGRAM,
            f"The array has two dimensions and is used as one sinogram of {n} projections and {n_cols} columns. If "
            f"rows and columns are exchanged, {option}.",
        )


def _explained(values: NDArray[np.float64], angles: NDArray[np.float64]) -> float:
    """The share of the change of values [view, ...] that a sine of the angles [view] explains."""
    basis = np.column_stack([np.ones_like(angles), np.cos(angles), np.sin(angles)])
    residual = values - basis @ np.linalg.lstsq(basis, values, rcond=None)[0]
    change = float(values.var(axis=0).sum())
    return 1 - float((residual**2).mean(axis=0).sum()) / change if change > 0 else 0.0


def _coarse_line_integrals(scan: ScanEvidence, views: NDArray[np.int64]) -> NDArray[np.float64]:
    """Coarse line integrals [view, row, col] of some projections, minus the part that all projections share."""
    block = max(1, min(max(scan.source.shape) // 128, min(scan.source.shape) // _LEAST))
    rows, cols = (n // block for n in scan.source.shape)
    darks = scan.table.darks[:1]
    dark = read_known(scan.source, darks)[0].astype(np.float64) if darks.size and scan.in_counts else 0.0
    coarse_views = []
    for view in views.tolist():
        image = read_known(scan.source, [view])[0].astype(np.float64)
        if view in scan.source.unreadable or not np.isfinite(image).all():
            continue
        image = image if scan.source.quantity == "line_integrals" else with_borders_filled(image) - dark
        coarse = image[: rows * block, : cols * block].reshape(rows, block, cols, block).mean(axis=(1, 3))
        coarse_views.append(coarse)
    depths = np.array(coarse_views).reshape(-1, rows, cols)
    if scan.source.quantity == "line_integrals" or not len(depths):
        return depths
    if not depths.max() > 0:  # the pixels are neither counts nor transmission
        return depths[:0]
    return -np.log(np.maximum(depths, 1e-3 * np.max(depths)))
