"""`beamline structure`: measures the microstructure of a volume; each number has an interval."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from beamline.cli.options import json_option, parsed
from beamline.cli.recipe import Repeatable, typed_line
from beamline.cli.terminal import Answer, answering
from beamline.core.errors import DataError
from beamline.core.files import atomic_file, refuse_existing
from beamline.core.text import count, memory_size, safe_name
from splatline_structure.options import edges_of, numbers_in_text, refuse_together

if TYPE_CHECKING:
    from splatline_structure.measuring import Seen

_FILE = click.Path(path_type=Path)


@click.command(cls=Repeatable)
@click.argument("volumes", metavar="VOLUME...", nargs=-1, required=True, type=_FILE)
@click.option("--compare", is_flag=True, help="Print what changed between two volumes, such as charged and discharged.")
@click.option(
    "--states",
    is_flag=True,
    help=(
        "Measure particles in later states of a sample. The first file is the reference: the volume of a scan with "
        "many projections. All other files are scans of later states with few projections, not volumes."
    ),
)
@click.option(
    "--charge",
    metavar="C,C,...",
    callback=parsed(numbers_in_text),
    help="With --states: state of charge of each state, against which curves are drawn. Default: the time.",
)
@click.option(
    "--dataset",
    metavar="PATH",
    help="Array to read from an HDF5 file or .npz. Default: where `beamline recon` writes the volume.",
)
@click.option("--voxel-um", metavar="EDGE|Z:Y:X", callback=parsed(edges_of),
              help="Edge of a voxel in µm, or the three edges of a voxel. Default: as the file states.")  # fmt: skip
@click.option(
    "--materials",
    type=click.IntRange(2, 6),
    help="Number of materials. Default: the number of labels in the volume, or 2 for grey values.",
)
@click.option(
    "--particles",
    type=click.IntRange(1),
    help=(
        "Number of the material that forms the particles; 1 is the least dense material. Default: the densest material."
    ),
)
@click.option(
    "--through",
    type=click.IntRange(1),
    default=1,
    show_default=True,
    help="Number of the material in which the connected share and the tortuosity are measured, from 1.",
)
@click.option(
    "--parts",
    metavar="A B",
    type=_FILE,
    nargs=2,
    help="Two files: the volumes reconstructed from the two halves of the projections. Each file has all slices, or "
    "only the measured slices. Default: the command reconstructs both volumes from the scan.",
)
@click.option(
    "--scan",
    type=click.Path(path_type=Path, exists=True, dir_okay=False),
    help=(
        "Scan from which the volume was made. The command reconstructs the scan again from each half of the "
        "projections. Default: the scan that the volume names."
    ),
)
@click.option(
    "--quick",
    is_flag=True,
    help="Faster: do not reconstruct the scan again from each half of the projections. The intervals then leave out "
    "the error that comes from few projections.",
)
@click.option(
    "--crop",
    type=click.Choice(["square", "finite", "none"]),
    default="square",
    show_default=True,
    help=(
        "Part of a slice to measure. square: the largest square inside the sample or the field of view, without the "
        "wall of a can. finite: the largest square inside the circle of finite voxels. none: the whole slice."
    ),
)
@click.option(
    "--memory",
    metavar="SIZE",
    callback=parsed(memory_size),
    help="Memory to use, such as 8G. If the volume needs more, only the middle slices that fit are measured; "
    "fractions and surface are still measured on all slices. Several volumes must fit completely. Default: the free "
    "memory.",
)
@click.option(
    "--slices",
    type=click.IntRange(0),
    nargs=2,
    metavar="FIRST END",
    help="First slice to measure, and the slice after the last slice to measure. Default: all slices.",
)
@click.option(
    "--radius",
    type=click.IntRange(0, 20),
    default=1,
    show_default=True,
    help="Radius, in voxels, of the ball for the morphological opening and closing of particles; 0: no opening and "
    "closing.",
)
@click.option(
    "--smallest",
    type=click.IntRange(0),
    default=27,
    show_default=True,
    help="Drop particles of fewer voxels than this.",
)
@click.option(
    "--neck",
    type=click.FloatRange(min=0),
    default=0.8,
    show_default=True,
    help=(
        "Smallest width of the neck between two touching parts, as a fraction of the width of the narrower part, "
        "with which the two parts count as one particle; 0: touching parts always count as one particle."
    ),
)
@click.option(
    "--side",
    type=click.IntRange(0),
    default=96,
    show_default=True,
    help="Side, in voxels, of the central cube in which the tortuosity is computed; 0: no tortuosity.",
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
    help="New folder for the results. Default: name of VOLUME + _structure, in the current folder.",
)
@json_option
def structure(
    volumes: tuple[Path, ...], compare: bool, states: bool, output: Path | None, as_json: bool, **values: Any
) -> None:
    """Measure the microstructure of a volume, each number with an interval.

    The command measures fractions of materials, particles, surface, contacts, cracks, connected share and tortuosity.

    Each interval is an 80 % interval. It covers four sources of error: few projections (the volume is reconstructed
    again from each half of them), uncertain grey levels of the materials, the size of a voxel, and the number of
    particles. If an interval is wider than half of its number, the number is printed as not determined.

    Several volumes are a series in time. The new folder contains report.html, numbers.csv, structure.json,
    particles.csv and labels.

    With --states, the command measures each particle of a reference in later scans: grey level, volume, shift, cracked
    or gone.

    Example: beamline structure recon.h5
    """
    from beamline.core.machine import free_memory
    from beamline.storage.interrupted import volume_file
    from splatline_structure.measuring import seen_in
    from splatline_structure.volumes import read_volume

    refuse_together(states, compare, len(volumes), values)
    paths = [volume_file(volumes[0]), *volumes[1:]] if states else [volume_file(path) for path in volumes]
    output = output or Path(f"{safe_name(paths[0].name.split('.')[0])}_structure")
    with answering(as_json) as answer:
        refuse_existing(output)
        memory = free_memory() if values["memory"] is None else values["memory"]
        if states:
            from splatline_structure.states import measure_states

            measure_states(paths, output, answer, {**values, "memory": memory})
            return
        reads = [
            read_volume(
                path, values["dataset"], values["voxel_um"], values["slices"], memory, values["crop"],
                len(paths) > 1, answer.warn,
            )
            for path in paths
        ]  # fmt: skip
        measured_volumes = []
        for path, read in zip(paths, reads, strict=True):
            try:
                measured_volumes.append(seen_in(path, read, answer, **values))
            except ValueError as error:
                raise DataError(f"{path} cannot be measured: {error}. Nothing was written.") from error
        _write(measured_volumes, compare, output, values, answer)


def _write(measured_volumes: list[Seen], compare: bool, output: Path, values: dict[str, Any], answer: Answer) -> None:
    """Write the folder, and print the numbers."""
    from beamline.core.events import json_of
    from beamline.report.html import Picture
    from splatline_structure import intervals, pictures, results

    first = measured_volumes[0]
    table = first.found.intervals
    shown = pictures.pictures_of(first.found, first.volume, first.grid, first.read)
    title = f"{measured_volumes[1].path.name} minus {first.path.name}" if compare else f"Structure of {first.path.name}"
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
        for each in measured_volumes
    ]  # fmt: skip
    if compare:
        table = {
            name: intervals.difference(each, measured_volumes[1].found.intervals[name]) for name, each in table.items()
        }
    if len(measured_volumes) > 1:
        curves = {
            name: [each.found.intervals[name] for each in measured_volumes]
            for name, interval in first.found.intervals.items()
            if not interval.why_not
        }
        times = [float(each.read.record.parameters.get("time_s", k)) for k, each in enumerate(measured_volumes)]
        if curves:
            drawn = pictures.curves_of(curves, times, "volume")
            shown.insert(0, Picture("Numbers of all volumes", "Each value with its interval.", drawn))
    particles = first.found.structure.particles
    undecided = (
        f"{first.found.undecided:.1%} of the voxels could be of either material. The box contains "
        f"{count(particles.label.size, 'particle')}, of which {int(particles.cut.sum())} touch a face of the box."
    )
    limits = [f"{first.path}: {first.read.limit_sentence}"] if first.read.limit_sentence else []
    box = " and ".join(each.voxels(each.read.slices) for each in (measured_volumes if compare else [first]))
    texts = {
        "report.html": results.page(title, undecided, limits, shown, table, settings),
        "numbers.csv": results.numbers_table(table, box, first.voxels(first.read.asked)),
        "structure.json": json_of(states[0] if len(measured_volumes) == 1 else {"states": states}),
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
