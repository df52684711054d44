"""`beamline xafs`: the energy of the highest contrast of a material, from a scene or from measured energies."""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from beamline.cli.options import (
    POSITIVE,
    SEED,
    NameChoice,
    json_events,
    parsed,
    refuse_shared,
    volume_path,
)
from beamline.cli.selection_options import underscored
from beamline.cli.terminal import Terminal, answering
from beamline.core.errors import DataError, QualityError, ScanStopped
from beamline.core.events import Done, Sink
from beamline.core.stop import StopRequest, stop_signals
from beamline.core.text import safe_name
from drivers.base.clock import SystemClock

if TYPE_CHECKING:
    from beamline.core.flag import PixelBox
    from beamline.features.xafs.curves import CurveJob
    from beamline.features.xafs.results import XafsResult
    from beamline.features.xafs.series import SeriesResult

_OF_SCENES = ("step", "material", "angle", "seed", "charges")
_OF_FILES = ("regions", "around", "unit", "quantity")
_OF_MAPS = ("spectra", "least")
_LEAST_SUM = 0.5  # of volume fractions in a voxel of a map
_BOX = "ROW:END,COL:END"


def box(value: str) -> PixelBox:
    """`first:end,first:end` of rows and columns. ValueError for anything else."""
    match = re.fullmatch(r"(\d+):(\d+),(\d+):(\d+)", value)
    if match is None or int(match[1]) >= int(match[2]) or int(match[3]) >= int(match[4]):
        raise ValueError(f"{value!r} is not {_BOX}, e.g. 100:200,50:120")
    return int(match[1]), int(match[2]), int(match[3]), int(match[4])


def boxes(values: Sequence[str]) -> tuple[PixelBox, ...]:
    """Each as of `box`."""
    return tuple(map(box, values))


def charges_of(value: str) -> tuple[float, ...]:
    """Numbers from 0 to 1 apart by commas, each once. ValueError for anything else."""
    try:
        numbers = tuple(float(part) for part in value.split(","))
    except ValueError:
        numbers = ()
    if not numbers or len(set(numbers)) < len(numbers) or not all(0 <= charge <= 1 for charge in numbers):
        raise ValueError(f"{value!r} are not states of charge; expected numbers from 0 to 1, e.g. 0,0.5,1")
    return numbers


@click.command()
@click.argument("sources", metavar="SCENE|FILE...", nargs=-1, required=True)
@click.option("--from", "low", type=POSITIVE, metavar="KEV", help="First energy; a scene needs it.")
@click.option("--to", "high", type=POSITIVE, metavar="KEV", help="Last energy; a scene needs it.")
@click.option("--step", type=POSITIVE, metavar="KEV", help="Between a scene's energies; 0.001 unless given.")
@click.option("--material", metavar="NAME", help="Material of the scene. Default: the one with a state of charge.")
@click.option(
    "--angle",
    type=click.FloatRange(min=-360, max=360),
    metavar="DEG",
    help="Angle of the scene's stage. Default: 0.",
)
@click.option("--seed", type=SEED, help="Seed of all random numbers of a scene. Default: 0.")
@click.option(
    "--region",
    "regions",
    multiple=True,
    callback=parsed(boxes),
    metavar=_BOX,
    help="The material in a file's frames; all of them unless given. Several are several states.",
)
@click.option(
    "--states",
    "charges",
    metavar="CHARGE,...",
    callback=parsed(charges_of),
    help="States of charge, 0 to 1, that the scene's material has, one after the other.",
)
@click.option(
    "--around", callback=parsed(box), metavar=_BOX, help="Region around the material, for the contrast. Default: none."
)
@click.option(
    "--unit", type=NameChoice(["keV", "eV"]), help="Unit of a file's energies. Default: as in the file, else keV."
)
@click.option(
    "--quantity",
    type=NameChoice(["counts", "line-integrals"]),
    callback=underscored,
    help="What a file's frames are; counts, with flats, unless given.",
)
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Picture (.png), with the table beside it (.csv). Default: the last source's stem + _xafs.png.",
)
@click.option(
    "--volume",
    metavar="PATH",
    callback=parsed(volume_path),
    help="Write a state-of-charge map: the share of the last FILE in the sum of all, which are volume fractions.",
)
@click.option(
    "--spectra",
    type=click.Path(path_type=Path, dir_okay=False),
    help="With --volume: table as of `materials`; FILEs are volumes in 1/mm, and the map is of its last material.",
)
@click.option(
    "--least",
    type=click.FloatRange(min=0, min_open=True),
    help="With --volume: lowest sum of fractions that is mapped. Default: 0.5.",
)
@click.option("--json", "as_json", is_flag=True, help="One event a line on stdout.")
def xafs(sources: tuple[str, ...], output: Path | None, volume: Path | None, as_json: bool, **values: Any) -> None:
    """Find the energy at which a material of given thickness has the highest contrast to its surroundings, and its
    absorption edge.

    SCENE is a YAML file or the name of a scene that comes with the package: its radiographs are simulated at all
    energies from --from to --to. FILE is a text table of energy and absorption, or an HDF5 file with `energy` and
    either `mu` or `frames` and `flats`. It may be the folder of a series of scans (`scan.energies`).

    Several FILEs, several --region or --states come into one picture with the edge of each. With --volume the FILEs are
    volumes, and their map is written.

    Writes a picture and a table. Ctrl-C ends it with the energies so far (exit code 4). Exit code 6: no edge was found;
    picture and table are written, too.
    """
    from beamline.features.xafs.results import refuse_existing_results

    target = output or Path(f"{safe_name(Path(sources[-1]).stem)}_xafs.png")
    if target.suffix.lower() != ".png":
        raise click.BadParameter(f"{str(target)!r} is not a picture; give a .png file", param_hint="--output")
    if volume is not None:
        _charge_map(sources, volume, values["spectra"], values["least"] or _LEAST_SUM, target, as_json)
        return
    _refuse_given(_OF_MAPS, "a map of volumes: give --volume PATH, too")
    jobs = [job for source in sources for job in _jobs(source, values["regions"], values["charges"])]
    stop = StopRequest()
    with json_events(as_json) as json_sink, stop_signals(stop):
        refuse_existing_results(target)
        results, stopped = _curves(jobs, values, stop, json_sink if as_json else None)
        shown_lines = _write(results, len(jobs), target, stopped, json_sink)
    if not as_json:
        click.echo("\n".join(shown_lines))
    if stopped:
        n = sum(result.curve.energies.size + result.curve.left_out.size for result in results)
        raise ScanStopped(f"Stopped after {n} energies; picture and table contain them.")
    if without := [result for result in results if not result.edge.found]:
        where = "" if len(jobs) == 1 else f" in {without[0].title}"
        why = "; ".join(part for part in (without[0].edge.reason, without[0].tabulated) if part)
        raise QualityError(f"No absorption edge was found{where}: {why}. Picture and table were written.")


