"""Air: the intensity of each projection is scaled with its edge columns, and a background is fitted to all rays that
miss the sample.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np

from beamline.core.errors import DataError
from beamline.projections.step import StepDone, StepMemory, option
from recon.base.arrays import F32, F64, Mask, bin_views, factor_within
from recon.base.view_data import Views
from recon.base.views import spread
from recon.base.volume import Grid

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from beamline.projections.prepared import PreparedProjections
    from beamline.projections.protocols import ScanPart
    from recon.base.geometry import Geometry
    from recon.prep.background import AirSums, Background
    from recon.prep.counts_plan import CorrectionSettings

_VOXELS, _VIEWS = 2**20, 180  # upper limits of the size of the volume that shows where the sample is
# voxels around the sample that are left out in each round. An uneven beam appears there until the second round, before
# which most of the background is subtracted.
_RIMS = 6.0, 1.5
_COPIES = 6  # number of float32 copies of the volume
_TERMS, _SUMS = 40, 800  # number of float64 values per binned pixel, and per projection
_AT_ONCE = 64  # fewest projections that are projected together, if there are so many
_NOISE_VIEWS = 16  # most projections from which the noise is measured
_LEAST_VIEWS, _WIDEST_GAP = 12, np.radians(30)

Columns = Literal["none", "auto"] | tuple[int, int]
Surface = Literal["auto", "none"] | int
"""Value of the option for the surface that is subtracted as background of the beam: the order of the surface, or "auto"
to subtract it if the projections confirm it.
"""

_MODELS: dict[str, tuple[Columns, Surface]] = {
    "auto": ("auto", "auto"), "columns": ("auto", "none"), "none": ("none", "none"),
}  # fmt: skip


def _columns_and_surface(text: str) -> tuple[Columns, Surface]:
    """Which columns at the detector's edges show air, and the background surface that is subtracted."""
    if match := re.fullmatch(r"(\d+),(\d+)", text):
        return (int(match[1]), int(match[2])), "none"
    if match := re.fullmatch(r"surface:([0-3])", text):
        return "auto", int(match[1])
    if text not in _MODELS:
        raise ValueError(
            f"{text!r} is unknown; expected auto, none, columns, LEFT,RIGHT (numbers of columns, "
            "e.g. 12,12) or surface:ORDER (0 to 3)"
        )
    return _MODELS[text]


def _model(text: str) -> str:
    _columns_and_surface(text)
    return text


@dataclass(frozen=True)
class Air:
    """Subtracts a background from each projection, so that the line integral of air is zero.

    Attributes:
        model: the value of the option.
    """

    name: ClassVar[str] = "background"
    follows: ClassVar[tuple[str, ...]] = ("tilt", "phase", "jumps")
    needs_finished: ClassVar[str] = ""
    model: str = option(
        "--air",
        "auto",
        "Set the air of each projection to zero. columns: subtract the line through the air at both edges. "
        "LEFT,RIGHT: as columns, with these numbers of air columns at the left and right edge. surface:0 to "
        "surface:3: also subtract a polynomial of this order, fitted to all rays that miss the sample. none: "
        "subtract nothing. auto: columns, and the surface if the projections confirm it.",
        parse=_model,
        metavar="auto|none|columns|LEFT,RIGHT|surface:ORDER",
    )

    def settings(self, before: CorrectionSettings) -> CorrectionSettings:
        """These settings with the air columns, and with the line integral above which edges count as sample (as in the
        monitor). Columns that the user states always count as air.
        """
        from recon.base.reach import LEAST

        return replace(
            before, air=_columns_and_surface(self.model)[0], sample_from=LEAST if self.model == "auto" else math.inf
        )

    @property
    def surface(self) -> Surface:
        """The background surface that is subtracted, see `without_background`."""
        return _columns_and_surface(self.model)[1]

    def memory(self, part: ScanPart) -> StepMemory:
        return StepMemory(alone=0 if self.surface == "none" else background_memory(part.geometry))

    def apply(
        self, views: PreparedProjections, angles: NDArray[np.float64], progress: Callable[[int, int], None]
    ) -> StepDone:
        from recon.base.masks import areas

        air = views.corrected.air
        levelled = float(np.mean(-np.log(air[air > 0]))) if (air > 0).any() else 0.0
        sentence, terms = without_background(
            views.seen, self.surface, views.lines.unseen, areas(views.corrected.masked), levelled
        )  # fmt: skip
        has_line = any(views.corrected.air_columns)
        unchanged_text = (
            "no polynomial subtracted, only a straight line through the air at the edges"
            if has_line
            else "nothing subtracted"
        )
        parameters: dict[str, Any] = {"surface": self.surface, "background": sentence or unchanged_text}
        return StepDone(sentence, parameters if terms is None else {**parameters, "background_terms": terms})


