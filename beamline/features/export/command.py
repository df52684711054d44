"""`beamline export`: copies a volume to another format, slice by slice."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from beamline.cli.options import (
    NameChoice,
    WholeRange,
    dataset_option,
    json_option,
    parsed,
    refuse_contradictions,
    refuse_shared,
    set_by,
    volume_path,
    with_request,
)
from beamline.cli.recipe import Repeatable, names_given
from beamline.cli.terminal import answering
from beamline.core.errors import ConfigError, DataError
from beamline.core.files import atomic_file, refuse_existing
from beamline.core.quantities import VoxelKind
from beamline.core.text import count, size
from beamline.storage.volumes import suffixes_text
from recon.base.views import spread

if TYPE_CHECKING:
    from beamline.gaussians import Model
    from beamline.storage.recon_record import ReconRecord

_PLY, _CSV = ".ply", ".csv"
_SLICES, _VALUES = 9, 2**20  # largest number of slices, and of values per slice, that are read to suggest a window


def window_of(text: str) -> tuple[float, float]:
    """Parse LOW:HIGH, two finite numbers. Raises ValueError for any other text."""
    try:
        low, high = map(float, text.split(":"))
    except ValueError:
        low = high = math.nan
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise ValueError(f"{text!r} is not a window; expected LOW:HIGH with LOW below HIGH, such as 0:0.5")
    return low, high


@dataclass(frozen=True, eq=False)
class ExportRequest:
    """The arguments of `beamline export`."""

    volume: Path = set_by(click.argument("volume", metavar="VOLUME|RUN", type=click.Path(path_type=Path)))
    output: Path = set_by(
        "-o",
        "--output",
        metavar="PATH",
        callback=parsed(lambda text: Path(text) if Path(text).suffix.lower() in (_PLY, _CSV) else volume_path(text)),
        required=True,
        help=f"File to write; its suffix sets the format: {suffixes_text()}. With --gaussians: .ply. With --poses: "
        ".csv.",
    )
    bits: str = set_by(
        "--bits",
        type=NameChoice(["8", "16", "32"]),
        default="32",
        help="Bits per voxel. 32: the values themselves (float32). 8, 16: grey values, which need --window.",
    )
    window: tuple[float, float] | None = set_by(
        "--window",
        metavar="LOW:HIGH",
        callback=parsed(window_of),
        help="With --bits 8 or 16: LOW becomes grey value 0, and HIGH the largest grey value. Values outside are "
        "clipped.",
    )
    gaussians: bool = set_by(
        "--gaussians", is_flag=True, help="Write the Gaussians of an r2 volume as a .ply file, instead of voxels."
    )
    poses: bool = set_by(
        "--poses",
        is_flag=True,
        help="Write shift, roll and tilt of each projection of this volume as a .csv, instead of voxels. `beamline "
        "recon --poses` reads this file.",
    )
    material: int | None = set_by(
        "--material",
        type=WholeRange(min=1),
        metavar="K",
        help=(
            "For a volume with discrete levels: instead of the density of each voxel, write the probability that "
            "the voxel is material K. 1: the least dense material."
        ),
    )
    at: int | None = set_by(
        "--at", type=WholeRange(min=0), metavar="K", help="Write volume K of a time series, counted from 0."
    )
    dataset: str | None = set_by(dataset_option)
    as_json: bool = set_by(json_option)


@click.command(cls=Repeatable)
@with_request(ExportRequest)
def export(request: ExportRequest) -> None:
    """Copy VOLUME to another format.

    \b
    beamline export VOLUME.h5 -o VOLUME.tif
    beamline export VOLUME.h5 -o GREY.tif --bits 16 --window 0:0.5

    The values stay as they are (float32), unless you give --bits and --window. Slices are copied one at a time, so
    volumes may be larger than the memory. No file is overwritten, and a failure leaves no file.
    """
    from beamline.storage.interrupted import volume_file

    context = click.get_current_context()
    refuse_contradictions(context.command, names_given(context))
    request = replace(request, volume=volume_file(request.volume))
    refuse_shared({"VOLUME": request.volume, "--output": request.output})
    if (part := _part_asked_for(request)) is not None:
        part(request.volume, request.output, request.as_json)
    else:
        _export_voxels(request)


def _part_asked_for(request: ExportRequest) -> Callable[[Path, Path, bool], None] | None:
    """The function that exports Gaussians (--gaussians) or poses (--poses); None if voxels are exported."""
    parts = {
        "--gaussians": (request.gaussians, _PLY, _export_gaussians),
        "--poses": (request.poses, _CSV, _export_poses),
    }
    for name, (wanted, suffix, _) in parts.items():
        if (request.output.suffix.lower() == suffix) != wanted:
            raise click.UsageError(
                f"-o {request.output}: {name} writes {suffix} files, and only {name} writes this format. Change "
                f"the suffix or add {name}."
            )
    for name, (wanted, _, export_part) in parts.items():
        if wanted:
            if request.bits != "32" or any(
                x is not None for x in (request.window, request.dataset, request.at, request.material)
            ):
                raise click.UsageError(
                    f"{name} cannot be combined with --bits, --window, --material, --at or --dataset."
                )
            return export_part
    return None


def _export_voxels(request: ExportRequest) -> None:
    from beamline.storage.volumes.base import Pixels
    from beamline.storage.volumes.files import format_of, opened_volume, write_volume

    if request.dataset is not None and request.at is not None:
        raise click.UsageError(
            "--at cannot be combined with --dataset: --at chooses a volume of a time series, which has one dataset."
        )
    pixels = Pixels(int(request.bits), request.window)
    if pixels.bits == 32 and request.window is not None:
        raise click.UsageError("--window needs --bits 8 or --bits 16.")
    if pixels.bits < 32 and not format_of(request.output).greys:
        raise click.UsageError(
            f"{format_of(request.output).name} files have no grey values: leave out --bits and --window."
        )
    with answering(request.as_json) as answer:
        refuse_existing(request.output)
        with opened_volume(request.volume, request.dataset, request.at) as record:
            if record.volume.data.dtype.kind != "f" and "window" in record.parameters:
                raise DataError(f"Export the original volume: {request.volume} is a copy of it with grey values.")
            if request.material is not None:
                record = _of_material(record, request.material)
            if pixels.bits < 32 and request.window is None:
                raise ConfigError(f"--bits {request.bits} needs --window LOW:HIGH. {_suggestion(record)}")
            clipped = write_volume(request.output, record, pixels)
            shape = record.volume.grid.shape
        share, window = clipped / math.prod(shape), request.window
        facts = {"output": request.output, "shape": shape, "bits": pixels.bits, "window": window, "clipped": share}
        outside = f"{share:.3%} of the voxels are outside the window and were clipped"
        answer.done(
            {**facts, "seconds": answer.seconds},
            f"output   {request.output} ({format_of(request.output).name}, {pixels.dtype.name})",
            f"volume   {' x '.join(map(str, shape))}, {size(math.prod(shape) * pixels.dtype.itemsize)}",
            *([] if window is None else [f"window   {window[0]:g} to {window[1]:g}; {outside}"]),
        )


def _of_material(record: ReconRecord, number: int) -> ReconRecord:
    """The probability, for each voxel, that it is a certain material. With n materials, this needs memory for n + 2
    volumes.

    Raises:
        DataError: the volume has no such material.
    """
    from recon.base.registry import loaded
    from recon.base.volume import Volume
    from recon.voxels.ordered_fista import PULLS

    pulled: Any = next((getattr(loaded(entry.module), entry.cls) for entry in PULLS.values()), None)
    known = pulled is not None and record.kind is not VoxelKind.SHARE
    shares = pulled.probabilities(record.volume, record.settings) if known else None
    if shares is None:
        raise DataError(
            "--material: this volume has no discrete levels. `discrete` and r2 (--finish) use discrete levels only if "
            "these predict held-out projections better; the volume then has the parameter levels_of_materials. Nothing "
            "was written."
        )
    if number > len(shares):
        raise DataError(
            f"--material {number}: the materials of this volume are 1 to {len(shares)}. Nothing was written."
        )
    return replace(record, volume=Volume(shares[number - 1], record.grid), kind=VoxelKind.SHARE)


def _export_gaussians(volume: Path, output: Path, as_json: bool) -> None:
    from beamline.gaussians import read_model

    with answering(as_json) as answer:
        refuse_existing(output)
        model = read_model(volume)
        _write_ply(output, model)
        facts = {"output": output, "gaussians": model.gaussians.n}
        answer.done(facts, f"output     {output} (PLY)", f"gaussians  {model.gaussians.n}, {model.gaussians.kernel}")


def _write_ply(path: Path, model: Model) -> None:
    """The Gaussians as a binary PLY: x y z, scale_0..2 (standard deviations), rot_0..3 (w x y z), density.

    Raises: DataError: `path` exists, or the disk is full or fails. No incomplete file remains.
    """
    import numpy as np

    arrays, unit = model.gaussians.physical(), model.record.length_unit
    names = ("x", "y", "z", *(f"scale_{k}" for k in range(3)), *(f"rot_{k}" for k in range(4)), "density")
    columns = (arrays["centres"], arrays["widths"], arrays["rotations"], arrays["densities"][:, None])
    rows = np.concatenate(columns, axis=1).astype("<f4")
    head = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment lengths in {unit}, densities in {model.record.unit}, kernel {model.gaussians.kernel}",
        f"element vertex {len(rows)}",
        *(f"property float {name}" for name in names),
        "end_header",
    ]
    with atomic_file(path) as partial, partial.open("wb") as file:
        file.write(("\n".join(head) + "\n").encode())
        file.write(rows.tobytes())


def _export_poses(volume: Path, output: Path, as_json: bool) -> None:
    from beamline.storage.pose_table import write_poses

    with answering(as_json) as answer:
        refuse_existing(output)
        views, axis_col = write_poses(output, volume)
        lines = (
            f"output  {output} (CSV)",
            f"views   {views}",
            f"axis    column {axis_col:.2f}: reconstruct with --poses {output} --axis {axis_col:.2f}",
        )
        answer.done({"output": output, "views": views, "axis_col": axis_col}, *lines)


def _suggestion(record: ReconRecord) -> str:
    """A suggested window for the volume, from some of its slices."""
    import numpy as np

    from recon.base.arrays import some_values

    depth = record.volume.grid.shape[0]
    chosen = spread(np.arange(depth), _SLICES)
    slices = [np.asarray(record.volume.data[z : z + 1], np.float32) for z in chosen.tolist()]
    values = np.concatenate([some_values(values, _VALUES) for values in slices])
    values = values[np.isfinite(values)]
    if not values.size:
        return "The slices that were read have no finite value. Nothing was written."
    low, high = (float(f"{value:.4g}") for value in np.percentile(values, (0.1, 99.9)))
    if low == high:  # only a few voxels contain material, or values differ only in the last digits
        low, high = float(values.min()), float(values.max())
    if low == high:
        return (
            f"Every voxel in the slices that were read is {low:g}, so no window can be suggested. Nothing was written."
        )
    return f"Suggested: --window {low:.8g}:{high:.8g} (from {count(chosen.size, 'slice')}). Nothing was written."
