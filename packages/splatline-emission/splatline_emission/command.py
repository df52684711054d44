"""`beamline emission`: simulates the counts of a sample that emits (PET), and reconstructs its activity."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import click

from beamline.cli.options import json_option, parsed, volume_path
from beamline.cli.terminal import answering
from beamline.core.errors import DataError
from beamline.core.files import refuse_existing

_UPDATES = 200  # largest number of updates of the volume, over all subsets, if held-out counts choose the iterations
_NEW = click.Path(path_type=Path)


@click.group()
def emission() -> None:
    """Simulate the counts of a sample that emits (PET), or reconstruct its activity from counts."""


@emission.command()
@click.option(
    "-o",
    "--output",
    metavar="FILE.h5",
    type=_NEW,
    required=True,
    help="File for the counts; `beamline emission recon` reads it.",
)
@click.option("--truth", metavar="FILE", callback=parsed(lambda text: text and volume_path(text)),
              help="Also write the true activity to this file.")  # fmt: skip
@click.option(
    "--views", type=click.IntRange(2, 100_000), default=120, show_default=True, help="Number of projections over 180°."
)
@click.option(
    "--shape", type=click.IntRange(1), nargs=2, default=(16, 64), show_default=True, help="Detector rows and columns."
)
@click.option(
    "--trues",
    type=click.FloatRange(1),
    default=1.5e7,
    show_default=True,
    help="Number of true counts, without scatter and randoms.",
)
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Seed of the random numbers.")
@json_option
def simulate(
    output: Path, truth: Path | None, views: int, shape: tuple[int, int], trues: float, seed: int, as_json: bool
) -> None:
    """Simulate counts of hot and cold rods in water.

    The phantom follows NEMA NU 4-2008; pixels are 1 mm.

    Example: beamline emission simulate -o pet.h5 --truth truth.h5
    """
    import numpy as np

    from beamline.core.quantities import VoxelKind
    from beamline.storage.volumes.base import bare_record
    from beamline.storage.volumes.files import write_volume
    from recon import Geometry, Grid, Volume
    from splatline_emission.counts import Scanner, activity, counts_of, write_counts

    with answering(as_json) as answer:
        for path in filter(None, (output, truth)):
            refuse_existing(path)
        geometry = Geometry.parallel(np.linspace(0, np.pi, views, endpoint=False), shape)
        counts, sets, scale = counts_of(geometry, Scanner(trues), seed)
        write_counts(output, counts, geometry, sets)
        if truth is not None:
            grid = Grid.matching(geometry)
            volume = Volume(np.float32(scale) * activity(grid), grid)
            write_volume(
                truth,
                replace(bare_record(output, volume.data), volume=volume, length_unit="mm", kind=VoxelKind.ACTIVITY),
            )
        facts = {"output": output, "truth": truth, "counts": float(counts.sum())}
        answer.done(facts, f"scan    {output}, {views} projections, {counts.sum():.4g} counts")


@emission.command()
@click.argument("file", type=_NEW)
@click.option("-o", "--output", metavar="PATH", callback=parsed(volume_path), required=True,
              help="File for the activity; its suffix chooses the format.")  # fmt: skip
@click.option("-m", "--method", default="osem", show_default=True,
              help="mlem, osem, or any method of `beamline recon`, such as pnp-dct (smallest error in our "
              "test).")  # fmt: skip
@click.option(
    "--iterations", type=click.IntRange(1), help="Iterations of mlem and osem. Default: chosen with held-out counts."
)
@click.option(
    "--subsets", type=click.IntRange(1), default=4, show_default=True, help="Subsets of the projections, for osem."
)
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Seed of the random numbers.")
@json_option
def recon(
    file: Path, output: Path, method: str, iterations: int | None, subsets: int, seed: int, as_json: bool
) -> None:
    """Reconstruct the activity from counts.

    The activity is in counts per mm of line.

    Example: beamline emission recon pet.h5 -o activity.h5
    """
    import numpy as np

    import recon as reconstruction
    from beamline.core.quantities import VoxelKind
    from beamline.storage.volumes.base import bare_record
    from beamline.storage.volumes.files import write_volume
    from splatline_emission.counts import read_counts, weighted_lines
    from splatline_emission.likelihood import mlem, passes_by_halves

    with answering(as_json) as answer:
        refuse_existing(output)
        counted = read_counts(file)
        grid, count = reconstruction.Grid.matching(counted.geometry), answer.counting("iterations")
        try:
            if method in ("mlem", "osem"):
                parts = min(subsets, counted.geometry.n_views) if method == "osem" else 1
                most, rng = _UPDATES // parts, np.random.default_rng(seed)
                chosen = iterations or passes_by_halves(counted, grid, parts, most, rng)
                volume = mlem(counted, grid, chosen, parts, lambda n, *_: count(n, chosen))
            else:
                lines, weights = weighted_lines(counted)
                use = reconstruction.DataUse(weights)
                result = reconstruction.reconstruct(lines, counted.geometry, method, use=use, seed=seed)
                volume, chosen = result.volume, len(result.history)
        except ValueError as error:
            raise DataError(f"{file} cannot be reconstructed: {error}. Nothing was written.") from error
        write_volume(
            output, replace(bare_record(file, volume.data), volume=volume, length_unit="mm", kind=VoxelKind.ACTIVITY)
        )
        facts = {"output": output, "method": method, "iterations": chosen}
        answer.done(facts, f"output  {output}, {method}, {chosen} iterations")
