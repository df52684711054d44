"""`beamline structure`: numbers of a volume's microstructure, with intervals."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from beamline.cli.options import json_option, parsed
from beamline.cli.recipe import Repeatable, typed_line
from beamline.cli.terminal import Answer, answering
from beamline.core.errors import ConfigError, DataError
from beamline.core.files import atomic_file, refuse_existing
from beamline.core.sinks import Note
from beamline.core.text import count, memory_size, safe_name

if TYPE_CHECKING:
    from splatline_structure.intervals import Found
    from splatline_structure.materials import Spacing
    from splatline_structure.volumes import Box, ReadSlices

_FILE = click.Path(path_type=Path)
FEWEST_VIEWS = 16  # that can be parted, 8 of each half


def edges_of(text: str) -> Spacing:
    """Parse edges of a voxel (z, y, x) in µm, one or three. Raises ValueError for others."""
    try:
        z, y, x = map(float, text.split(":") if ":" in text else [text] * 3)
    except ValueError:
        z = y = x = math.nan
    if not all(0 < edge < math.inf for edge in (z, y, x)) or not math.isclose(y, x, rel_tol=1e-3):
        raise ValueError(
            f"{text!r}: expected the edge of a voxel in µm, such as 0.65, or Z:Y:X, such as 3:1:1, with Y as X: pixels "
            "of a slice are squares"
        )
    return z, y, x


@dataclass(frozen=True, eq=False)
class Seen:
    """A volume that was read, and what was found in it.

    Attributes:
        grid, volume: of the box.
    """

    path: Path
    read: ReadSlices
    box: Box
    grid: Any
    volume: Any
    found: Found

    def voxels(self, slices: slice) -> str:
        """The box in these slices of the volume, as text."""
        return ",".join(f"{each.start}:{each.stop}" for each in (slices, *self.box[1:]))


@click.command(cls=Repeatable)
@click.argument("volumes", metavar="VOLUME...", nargs=-1, required=True, type=_FILE)
@click.option(
    "--compare",
    is_flag=True,
    help=("Compare two volumes, for example charged and discharged, and report what changed."),
)
@click.option(
    "--dataset",
    metavar="PATH",
    help=("Name of the array in an HDF5 or .npz file. Default: the volume of a reconstruction."),
)
@click.option("--voxel-um", metavar="EDGE|Z:Y:X", callback=parsed(edges_of),
              help=("Voxel size in µm: one value, or three (Z:Y:X). Default: the value in the file."))  # fmt: skip
@click.option(
    "--materials",
    type=click.IntRange(2, 6),
    help=("Number of materials in the volume. Default: the number of labels if VOLUME has labels, otherwise 2."),
)
@click.option(
    "--particles",
    type=click.IntRange(1),
    help=("Number of the material that forms the particles (1: the least dense). Default: the densest material."),
)
@click.option(
    "--through",
    type=click.IntRange(1),
    default=1,
    show_default=True,
    help=("Number of the material for connected fraction and tortuosity (1: the least dense, usually the pores)."),
)
@click.option(
    "--parts",
    metavar="A B",
    type=_FILE,
    nargs=2,
    help=(
        "Two volumes reconstructed from every other projection and from the remaining ones, for the interval: all "
        "slices, or only those that are measured. Default: they are reconstructed now."
    ),
)
@click.option(
    "--scan",
    type=click.Path(path_type=Path, exists=True, dir_okay=False),
    help=("Scan from whose two halves the volume is reconstructed again. Default: the scan that the volume names."),
)
@click.option(
    "--quick",
    is_flag=True,
    help=("Do not reconstruct again: the intervals do not include the error from the projections."),
)
@click.option("--crop", type=click.Choice(["square", "finite", "none"]), default="square", show_default=True,
              help="Part of each slice that is measured. square: the square inside the circle of the sample, or of the "
                  "field of view, without the wall of a can. finite: inside the circle beyond which voxels are not "
                  "finite. none: the whole slice.")  # fmt: skip
@click.option("--memory", metavar="SIZE", callback=parsed(memory_size),
              help="Memory for volumes, for example 8G. From a larger volume only the middle slices that fit are used, "
                  "except for fractions and surface, which use all slices. If you give several volumes, all slices are "
                  "used. Default: the free memory.")  # fmt: skip
@click.option(
    "--slices",
    type=click.IntRange(0),
    nargs=2,
    metavar="FIRST END",
    help=("Slices to measure, from FIRST up to, not including, END. Default: all."),
)
@click.option(
    "--radius",
    type=click.IntRange(0, 20),
    default=1,
    show_default=True,
    help=("Radius in voxels of the opening and closing by which particles are cleaned."),
)
@click.option(
    "--smallest",
    type=click.IntRange(0),
    default=27,
    show_default=True,
    help="Size of the smallest particle in voxels; smaller ones are dropped.",
)
@click.option(
    "--neck",
    type=click.FloatRange(min=0),
    default=0.8,
    show_default=True,
    help=(
        "Touching parts count as one particle if the neck between them is at least this fraction of the width of the "
        "narrower part. 0: always."
    ),
)
@click.option(
    "--side",
    type=click.IntRange(0),
    default=96,
    show_default=True,
    help=("Side in voxels of the central cube for the tortuosity. 0: no tortuosity."),
)
@click.option(
    "--labels",
    type=click.Choice(["h5", "tif", "zarr"]),
    default="h5",
    show_default=True,
    help="File format of the labels.",
)
@click.option(
    "-o",
    "--output",
    type=_FILE,
    help=("New folder for the results. Default: the name of VOLUME with _structure, in the current folder."),
)
@json_option
def structure(volumes: tuple[Path, ...], compare: bool, output: Path | None, as_json: bool, **values: Any) -> None:
    """Measure the microstructure of a volume: fractions, particles, surface, cracks, tortuosity.

    \b
    beamline structure VOLUME.h5
    beamline structure CHARGED.h5 DISCHARGED.h5 --compare

    The results are the volume fractions of the materials, particles, surface area, contacts, cracks, the connected
    fraction and the tortuosity. Each number has an interval that contains the true value with 80 % probability.

    The interval includes four causes of error: the projections (the volume is reconstructed again from each half of
    them), the grey levels of the materials, the voxel size, and the number of particles. If the interval is wider than
    half of the value, the number is reported as not determined.

    Several volumes are treated as a time series. A new folder is written, with report.html, numbers.csv,
    structure.json, particles.csv and the labels.
    """
    from beamline.core.machine import free_memory
    from beamline.storage.interrupted import volume_file
    from splatline_structure.volumes import read_volume

    if compare and len(volumes) != 2:
        raise click.UsageError(f"--compare needs two volumes, got {len(volumes)}.")
    if values["parts"] and (len(volumes) > 1 or values["scan"]):
        raise click.UsageError("--parts works only with one volume and without --scan.")
    paths = [volume_file(path) for path in volumes]
    output = output or Path(f"{safe_name(paths[0].name.split('.')[0])}_structure")
    with answering(as_json) as answer:
        refuse_existing(output)
        memory = free_memory() if values["memory"] is None else values["memory"]
        reads = [
            read_volume(
                path, values["dataset"], values["voxel_um"], values["slices"], memory, values["crop"],
                len(paths) > 1, answer.warn,
            )
            for path in paths
        ]  # fmt: skip
        seen = []
        for path, read in zip(paths, reads, strict=True):
            try:
                seen.append(_seen(path, read, answer, **values))
            except ValueError as error:
                raise DataError(f"{path} cannot be measured: {error}. Nothing was written.") from error
        _write(seen, compare, output, values, answer)


def _seen(path: Path, read: ReadSlices, answer: Answer, **values: Any) -> Seen:
    """One volume, and what was found in it."""
    from splatline_structure import intervals, volumes

    if read.limit_sentence:
        answer.warn(f"{path}: {read.limit_sentence}")
    box = volumes.box_in(read.record.volume.data, values["crop"])
    seen = measured(path, read, box, answer, **values)
    if not read.limit_sentence:
        return seen
    slabs = volumes.slabs_of(path, values["dataset"], read, seen.box, answer.counting("slabs"))
    return replace(seen, found=intervals.with_all_slices(seen.found, slabs))


def measured(path: Path, read: ReadSlices, box: Box, answer: Answer, **values: Any) -> Seen:
    """What was found in the slices of a volume.

    Args:
        box: that is looked at, also in the volumes from parts of the views.

    Raises:
        ConfigError: a material that is not there. ValueError: no contrast, or parts of other shapes.
    """
    import numpy as np

    from splatline_structure.intervals import found_in
    from splatline_structure.materials import label_values
    from splatline_structure.numbers import Rules

    grid, data, parts = read.record.grid.part(*box), read.record.volume.data, []
    volume = np.ascontiguousarray(data[box])
    labels = label_values(volume)
    n_materials = values["materials"] or labels.size or 2
    particles = values["particles"] or n_materials
    if labels.size not in (0, n_materials):
        raise ValueError(
            f"it holds {labels.size} values ({', '.join(f'{each:g}' for each in labels)}), which are labels, not grey "
            f"values: {n_materials} --materials cannot be told among them; leave it out, and each label is a material"
        )
    if labels.size:
        materials = (f"{each:g} is material {number}" for number, each in enumerate(labels, 1))
        answer.warn(Note(f"{path} is taken as labels, not as grey values: the value {', '.join(materials)}."))
    if max(particles, values["through"]) > n_materials:
        raise ConfigError(
            f"Material {max(particles, values['through'])} of {n_materials}: they are numbered from 1. Nothing was "
            "written."
        )
    for half in _parts(path, read, answer, **values):
        if half.shape != data.shape:
            raise ValueError(
                f"the volume from half of its views has the shape {half.shape}, not {data.shape}: give --parts of "
                "these voxels, or --quick"
            )
        parts.append(np.ascontiguousarray(half[box]))
    rules = Rules(particles, values["through"], values["radius"], values["smallest"], values["neck"], values["side"])
    dz, dy, dx = (1e3 * edge for edge in grid.spacing)
    try:
        found = found_in(volume, parts, n_materials, (dz, dy, dx), rules, answer.counting("structures"))
    except ValueError as error:
        way_out = (
            f"only slices {read.slices.start}:{read.slices.stop}, which memory holds, were looked at: give more "
            "--memory, or others by --slices"
            if read.limit_sentence
            else "reconstruct from more views"
        )
        raise ValueError(f"{error}; {way_out}{', or give fewer --materials' if n_materials > 2 else ''}") from error
    return Seen(path, read, box, grid, volume, found)


def _parts(path: Path, read: ReadSlices, answer: Answer, **values: Any) -> list[Any]:
    """The slices of the volume from each half of its views; none where they are not asked for, or not there."""
    from beamline.storage.volumes.files import opened_volume
    from splatline_structure.volumes import parts_of

    if values["quick"]:
        return []
    if values["parts"]:
        halves = []
        for half in values["parts"]:
            with opened_volume(half) as opened:
                holds_all = opened.grid.shape[0] == read.n_slices  # or these slices alone
                halves.append(opened.volume.data[read.slices if holds_all else slice(None)])
        return halves
    scan = values["scan"] or Path(read.record.raw_file)
    if not scan.is_file():
        answer.warn(
            f"{path}: its scan is not there ({scan}): the intervals are without what the views do. Give --scan or "
            "--parts."
        )
        return []
    if (n_views := int(read.record.parameters.get("n_views", FEWEST_VIEWS))) < FEWEST_VIEWS:
        raise ValueError(f"{n_views} views are too few to be parted: give --quick")
    return parts_of(read, scan, 2, answer.warn, answer.counting("halves of the views"))


def _write(seen: list[Seen], compare: bool, output: Path, values: dict[str, Any], answer: Answer) -> None:
    """Write the folder, and say what is in it."""
    from beamline.core.events import json_of
    from beamline.report.html import Picture
    from splatline_structure import intervals, pictures, results

    first = seen[0]
    table = first.found.intervals
    shown = pictures.pictures_of(first.found, first.volume, first.grid, first.read)
    title = f"{seen[1].path.name} less {first.path.name}" if compare else f"Structure of {first.path.name}"
    settings = {
        "volume": first.path,
        **{name: value for name, value in values.items() if value is not None},
        "command": typed_line(click.get_current_context()),
    }
    states = [
        results.facts_of(each.found, {
            **settings, "volume": each.path, "box": each.voxels(each.read.slices),
            "box_of_all": each.voxels(each.read.asked), "limit": each.read.limit_sentence,
        })
        for each in seen
    ]  # fmt: skip
    if compare:
        table = {name: intervals.difference(each, seen[1].found.intervals[name]) for name, each in table.items()}
    if len(seen) > 1:
        curves = {
            name: [each.found.intervals[name] for each in seen]
            for name, interval in first.found.intervals.items()
            if not interval.why_not
        }
        at = [float(each.read.record.parameters.get("time_s", k)) for k, each in enumerate(seen)]
        if curves:
            drawn = pictures.curves_of(curves, at, "volume")
            shown.insert(0, Picture("Numbers of all volumes", "Values with their intervals.", drawn))
    particles = first.found.structure.particles
    undecided = (
        f"{first.found.undecided:.1%} of the voxels are undecided; "
        f"{count(particles.label.size, 'particle')}, {int(particles.cut.sum())} cut by a face of the box."
    )
    limits = [f"{first.path}: {first.read.limit_sentence}"] if first.read.limit_sentence else []
    box = " and ".join(each.voxels(each.read.slices) for each in (seen if compare else [first]))
    texts = {
        "report.html": results.page(title, undecided, limits, shown, table, settings),
        "numbers.csv": results.numbers_table(table, box, first.voxels(first.read.asked)),
        "structure.json": json_of(states[0] if len(seen) == 1 else {"states": states}),
        "particles.csv": results.particles_table(particles, first.grid),
    }
    labels: dict[str, Any] = {
        f"materials.{values['labels']}": first.found.structure.labels + 1,
        f"particles.{values['labels']}": first.found.structure.numbered,
    }
    with atomic_file(output) as partial:
        results.write_all(partial, texts, labels, first.read.record, first.grid)
    answer.done(
        {"output": output, **states[0]}, title, *results.lines_of(table), undecided, *limits, f"output  {output}"
    )