def background_memory(geometry: Geometry) -> int:
    """Approximate peak memory of `without_background` in bytes, without the projections themselves."""
    from recon.voxels.fbp import fbp_memory

    binned = geometry.binned(factor_within(geometry.detector_shape, _VOXELS))
    n, pixels, grid = geometry.n_views, math.prod(binned.detector_shape), Grid.matching(binned)
    n_sampled = min(n, _VIEWS)
    fit = 8 * (_TERMS * pixels + _SUMS * n)
    volume = 4 * _COPIES * math.prod(grid.shape) + fbp_memory(n_sampled, grid.shape[2])
    return fit + volume + 4 * (4 * n_sampled + 3 * min(n, _AT_ONCE)) * pixels + 16 * math.prod(geometry.detector_shape)


class _BinnedViews:
    """Yields line integrals [view, row, col], binned and finite, with their geometry; N projections at a time."""

    def __init__(self, data: F32, geometry: Geometry, unknown: Mask | None) -> None:
        self.data, (rows, cols) = data, geometry.detector_shape
        self.factor = factor_within((rows, cols), _VOXELS)
        filled = np.zeros((1, rows, cols), np.float32) if unknown is None else unknown[None].astype(np.float32)
        self._measured = bin_views(filled, self.factor)[0] == 0
        self.geometry = geometry.binned(self.factor)

    def binned(self, numbers: NDArray[np.int64]) -> F32:
        from recon.base.masks import masked

        return np.concatenate([bin_views(masked(self.data[view : view + 1])[0], self.factor) for view in numbers])

    def sums(self, sample: Mask, grid: Grid, numbers: NDArray[np.int64]) -> AirSums:
        """Sums over the rays of some projections that miss the sample; the sample is a mask on a grid."""
        from recon.prep.background import AirSums
        from recon.voxels.projector import Projector

        sums, volume = AirSums(self.data.shape[1:], self.factor), sample.astype(np.float32)
        for part in np.array_split(numbers, max(1, numbers.size // _AT_ONCE)):
            paths = Projector(self.geometry.select(part), grid).forward(volume)
            for view, path in zip(self.binned(part), paths, strict=True):
                sums.add(view, (path <= 0) & self._measured)
        return sums


def without_background(
    of_scan: Views,
    surface: Surface,
    held_out: Views | None = None,
    unknown: Mask | None = None,
    levelled: float = 0.0,
) -> tuple[str, F64 | None]:
    """Subtract the background of the beam from projections, in place.

    Returns what was done in words (empty: nothing was done), and the coefficients of the mean subtracted surface.

    Args:
        surface: "auto": subtract it if the projections confirm it; a number: polynomials of this order.
        held_out: further projections, from which the same background is subtracted.
        unknown: bool [row, col], pixels that were not measured.
        levelled: line integral of the air at the edges that was already subtracted, mean over the projections.

    Raises:
        DataError: polynomials were requested, but too few rays miss the sample.
    """
    from recon.base.noise import noise_level
    from recon.voxels.beyond_field import reach_of

    if surface == "none":
        return "", None
    order = None if surface == "auto" else surface
    data = of_scan.data
    views = _BinnedViews(data, of_scan.geometry, unknown)
    fills_field = reach_of(of_scan).beyond  # such a sample would look like air
    shows_air = _see_all_sides(of_scan.geometry) and not fills_field
    fitted, sample_on_grid = _fitted(views, order) if shows_air else (None, None)
    if fitted is None or sample_on_grid is None:
        if order is None:
            return "", None
        raise DataError(
            "--air surface: no polynomial can be fitted, because too few rays miss the sample. Give --air "
            "columns or none."
        )
    if order is None and not fitted.confirmed(noise_level(views.binned(spread(np.arange(len(data)), _NOISE_VIEWS)))):
        return "", None
    description = _described(fitted, levelled)
    # If the line is subtracted and the projections are then brighter than their flats inside the sample's outline, the
    # beam has changed.
    if order is None and fitted.level > 0 and fitted.level + levelled > 0:
        return (
            "The background of the beam was not subtracted, because it is positive and may be weakly absorbing "
            f"material all around the sample: {description}. If the sample is surrounded by air, give --air "
            f"surface:{fitted.order}."
        ), None
    if held_out is not None:
        binned_others = _BinnedViews(held_out.data, held_out.geometry, unknown)
        background_of_others = binned_others.sums(*sample_on_grid, np.arange(len(binned_others.data))).fit(fitted.order)
        if background_of_others is not None:
            background_of_others.remove(binned_others.data)
    fitted.remove(data)
    sentence = (
        f"Background of the beam subtracted: {description}. The root mean square of the line integrals of air was "
        f"{fitted.before:.2g} before and is {fitted.after:.2g} now."
    )
    return sentence, fitted.coefficients.mean(axis=0)


def _described(fitted: Background, levelled: float) -> str:
    """A sentence about the fitted polynomial, and about the line that was subtracted before the fit."""
    from recon.prep.background import LEAST_SIZE

    line_text = ""
    if abs(levelled) >= LEAST_SIZE:
        line_text = f"a line through the air at the edges was subtracted ({levelled:+.3f} in line integral); then "
    return (
        f"{line_text}a polynomial of order {fitted.order} in column and row was fitted to the rays that miss the "
        f"sample ({fitted.air:.0%} of all rays). The polynomial is {fitted.lowest:+.3f} to {fitted.highest:+.3f} in "
        "line integral"
    )


def _see_all_sides(geometry: Geometry) -> bool:
    """True if there are enough projections without a wide gap in angle; otherwise a first volume does not show where
    the sample is.
    """
    angles = np.sort(np.mod(geometry.angles, geometry.period))
    gaps = np.diff(angles, append=angles[0] + geometry.period)
    return geometry.n_views >= _LEAST_VIEWS and bool(gaps.max() < _WIDEST_GAP)


def _fitted(views: _BinnedViews, order: int | None) -> tuple[Background | None, tuple[Mask, Grid]]:
    """The background of all projections, and a first volume from some projections, which shows where the sample is."""
    from recon.prep.background import near_material
    from recon.splatting.initialise import first_volume

    n, geometry = len(views.data), views.geometry
    numbers = spread(np.arange(n), _VIEWS)
    subset, grid = geometry.select(numbers), Grid.matching(geometry)
    _, y, x = grid.coordinates()
    radius = np.hypot(y[:, None], x)
    measured = views.binned(numbers)
    fitted = None
    for round_number, rim in enumerate(_RIMS):
        flattened = measured.copy()
        if fitted is not None:
            fitted.remove(flattened, factor=views.factor)
        in_field = radius <= geometry.reach - rim * grid.voxel_size
        if not in_field.any():  # a detector with a few columns has no voxel inside the sample
            return None, (np.zeros(grid.shape, np.bool_), grid)
        sample = near_material(first_volume(flattened, subset, grid).data, in_field)
        fitted = views.sums(sample, grid, np.arange(n) if round_number else numbers).fit(order)
        if fitted is None:
            break
    return fitted, (sample, grid)
