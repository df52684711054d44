"""Sweep: the same slice with each value of one or two options, and how well each volume predicts views held out."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from beamline.core.errors import DataError
from beamline.core.events import Sink
from beamline.core.sinks import Warnings
from beamline.features.sweeps.values import SweptOption
from beamline.projections.prepare import prepare_projections
from beamline.projections.prepared import PreparedProjections, hold_out
from beamline.projections.selection import Selection, cone_of, rows_of
from beamline.reconstruct.job import compile_kernels, progress_events, runner_of
from beamline.reconstruct.options import ReconOptions
from beamline.report.figures import WIDTH, new_figure, png, show_image
from drivers.base.clock import Clock
from recon.base.arrays import F32, F64, I64
from recon.base.empirical import ONE_IN
from recon.base.greys import matter_window
from recon.base.method import Reconstruction, RunControl
from recon.base.volume import Grid
from recon.voxels.choice import predicts_as_well
from recon.voxels.projector import Projector
from recon.voxels.residuals import squares_left
from recon.voxels.resolution import ViewResolution

_FLAT = 0.05  # share by which the residual of a direct method must change: one of 0.03 named an axis 0.7 columns off
_TALLEST = 16  # rows of a slab around the slice, as of trials of a method


@dataclass(frozen=True, eq=False)
class SweptSlice:
    """The slice reconstructed with one value of each option.

    Attributes:
        values: of the options, by name.
        image: [y, x] in 1/mm (1/px), the middle slice of the rows.
        seconds: of the reconstruction.
        views: corrected as its own options say, some of them held out.
        projected: [view, row, col] what the volume shows in those held out, at this resolution.
    """

    values: Mapping[str, str]
    image: F32
    seconds: float
    views: PreparedProjections
    projected: F32
    resolution: ViewResolution

    @property
    def ids(self) -> I64:
        """Rows of the file of the views held out."""
        assert self.views.held_out_ids is not None
        return self.views.held_out_ids

    def held_out(self, ids: I64) -> F32:
        """Views held out [view, row, col], by these rows of the file; pixels that were not measured are NaN."""
        assert self.views.held_out is not None
        data, measured = self.views.held_out[0][np.searchsorted(self.ids, ids)], self.views.measured
        return data if measured is None else np.where(measured, data, np.float32(np.nan))


@dataclass(frozen=True, eq=False)
class Scores:
    """How well each slice's volume predicts held-out views.

    Attributes:
        residuals: [slice, view] root mean square, as a share of that of all these views.
        same_views: all options give the same views; else each volume is compared with the views by all of them.
        direct: the volumes are of a direct method, which leaves mostly the blur of its filter.
    """

    residuals: F64
    same_views: bool
    direct: bool = False

    @property
    def shares(self) -> F64:
        """[slice] data residual of the held-out views, as in `recon.judgement`."""
        return np.asarray(np.sqrt(np.square(self.residuals).mean(axis=1)))

    @property
    def best(self) -> int | None:
        """The slice of least residual; None if that of a direct method hardly depends on the values."""
        flat = self.direct and np.ptp(self.shares) <= _FLAT * self.shares.min()
        return None if flat else int(np.argmin(self.shares))

    @property
    def verdicts(self) -> list[str]:
        """Verdict [slice]: "best"; "alike", not significantly different from the best; or empty."""
        if self.best is None:
            return [""] * len(self.residuals)
        words = ["alike" if predicts_as_well(each, self.residuals[self.best]) else "" for each in self.residuals]
        return [*words[: self.best], "best", *words[self.best + 1 :]]


def sliced(trials: Sequence[ReconOptions]) -> list[ReconOptions]:
    """The same reconstruction options for a few rows around the middle.

    A direct method needs the row of the slice alone, total variation and fits some beside it. Of a cone, and where rows
    are given, all of them are made.

    Raises:
        ConfigError, DataError: a scan or a selection that is refused.
    """
    halo = max(min(trial.method.halo, (_TALLEST - 1) // 2) for trial in trials)
    return [replace(trial, selection=_middle(trial, halo)) for trial in trials]


def _middle(trial: ReconOptions, halo: int) -> Selection:
    selection = trial.selection
    with trial.source.open() as source:
        rows, n = rows_of(source, selection), selection.binning
        if selection.rows is not None or cone_of(source, selection) is not None:
            return selection
    height = min(2 * halo + 1, (rows.stop - rows.start) // n) * n
    first = rows.start + (rows.stop - rows.start - height) // 2
    return replace(selection, rows=(first, first + height), axis_rows=selection.axis_rows or (rows.start, rows.stop))


def sweep_slices(
    trials: Sequence[tuple[Mapping[str, str], ReconOptions]],
    sink: Sink,
    clock: Clock,
    progress: Callable[[int, int], None],
) -> Iterator[SweptSlice]:
    """Reconstruct each slice in turn. Views are corrected once for all values that do not affect the correction.

    The rotation axis is found once, so that slices differ by the options alone; where it is swept, views are corrected
    about the axis in the middle.

    Raises:
        ConfigError, DataError: see `beamline recon`.
    """
    warn, first = Warnings(sink, clock), repr(trials[0][1].source)
    axis = middle_axis([options.selection for _, options in trials])
    of_axes = axis is not None
    selected: tuple[str, Selection] | None = None
    progress(0, len(trials))
    for n, (values, options) in enumerate(trials, 1):
        asked, source_words = options.selection, repr(options.source)
        its_own = not of_axes and (asked.axis_col is not None or source_words != first)
        wanted = asked if its_own else replace(asked, axis_col=axis)
        if selected != (source_words, wanted):
            with options.source.open() as source:
                views = prepare_projections(source, wanted, warn)
            views = hold_out(views, ONE_IN, advice="take a scan with more views")
            if wanted.axis_col is None and source_words == first:
                axis = views.axis_col
                wanted = replace(wanted, axis_col=axis)
            selected = source_words, wanted
        own = views if asked.axis_col is None or not of_axes else _about(views, asked)
        made = swept_slice(options, own, Grid.matching(views.geometry), sink, clock)
        assert own.held_out is not None
        projector = Projector(own.held_out[1], made.volume.grid)
        projected = projector.forward(np.asarray(made.volume.data))
        image = np.array(made.volume.data[made.volume.data.shape[0] // 2])
        yield SweptSlice(values, image, made.seconds, views, projected, projector.resolution)
        progress(n, len(trials))


def swept_slice(
    options: ReconOptions, prepared: PreparedProjections, grid: Grid, sink: Sink, clock: Clock
) -> Reconstruction:
    compile_kernels(options, prepared.geometry, sink, clock)
    control = RunControl(on_progress=progress_events(sink, clock), now=clock.now)
    return runner_of(options)(options.method_for(prepared.geometry), prepared, grid, control)


def middle_axis(selections: Sequence[Selection]) -> float | None:
    """The axis used to correct all views if the axis itself is swept; None if it is not.

    Corrections look at views on both sides of the axis: with each its own, some would correct and others not.
    """
    axes = sorted(each.axis_col for each in selections if each.axis_col is not None)
    return axes[len(axes) // 2] if len(axes) == len(selections) and axes[0] < axes[-1] else None


def _about(prepared: PreparedProjections, selection: Selection) -> PreparedProjections:
    """The same views about the axis of the selection."""
    assert prepared.held_out is not None and selection.axis_col is not None
    data, unseen = prepared.held_out
    n = selection.binning
    axis_col = (selection.axis_col - (n - 1) / 2) / n
    return replace(
        prepared,
        geometry=replace(prepared.geometry, axis_col=axis_col),
        axis_col=selection.axis_col,
        held_out=(data, replace(unseen, axis_col=axis_col)),
    )


def scores_of(slices: Sequence[SweptSlice], *, direct: bool = False) -> Scores | None:
    """Residual of each volume in the held-out views; None if slices differ in pixels, or in their held-out views.

    A correction changes these views, too: one that smooths would be judged by smoother views. So each volume is
    compared with them as every value corrects them, and the mean counts.
    """
    shapes = {each.projected.shape[1:] for each in slices}
    common = reduce(np.intersect1d, (each.ids for each in slices))
    if len(shapes) > 1 or not common.size:
        return None
    judges = {id(each.views): each for each in reversed(slices)}.values()  # one resolution for all geometries
    residuals, first = np.zeros((len(slices), common.size)), slices[0].held_out(common)
    scale, alike = 0.0, True
    for judge in judges:
        measured, resolution = judge.held_out(common), judge.resolution.select(np.searchsorted(judge.ids, common))
        if not np.isfinite(measured).any(axis=(1, 2)).all():
            return None
        alike &= np.array_equal(measured, first, equal_nan=True)
        for n, each in enumerate(slices):
            model = each.projected[np.searchsorted(each.ids, common)].swapaxes(1, 2)
            left, own, _ = squares_left(model, measured.swapaxes(1, 2), None, resolution)
            residuals[n] += np.sqrt(left)
        scale += float(np.sqrt(own.mean()))
    if scale == 0:
        raise DataError("The views held out show nothing: there is nothing to compare the slices with.")
    return Scores(residuals / scale, alike, direct)


_COLUMNS = 4  # pictures in a row
_COLOURS = {"best": "tab:red", "alike": "tab:orange", "": "black"}  # of frames and points, by verdict
_CROP = 200  # pixels a side: of larger slices the part is shown that changes most, in proportion to its values


def sweep_sheet(
    slices: Sequence[SweptSlice], scores: Scores | None, options: Sequence[SweptOption], title: str
) -> bytes:
    """The slices as PNG, y downwards. The best is framed in red, those not significantly different in orange.

    Two options make a grid, the values of the second one side by side.
    """
    across = len(options[1].values) if len(options) > 1 else min(_COLUMNS, len(slices))
    down = -(-len(slices) // across)
    part = _changes_most([each.image for each in slices])
    images = [each.image[part] for each in slices]
    window = matter_window(*images)
    tall, wide = images[0].shape
    height = WIDTH / across * tall / wide + 0.42
    figure = new_figure((WIDTH, height * down + 0.3))
    figure.suptitle(title, fontsize=9)
    verdicts = [""] * len(slices) if scores is None else scores.verdicts
    for n, (each, image) in enumerate(zip(slices, images, strict=True)):
        axes = figure.add_subplot(down, across, n + 1)
        show_image(axes, image, window)
        axes.set(xticks=[], yticks=[])
        if n == 0:
            axes.set(xlabel="x →", ylabel="← y")
        colour = _COLOURS[verdicts[n]]
        words = ", ".join(f"{name} {value}" for name, value in each.values.items())
        score = "" if scores is None else f"\n{scores.shares[n]:.5g}"
        axes.set_title(words + score, fontsize=7, color=colour)
        for side in axes.spines.values():
            side.set(color=colour, linewidth=0.8 if colour == "black" else 2.5)
    return png(figure)


def _changes_most(images: Sequence[NDArray[np.float32]]) -> tuple[slice, slice]:
    """The square of the slices in which the options change most; all of them where they are small or differ in size."""
    shape = images[0].shape
    if max(shape) <= _CROP or any(image.shape != shape for image in images):
        return slice(None), slice(None)
    size = tuple(min(_CROP, n) for n in shape)
    sums = ndimage.uniform_filter(np.ptp(np.stack(images), axis=0), size, mode="constant")
    whole = [slice(n // 2, side - (n - 1) // 2) for n, side in zip(size, shape, strict=True)]  # squares in the slice
    at = np.unravel_index(int(np.argmax(sums[tuple(whole)])), sums[tuple(whole)].shape)
    rows, cols = (slice(int(first), int(first) + n) for first, n in zip(at, size, strict=True))
    return rows, cols
