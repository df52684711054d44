"""A volume file in; labels, a table of particles and a picture out."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from matplotlib.colors import ListedColormap
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.files import atomic_file, refuse_existing, write_together, write_whole
from beamline.core.installed import version
from beamline.core.text import count, csv_text
from beamline.report.figures import WIDTH, draw_slice, finish, new_figure, planes, png
from beamline.storage import hdf5
from beamline.storage.readers.open import open_scan
from beamline.storage.volumes.files import opened_volume
from beamline.storage.writers.recon_file import DEVIATION, new_plot
from recon.base.choices import NECK
from recon.base.greys import matter_window
from recon.base.volume import Grid, Volume
from recon.features.particles import (
    Particles,
    bodies_outside,
    cleaned,
    measured,
    parted,
    volume_deviation,
)
from recon.post import (
    Box,
    Clusters,
    clusters,
    enhanced,
    enhanced_deviation,
    grey_at,
    inscribed_box,
    sample_circle,
)

_SIGNAL = "entry/data/data"  # where `beamline recon` and `simulate --truth` have the volume


@dataclass(frozen=True)
class SegmentOptions:
    """What to segment and how; the steps are those of recon.post.

    Attributes:
        dataset: the array in the file; None: the volume of a reconstruction, or the only array.
        output: HDF5 file of the labels; the table and the picture lie beside it.
        voxel_mm: edge of a voxel where the file does not say it; None: as the file says, or 1 px.
        margin: of the square inside the sample's circle; None: the whole volume.
        whole_if_cut: take the whole volume, too, where the square cuts half of the bodies or more.
        n_clusters: of grey values; None: by the elbow rule.
        neck: where touching particles are parted; 0: nowhere.
        dark: particles are of the darkest class, such as pores.
    """

    volume: Path
    dataset: str | None
    output: Path
    voxel_mm: float | None = None
    margin: float | None = 0.05
    whole_if_cut: bool = False
    percentiles: tuple[float, float] = (0.5, 99.5)
    gamma: float = 1.0
    sigma: float = 0.7
    n_clusters: int | None = None
    radius: int = 1
    smallest: int = 27
    neck: float = NECK
    dark: bool = False
    seed: int = 0
    command: str = ""

    @property
    def table(self) -> Path:
        return self.output.with_suffix(".csv")

    @property
    def picture(self) -> Path:
        return self.output.with_suffix(".png")


@dataclass(frozen=True, eq=False)
class Segmented:
    """The result of a segmentation.

    Attributes:
        box: the part of the volume in the file that was segmented.
        volume: this part, as it is in the file, on its grid.
        unit: "mm", or "px" where nobody knows the size of a voxel.
        labels: int32 [z, y, x] of the same shape; 0: no particle.
        clusters: of the enhanced grey values.
        particles: of the labels.
        volume_deviation: of each particle's volume; None where the file has no error bars.
        outside: bodies as bright as particles, and as large as the smallest, that lie outside the box; not the wall.
        margin: as of the options, None also where the whole volume was taken instead.
        dark: as of the options.
    """

    box: Box
    volume: Volume
    unit: str
    labels: NDArray[np.int32]
    clusters: Clusters
    particles: Particles
    volume_deviation: NDArray[np.float64] | None = None
    outside: int = 0
    margin: float | None = None
    dark: bool = False

    @property
    def verdict(self) -> str:
        """Whether the table is usable, and which option to give if it is not."""
        n, cut, k = self.particles.label.size, int(self.particles.cut.sum()), self.clusters.centres.size
        other = "--clusters and --percentiles LOW HIGH take weaker matter" + ", --dark pores" * (not self.dark)
        which = f"the {'darkest' if self.dark else 'densest'} of {k} classes"
        if n == 0:
            return f"no, nothing of {which} is as large as --smallest: {other}"
        if 2 * cut > n:
            whole = "" if self.margin is None else "--crop none takes the whole volume, "
            return f"no, {cut} of {count(n, 'particle')} of {which} are cut by a face: {whole}{other}"
        return f"yes, {count(n - cut, 'whole particle')} of {which}" + (f"; {other}" if n == 1 else "")


def segment(options: SegmentOptions) -> Segmented:
    """Segment the volume, and write labels, table and picture; all of them or none.

    Raises:
        ConfigError, DataError: nothing was written.
    """
    for path in (options.output, options.table, options.picture):
        refuse_existing(path)
    volume, unit = _read(options)
    try:
        segmented = _segmented(volume, unit, options)
        if options.whole_if_cut and 2 * segmented.particles.cut.sum() >= segmented.particles.cut.size:
            whole = _segmented(volume, unit, replace(options, margin=None))
            if whole.particles.cut.mean() < 0.5:  # NaN without any
                segmented = whole
    except ValueError as error:
        raise DataError(f"{options.volume} cannot be segmented: {error}. Nothing was written.") from error
    picture = picture_of(segmented.volume, segmented.unit, segmented.labels, segmented.particles)
    write_together(
        (
            (options.output, partial(_write_labels, segmented, options)),
            (options.table, partial(write_whole, content=table_of(segmented))),
            (options.picture, partial(write_whole, content=picture)),
        )
    )
    return segmented


def _segmented(volume: Volume, unit: str, options: SegmentOptions) -> Segmented:
    nz, ny, nx = volume.grid.shape
    box: Box = slice(0, nz), slice(0, ny), slice(0, nx)
    whole, outside, sign = volume.data, 0, -1 if options.dark else 1
    if options.margin is not None:
        box = inscribed_box(volume.grid.shape, sample_circle(volume.data), options.margin)
        volume = Volume(np.ascontiguousarray(volume.data[box]), volume.grid.part(*box))
    data = sign * volume.data
    grey = enhanced(data, options.percentiles, options.gamma, options.sigma)
    greys = clusters(grey, options.n_clusters, options.seed)
    labels = parted(cleaned(grey > greys.threshold, options.radius, options.smallest), options.neck)
    if options.margin is not None:
        bright = sign * whole > grey_at(data, greys.threshold, options.percentiles, options.gamma)
        outside = bodies_outside(cleaned(bright, options.radius, options.smallest), box)
    particles, bars = measured(labels, volume.grid.spacing, volume.grid.first), None
    deviation = _deviation(options, box)
    if deviation is not None and deviation.shape == volume.data.shape:
        of_grey = enhanced_deviation(data, deviation, options.percentiles, options.gamma)
        bars = volume_deviation(labels, grey, of_grey, greys.threshold) * np.prod(volume.grid.spacing)
    return Segmented(box, volume, unit, labels, greys, particles, bars, outside, options.margin, options.dark)


def _deviation(options: SegmentOptions, box: Box) -> NDArray[np.float32] | None:
    """The standard deviation of the voxels in the box, beside the volume of a reconstruction; None without it."""
    if options.dataset not in (None, _SIGNAL) or not h5py.is_hdf5(options.volume):
        return None
    with hdf5.open_hdf5(options.volume) as file:
        deviation = file.get(f"entry/data/{DEVIATION}")
        return np.asarray(deviation[box], np.float32) if isinstance(deviation, h5py.Dataset) else None


def _read(options: SegmentOptions) -> tuple[Volume, str]:
    """The volume on its grid, and the unit of length.

    Raises:
        DataError: it cannot be read, or is no volume of finite numbers.
    """
    path = options.volume
    if options.dataset is None and path.is_file() and h5py.is_hdf5(path) and _is_scan(path):
        raise DataError(
            f"{path} is a scan: its frames are no slices. Reconstruct it with `beamline recon`, and segment the "
            "volume. Nothing was written."
        )
    with opened_volume(path, options.dataset) as record:
        grid, unit = record.volume.grid, record.length_unit
        values = np.ascontiguousarray(record.volume.data[: grid.shape[0]], np.float32)
    if min(values.shape) < 3:
        raise DataError(f"{path} holds {values.shape}; expected a volume [z, y, x] of 3 or more voxels a side.")
    if not np.isfinite(values).all():
        raise DataError(f"{path} has values that are not finite; nothing was written.")
    if options.voxel_mm is not None:
        grid, unit = Grid(values.shape, options.voxel_mm), "mm"
    return Volume(values, grid), unit


def _is_scan(path: Path) -> bool:
    with suppress(DataError), open_scan(path):
        return True
    return False


def table_of(found: Segmented) -> str:
    """The table as text, one line for each particle, largest first."""
    unit, particles = found.unit, found.particles
    heading = [f"volume_{unit}3", f"equivalent_diameter_{unit}", f"z_{unit}", f"y_{unit}", f"x_{unit}", "cut"]
    bars = found.volume_deviation
    interval = [] if bars is None else [f"volume_low_{unit}3", f"volume_high_{unit}3"]
    rows = [["label", *heading, *interval]]
    for i in np.argsort(-particles.volume, kind="stable").tolist():
        sizes = (particles.volume[i], particles.diameter[i], *particles.centroid[i])
        ends = () if bars is None else (max(particles.volume[i] - bars[i], 0.0), particles.volume[i] + bars[i])
        row = [particles.label[i], *(f"{value:.6g}" for value in sizes), int(particles.cut[i])]
        rows.append([*row, *(f"{value:.6g}" for value in ends)])
    return csv_text(rows)


def settings_of(found: Segmented, options: SegmentOptions) -> Mapping[str, Any]:
    """All settings that determine the labels, and the figures of all particles, by name."""
    low, high = options.percentiles
    return {
        "margin": "none" if found.margin is None else found.margin,
        "percentile_low": low, "percentile_high": high, "gamma": options.gamma, "sigma": options.sigma,
        "clusters": found.clusters.centres.size, "threshold": found.clusters.threshold, "radius": options.radius,
        "smallest": options.smallest, "neck": options.neck, "seed": options.seed,
        **({"dark": True} if found.dark else {}), **found.particles.statistics(),
        "outside": found.outside, "unit": found.unit,
    }  # fmt: skip


def _write_labels(found: Segmented, options: SegmentOptions, output: Path) -> None:
    with atomic_file(output) as new, hdf5.created(new) as file:
        data = new_plot(file, "labels", found.volume.grid, found.unit)
        process = data.parent.create_group("process")
        process.attrs["NX_class"] = "NXprocess"
        process["program"], process["version"], process["command"] = "splatline", version(), options.command
        process["volume"] = str(options.volume.resolve())
        for name, value in settings_of(found, options).items():
            process[name] = value
        chunks = (1, *found.labels.shape[1:])
        data.create_dataset("labels", data=found.labels, chunks=chunks, compression="gzip", compression_opts=1)


_SLICES, _COLOURS = 3, 12


def picture_of(volume: Volume, unit: str, labels: NDArray[np.int32], particles: Particles) -> bytes:
    """Three slices, the same with each particle in a colour, and a histogram of diameters, as PNG."""
    z, y, x = volume.grid.coordinates()
    at = np.linspace(0, z.size - 1, _SLICES + 2).round().astype(int)[1:-1]
    column = WIDTH / _SLICES
    figure = new_figure((WIDTH, 2 * column * y.size / x.size + 3.2))
    ratios = (2 * column * y.size / x.size + 0.8, 2.4)
    upper, lower = np.ravel(figure.subfigures(2, 1, squeeze=False, height_ratios=ratios))
    panels = upper.subplots(2, _SLICES, sharex=True, sharey=True)
    window = matter_window(volume.data[at])
    # Neighbours in the order of labels get different colours; the same colour comes again after twelve.
    colours = ListedColormap([(0, 0, 0, 0), *figure_colours()])
    for column_of, k in zip(panels.T, at, strict=True):
        n = np.unique(labels[k]).size - bool((labels[k] == 0).any())
        for axes, title in zip(column_of, (f"z = {z[k]:.3g} {unit}", f"{n} particles here"), strict=True):
            drawn = draw_slice(axes, volume.data[k], planes(volume.grid, unit)[0], title, window, size=7)
            axes.label_outer()
        shown = np.where(labels[k] > 0, (labels[k] - 1) % _COLOURS + 1, 0)
        shown[1:][(labels[k][1:] != labels[k][:-1]) & (labels[k][:-1] > 0)] = 0  # a line between those that touch
        shown[:, 1:][(labels[k][:, 1:] != labels[k][:, :-1]) & (labels[k][:, :-1] > 0)] = 0
        column_of[1].imshow(
            shown, cmap=colours, vmin=0, vmax=_COLOURS, extent=drawn.get_extent(), interpolation="nearest", alpha=0.65
        )
    axes = lower.subplots()
    whole = ~particles.cut
    if particles.label.size:
        bins = np.histogram_bin_edges(particles.diameter, bins=min(30, max(5, particles.label.size // 4)))
        parts = [particles.diameter[whole], particles.diameter[~whole]]
        axes.hist(parts, bins.tolist(), stacked=True, color=["tab:blue", "0.7"], label=["whole", "cut by a face"])
    title = f"{particles.label.size} particles, {int(particles.cut.sum())} of them cut by a face"
    finish(axes, f"equivalent diameter ({unit})", "particles", title, 8)
    return png(figure)


def figure_colours() -> list[tuple[float, float, float, float]]:
    """Twelve bright colours, neighbours far apart in hue."""
    from matplotlib import colormaps

    hues = np.mod(np.arange(_COLOURS) * 5 / _COLOURS, 1.0)  # 5 and 12 have no common factor
    return [tuple(colour) for colour in colormaps["hsv"](hues).tolist()]