def _curves(
    jobs: Sequence[CurveJob], given: Mapping[str, Any], stop: StopRequest, json_sink: Sink | None
) -> tuple[list[XafsResult], bool]:
    """The edges of the curves, and whether a stop left some of them out.

    Raises:
        ScanStopped: before there was one.
    """
    from beamline.features.xafs.curves import run_job

    stopped = False
    results: list[XafsResult] = []
    with Terminal(sys.stderr) as terminal:
        for job in jobs:
            run, title = run_job(job, given, len(jobs) > 1, json_sink or terminal, stop)
            try:
                results.append(_result(title, run))
            except ScanStopped:
                if not results:
                    raise
            stopped = run.stopped
            if stop.stopping:
                break
    return results, stopped or len(results) < len(jobs)


def _write(results: Sequence[XafsResult], jobs: int, target: Path, stopped: bool, json_sink: Sink) -> list[str]:
    """Write picture and table, send the event `done`, and return the lines to print."""
    from beamline.features.xafs.results import table_beside, write_results

    shown_lines, data = write_results(results, target, several=jobs > 1)
    data |= {"picture": target, "table": table_beside(target), "stopped": stopped}
    json_sink(Done(data, time=SystemClock().now()))
    return [*shown_lines, f"written     {target}, {table_beside(target)}"]


def _jobs(source: str, regions: Sequence[PixelBox], charges: Sequence[float] | None) -> list[CurveJob]:
    from beamline.features.xafs.curves import CurveJob

    if CurveJob(source).is_scene:
        _refuse_given(_OF_FILES, "measured files, not for scenes")
        return [CurveJob(source, charge=charge) for charge in charges or (None,)]
    _refuse_given(_OF_SCENES, "scenes, not for measured files")
    return [CurveJob(source, region) for region in regions or (None,)]


def _charge_map(
    sources: Sequence[str], volume: Path, spectra: Path | None, least: float, target: Path, as_json: bool
) -> None:
    """`--volume`: the state-of-charge map, and its picture."""
    from beamline.core.files import refuse_existing, write_together, write_whole
    from beamline.energies import read_spectra
    from beamline.features.xafs.charge_map import charge_map, picture
    from beamline.storage.volumes.files import write_volume

    _refuse_given((*_OF_FILES, *_OF_SCENES, "low", "high"), "curves, and --volume makes a map")
    paths = [Path(source) for source in sources]
    refuse_shared({"--volume": volume, "--output": target, **{f"FILE {n}": path for n, path in enumerate(paths, 1)}})
    with answering(as_json) as answer:
        for path in (volume, target):
            refuse_existing(path)
        table = None if spectra is None else read_spectra(spectra)
        charge = charge_map(paths, table, least, answer.counting("slices"), answer.clock.now())
        drawn = picture(charge)
        files = (volume, partial(write_volume, record=charge.record)), (target, partial(write_whole, content=drawn))
        write_together(files)
        facts = {"volume": volume, "picture": target, **charge.data()}
        answer.done(facts, *charge.lines(), f"written     {volume}, {target}")


def _result(title: str, run: SeriesResult) -> XafsResult:
    """The edge of a curve. Raises ScanStopped or DataError, with nothing written, where it has too few energies."""
    from beamline.features.xafs.contrast import LEAST, find_edge
    from beamline.features.xafs.results import XafsResult, left_out

    n, lost = run.curve.energies.size, run.curve.left_out
    if n < LEAST:
        why = f" Left out: {left_out(run.curve)}." if lost.size else ""
        if run.stopped:
            raise ScanStopped(f"Stopped after {n + lost.size} energies, too few for an edge; nothing was written.{why}")
        raise DataError(
            f"{title}: {n} energies are too few for an edge, which takes {LEAST}; nothing was written.{why}"
        )
    edge = find_edge(run.curve.energies, run.curve.absorption)
    return XafsResult(title, run.curve, edge, run.material, run.elements)


def _refuse_given(names: Sequence[str], what: str) -> None:
    """Raises UsageError where an option is given that does not apply."""
    ctx = click.get_current_context()
    if given := [name for name in names if ctx.params.get(name) not in (None, ())]:
        raise click.UsageError(f"{_FLAGS.get(given[0], f'--{given[0]}')} is for {what}.")


_FLAGS = {"low": "--from", "high": "--to", "regions": "--region", "charges": "--states"}
