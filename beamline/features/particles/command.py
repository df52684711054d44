"""`beamline segment`: particles of a volume, their sizes and places."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from beamline.cli.options import (
    NOT_NEGATIVE,
    POSITIVE,
    SEED,
    FiniteRange,
    NameChoice,
    WholeRange,
    json_option,
    volume_argument,
)
from beamline.cli.recipe import Repeatable, typed_line
from beamline.cli.terminal import answering
from beamline.core.text import safe_name
from recon.base.choices import NECK

if TYPE_CHECKING:
    from beamline.features.particles.run import Segmented, SegmentOptions

_PERCENT = FiniteRange(min=0, max=100)


@click.command(cls=Repeatable)
@volume_argument
@click.option("--dataset", metavar="PATH", help="Array in an HDF5 file or .npz. Default: that of a reconstruction.")
@click.option(
    "--voxel-um", type=POSITIVE, help="Edge of a voxel. Default: as stated in the file, else lengths are in voxels."
)
@click.option(
    "--crop",
    type=NameChoice(["square", "none"]),
    help="square: the one inside the circle of the sample, without its wall; none: the whole volume. Default: square, "
    "unless it cuts half of the bodies or more.",
)
@click.option("--margin", type=FiniteRange(min=0, max=0.5, max_open=True), default=0.05, show_default=True,
              help="Share of the square's side taken off at each end.")  # fmt: skip
@click.option("--percentiles", type=_PERCENT, nargs=2, default=(0.5, 99.5), show_default=True, metavar="LOW HIGH",
              help="Percentiles at which grey values are clipped.")  # fmt: skip
@click.option("--gamma", type=POSITIVE, default=1.0, show_default=True, help="Power of the grey values, from 0 to 1.")
@click.option(
    "--sigma", type=NOT_NEGATIVE, default=0.7, show_default=True, help="Width of the Gaussian filter, voxels."
)
@click.option(
    "--clusters", type=WholeRange(2, 12), help="Classes of grey values (k-means). Default: by the elbow rule."
)
@click.option("--radius", type=WholeRange(0, 20), default=1, show_default=True,
              help="Radius of opening and closing, voxels; 0: neither.")  # fmt: skip
@click.option("--smallest", type=WholeRange(min=0), default=27, show_default=True,
              help="Voxels of the smallest particle that is kept.")  # fmt: skip
@click.option("--neck", type=NOT_NEGATIVE, default=NECK, show_default=True,
              help="Parts that touch are one particle where the neck is this share of the narrower part, or wider; 0: "
              "always.")  # fmt: skip
@click.option("--dark", is_flag=True, help="Particles are the darkest class, such as pores, not the densest.")
@click.option("--seed", type=SEED, default=0, show_default=True, help="Random seed of the clustering.")
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path, dir_okay=False),
    help="HDF5 file of the labels; .csv and .png lie beside it. Default: VOLUME's stem + _particles.h5, here.",
)
@json_option
def segment(
    volume: Path,
    voxel_um: float | None,
    crop: str | None,
    margin: float,
    clusters: int | None,
    output: Path | None,
    as_json: bool,
    **values: Any,
) -> None:
    """Segment the dense particles of VOLUME, or its pores (--dark): a reconstruction, or any HDF5, TIFF, NumPy or
    NIfTI volume.

    The grey values are rescaled between percentiles and smoothed, and parted by k-means. Particles are what is above
    half-way between the brightest cluster and the largest other one; opened, closed, filled, parted where they touch.

    Writes the labels as HDF5, a table of particles (volume, equivalent diameter, centroid) as CSV, and a picture of
    slices with labels. Look at the picture before you count. Nothing is overwritten.
    """
    from beamline.features.particles.run import SegmentOptions, settings_of
    from beamline.features.particles.run import segment as segment_volume

    output = output or Path(f"{safe_name(volume.name.split('.')[0])}_particles.h5")
    if output.suffix.lower() in (".csv", ".png"):
        raise click.UsageError(f"--output {output} is the HDF5 file of the labels; name it .h5")
    options = SegmentOptions(
        volume=volume,
        output=output,
        voxel_mm=None if voxel_um is None else voxel_um * 1e-3,
        margin=None if crop == "none" else margin,
        whole_if_cut=crop is None,
        n_clusters=clusters,
        command=typed_line(click.get_current_context()),
        **values,
    )
    with answering(as_json) as answer:
        labels = segment_volume(options)
        files = {"output": output, "table": options.table, "picture": options.picture}
        answer.done({**files, **settings_of(labels, options)}, summary(labels, options))


def summary(result: Segmented, options: SegmentOptions) -> str:
    """The result as lines for people."""
    figures, unit = result.particles.statistics(), result.unit
    _, rows, cols = result.box
    crop = "none, the whole volume"
    if options.whole_if_cut and result.margin is None:
        crop += ": the square inside the circle of the sample cuts most bodies (--crop square takes it)"
    if result.margin is not None:
        crop = (
            f"rows {rows.start}-{rows.stop - 1}, columns {cols.start}-{cols.stop - 1} of each slice: the square inside "
            f"the circle of the sample, less {result.margin:.3g} of its side at each end (--crop none, --margin)"
        )
    bodies, verb = ("1 body", "is") if result.outside == 1 else (f"{result.outside} bodies", "are")
    sizes = ", ".join(f"{name} {figures[name]:.4g}" for name in ("d10", "d50", "d90") if name in figures)
    facts = {
        "of use": result.verdict,
        "labels": options.output,
        "table": options.table,
        "picture": options.picture,
        "box": f"{' x '.join(map(str, result.labels.shape))} voxels of {result.volume.grid.voxel_size:g} {unit}",
        "crop": crop,
        "clusters": f"{result.clusters.centres.size}, threshold {result.clusters.threshold:.3f} of the range",
        "particles": f"{figures['particles']:.0f}, {figures['cut']:.0f} of them cut by a face of the box",
        "left out": result.outside
        and f"{bodies} as {'dark' if options.dark else 'bright'} outside the square {verb} no particle here; --crop "
        "none takes the whole volume, with its wall",
        "diameter": sizes and f"{sizes} {unit} (equivalent, of whole particles)",
    }
    return "\n".join(f"{name:<12}{text}" for name, text in facts.items() if text)
