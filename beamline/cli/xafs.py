"""`beamline xafs`: the energy of the highest contrast of a material, from a scene or from measured energies."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import click

from beamline.cli.json_output import json_events
from beamline.cli.options import POSITIVE, SEED, FiniteRange, parsed
from beamline.cli.scan_options import underscored
from beamline.cli.terminal import Terminal
from beamline.core.errors import DataError, QualityError, ScanStopped
from beamline.core.events import Done
from beamline.core.signals import stop_signals
from beamline.core.stop import StopRequest
from drivers.base.clock import SystemClock

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from beamline.monitor.view import PixelBox
    from beamline.xafs.contrast import XafsCurve
    from beamline.xafs.results import XafsResult
    from beamline.xafs.series import Series, SeriesResult

MOST = 5000
_SCENES = (".yaml", ".yml", "")
_OF_SCENES = ("step", "material", "angle", "seed")
_OF_FILES = ("region", "around", "unit", "quantity")
_BOX = "ROW:END,COL:END"


def box(value: str) -> PixelBox:
    """`first:end,first:end` of rows and columns. ValueError for anything else."""
    match = re.fullmatch(r"(\d+):(\d+),(\d+):(\d+)", value)
    if match is None or int(match[1]) >= int(match[2]) or int(match[3]) >= int(match[4]):
        raise ValueError(f"{value!r} is not {_BOX}, e.g. 100:200,50:120")
    return int(match[1]), int(match[2]), int(match[3]), int(match[4])


@click.command()
@click.argument("source", metavar="SCENE|FILE")
@click.option("--from", "low", type=POSITIVE, metavar="KEV", help="First energy; a scene needs it.")
@click.option("--to", "high", type=POSITIVE, metavar="KEV", help="Last energy; a scene needs it.")
@click.option("--step", type=POSITIVE, metavar="KEV", help="Between a scene's energies; 0.001 unless given.")
@click.option("--material", metavar="NAME", help="Material of the scene. Default: the one with a state of charge.")
@click.option(
    "--angle",
    type=FiniteRange(min=-360, max=360),
    metavar="DEG",
    help="At which the scene's stage stands; 0 unless given.",
)
@click.option("--seed", type=SEED, help="Seed of all random numbers of a scene. Default: 0.")
@click.option(
    "--region", callback=parsed(box), metavar=_BOX, help="The material in a file's frames; all of them unless given."
)
@click.option(
    "--around", callback=parsed(box), metavar=_BOX, help="Its surroundings, for the contrast; none unless given."
)
@click.option(
    "--unit", type=click.Choice(["keV", "eV"]), help="Unit of a file's energies. Default: as in the file, else keV."
)
@click.option(
    "--quantity",
    type=click.Choice(["counts", "line-integrals"]),
    callback=underscored,
    help="What a file's frames are; counts, with flats, unless given.",
)
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Picture (.png), with the table beside it (.csv). Default: the source's stem + _xafs.png, here.",
)
@click.option("--json", "as_json", is_flag=True, help="One event a line on stdout.")
def xafs(
    source: str,
    low: float | None,
    high: float | None,
    step: float | None,
    material: str | None,
    angle: float | None,
    seed: int | None,
    region: PixelBox | None,
    around: PixelBox | None,
    unit: str | None,
    quantity: str | None,
    output: Path | None,
    as_json: bool,
) -> None:
    """Find the energy at which a material of given thickness has the highest contrast to its surroundings, and its
    absorption edge.

    SCENE is a YAML file or the name of a scene that comes with the package: its radiographs are simulated at all
    energies from --from to --to. FILE is a text table of energy and absorption, or an HDF5 file with `energy` and
    either `mu` or `frames` and `flats`.

    Writes a picture and a table. Ctrl-C ends it with the energies so far (exit code 4). Exit code 6: no edge was found;
    picture and table are written, too.
    """
    from beamline.xafs.contrast import XafsCurve
    from beamline.xafs.edge import LEAST
    from beamline.xafs.measured import FileOptions, open_series
    from beamline.xafs.results import lines, refuse_existing_results, table_beside, write
    from beamline.xafs.series import SeriesResult, run_series

    target = output or Path(f"{Path(source).stem}_xafs.png")
    if target.suffix.lower() != ".png":
        raise click.BadParameter(f"{str(target)!r} is not a picture; give a .png file", param_hint="--output")
    is_scene = Path(source).suffix.lower() in _SCENES
    _refuse_foreign(click.get_current_context(), _OF_FILES if is_scene else _OF_SCENES)
    clock, stop = SystemClock(), StopRequest()
    with json_events(as_json) as json_sink, ExitStack() as opened:
        refuse_existing_results(target)
        opened.enter_context(stop_signals(stop))
        series: Series | XafsCurve
        if is_scene:
            from beamline.simulate.energy_scan import (
                open_energy_scan,  # lazily: it imports xraylib, which measured files do not need
            )

            series = open_energy_scan(
                source, _grid(low, high, step or 0.001), material, math.radians(angle or 0.0), seed or 0
            ).series()
        else:
            options = FileOptions(low or 0.0, high or math.inf, region, around, unit, quantity)
            series = opened.enter_context(open_series(Path(source), options))
            n = series.energies.size if isinstance(series, XafsCurve) else series.n
            if n < LEAST:
                within = " between --from and --to" if low or high else ""
                raise DataError(f"{source}: {n} energies{within} are too few for an edge, which takes {LEAST}.")
        with Terminal(sys.stderr) as terminal:
            sink = json_sink if as_json else terminal
            if isinstance(series, XafsCurve):
                run, title = SeriesResult(series), Path(source).name
            else:
                run, title = run_series(series, sink, clock, lambda: stop.stopping), series.title
        result = _result(title, run)
        write(result, target)
        data = result.data() | {"picture": target, "table": table_beside(target), "stopped": run.stopped}
        json_sink(Done(data, time=clock.now()))
    if not as_json:
        click.echo("\n".join([*lines(result), f"written     {target}, {table_beside(target)}"]))
    if run.stopped:
        n = run.curve.energies.size + run.curve.left_out.size
        raise ScanStopped(f"Stopped after {n} energies; picture and table contain them.")
    if not result.edge.found:
        raise QualityError(f"No absorption edge was found: {result.edge.reason}. Picture and table were written.")


def _result(title: str, run: SeriesResult) -> XafsResult:
    """The edge of a curve. Raises ScanStopped or DataError, with nothing written, where it has too few energies."""
    from beamline.xafs.edge import LEAST, find_edge
    from beamline.xafs.results import XafsResult, left_out

    n, lost = run.curve.energies.size, run.curve.left_out
    if n < LEAST:
        why = f" Left out: {left_out(run.curve)}." if lost.size else ""
        if run.stopped:
            raise ScanStopped(f"Stopped after {n + lost.size} energies, too few for an edge; nothing was written.{why}")
        raise DataError(
            f"{title}: {n} energies are too few for an edge, which takes {LEAST}; nothing was written.{why}"
        )
    return XafsResult(title, run.curve, find_edge(run.curve.energies, run.curve.absorption))


def _grid(low: float | None, high: float | None, step: float) -> NDArray[np.float64]:
    """Energies from low to high, keV. Raises UsageError: a limit is missing, or energies are too few or many."""
    import numpy as np

    from beamline.xafs.edge import LEAST

    if low is None or high is None:
        raise click.UsageError("A scene needs a range of energies: --from 8.30 --to 8.42, in keV.")
    n = math.floor((high - low) / step * (1 + 1e-9) + 1e-9) + 1
    if not LEAST <= n <= MOST:
        raise click.UsageError(
            f"From {low:g} to {high:g} keV in steps of {step:g} are {max(n, 0)} energies; it must be {LEAST} to {MOST}."
        )
    return low + step * np.arange(n, dtype=np.float64)


def _refuse_foreign(ctx: click.Context, foreign: Sequence[str]) -> None:
    """Raises UsageError where an option is given that does not apply to the source."""
    given = [name for name in foreign if ctx.params.get(name) is not None]
    if given:
        kind = "measured files, not for scenes" if foreign is _OF_FILES else "scenes, not for measured files"
        raise click.UsageError(f"--{given[0]} is for {kind}.")
