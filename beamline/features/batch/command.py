"""`beamline batch`: reconstructs many scans with one recipe, and writes a table with the result of each."""

from __future__ import annotations

import csv
import itertools
import os
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal

import click

from beamline.cli.options import json_option
from beamline.cli.terminal import answering
from beamline.core.durations import in_turn
from beamline.core.errors import DataError, QualityError, ScanStopped
from beamline.core.event_lines import event_of
from beamline.core.events import Done, Failed, Sink, StateEntered, Warned
from beamline.core.files import JOINED, RECON, SCAN, atomic_file, write_table
from beamline.core.process import ProcessEnd, json_object, run_to_end
from beamline.core.text import SENTENCE, count, one_line, printable, safe_name
from beamline.storage.writer_lock import WriterLock
from drivers.base.clock import Clock

RowState = Literal["waiting", "done", "poor", "failed"]

TABLE, RECIPE = "batch.csv", "recipe.yaml"
_WITH_VOLUME: Mapping[int | None, RowState] = {0: "done", QualityError.exit_code: "poor"}
COMMAND = (sys.executable, "-m", "beamline.cli.main")
_SILENCE = 1800.0  # real time in s without an event, after which a reconstruction counts as hanging


@dataclass(frozen=True)
class BatchRow:
    """A scan of a batch and its result.

    Attributes:
        name: name of the folder with its results, inside the folder of the batch.
        state: "done": there is a volume. "poor": the residual of the volume is above --max-residual of the recipe.
            "failed": there is no volume. "waiting": the scan was not tried yet.
        residual: residual of the volume, in the held-out projections if there are any.
        warnings: number of warnings of the reconstruction. Read them before you trust the volume.
        message: why the reconstruction failed or is poor, then the warnings.
    """

    name: str
    scan: str
    state: RowState = "waiting"
    seconds: float | None = None
    method: str = ""
    residual: float | None = None
    warnings: int = 0
    message: str = ""

    @property
    def has_volume(self) -> bool:
        return self.state in ("done", "poor")


def run_batch(scans: Sequence[Path], recipe: Path | None, folder: Path, sink: Sink, clock: Clock) -> list[BatchRow]:
    """Reconstruct the scans that have no volume in the folder yet. The table is written after each scan.

    The folder with the results of a scan appears only when it is complete. If a scan fails, it gets no folder, and the
    next scan is reconstructed. The next call tries the failed scan again. Ctrl-C discards the scan in progress and
    keeps the others.

    Args:
        recipe: file with the options of `beamline recon`; None: its defaults.
        folder: folder for the results, new or of an earlier call with the same recipe.

    Returns:
        All rows of the table, also those of earlier calls.

    Raises:
        DataError: the folder is not that of a batch, or is that of a batch with another recipe. Nothing was changed.
        KeyboardInterrupt: Ctrl-C was pressed. The table lists the scans that are done.
    """
    _begin(folder, b"" if recipe is None else recipe.read_bytes())
    recipe_options = [] if recipe is None else ["--config", str(folder / RECIPE)]
    try:
        lock = WriterLock(folder / RECIPE, exclusive=True)
    except (BlockingIOError, PermissionError) as error:
        recipe_file = folder / RECIPE
        raise DataError(
            f"{recipe_file} cannot be locked ({error.strerror}): another batch is running in this folder, or the "
            "file is write-protected. Wait until the other batch has ended, or name another folder."
        ) from error
    try:
        rows = _rows(scans, _read(folder))
        _write(folder, rows)
        waiting = [n for n, row in enumerate(rows) if not row.has_volume]
        for n in in_turn("batch", waiting, lambda n: rows[n].scan, sink, clock):
            row = rows[n] = _reconstruct_row(rows[n], folder / rows[n].name, recipe_options, sink, clock)
            _write(folder, rows)
            state = row.state + (f" with {count(row.warnings, 'warning')}" if row.warnings else "")
            sentence = f"{row.name}: {state}, {row.seconds:.0f} s{', ' + row.message if row.message else ''}"
            now = clock.now()
            sink(StateEntered("batch", sentence, time=now) if row.has_volume else Warned(sentence, "batch", time=now))
        return rows
    finally:
        lock.release()


def names_of(scans: Sequence[Path], earlier: Sequence[BatchRow] = ()) -> list[str]:
    """A safe and unique name for each file. The name is the stem of the file, preceded by as many of its folders as are
    needed to distinguish it from the other files and from earlier rows. If names are still equal, a number follows."""
    paths = [*(Path(row.scan) for row in earlier), *scans]
    parts = [(*path.absolute().parent.parts[1:], Path(SCAN if path.name == JOINED else path).stem) for path in paths]
    names = [safe_name(own[-1]) for own in parts]
    for depth in range(2, max(map(len, parts), default=0) + 1):
        folded = [name.casefold() for name in names]
        names = [
            safe_name("_".join(own[-depth:])) if folded.count(name.casefold()) > 1 else name
            for own, name in zip(parts, names, strict=True)
        ]
    free, used = list[str](), {TABLE, RECIPE, *(row.name.casefold() for row in earlier)}
    for name in names[len(earlier) :]:
        numbered = (f"{safe_name(name, 100)}_{n}" for n in itertools.count(2))
        free.append(next(each for each in itertools.chain([name], numbered) if each.casefold() not in used))
        used.add(free[-1].casefold())
    return free


def _begin(folder: Path, recipe: bytes) -> None:
    """Create the folder if needed. Raises DataError if the folder does not belong to a batch with this recipe."""
    if not folder.exists():
        with atomic_file(folder) as partial:
            partial.mkdir()
            (partial / RECIPE).write_bytes(recipe)
            _write(partial, [])
    stored_recipe = folder / RECIPE
    if not (folder / TABLE).is_file():
        raise DataError(f"{folder} exists, but is not the folder of a batch: it has no {TABLE}. Name another folder.")
    if not stored_recipe.is_file() or stored_recipe.read_bytes() != recipe:
        raise DataError(
            f"{folder} has results of another recipe, {stored_recipe}. Use that recipe (--config {stored_recipe}), or "
            "name another folder. Nothing was changed."
        )


def _rows(scans: Sequence[Path], earlier: Sequence[BatchRow]) -> list[BatchRow]:
    """The earlier rows, and a row for each new scan. Rows without a volume get the new scan file of a resumed run."""
    from beamline.storage.interrupted import whole_scan  # imported here because help does not need it

    # in the form in which the table shows them
    by_name = {printable(str(path)): path for path in map(whole_scan, scans)}
    rows = [
        row if row.has_volume else replace(row, scan=str(whole_scan(by_name.get(row.scan, Path(row.scan)))))
        for row in earlier
    ]
    old = {printable(row.scan) for row in rows}
    new = [path for shown, path in by_name.items() if shown not in old]
    return [*rows, *(BatchRow(name, str(path)) for name, path in zip(names_of(new, rows), new, strict=True))]


def _reconstruct_row(row: BatchRow, place: Path, how: Sequence[str], sink: Sink, clock: Clock) -> BatchRow:
    """Reconstruct a scan with these options, and write the results to the folder `place`."""
    began, last, warned = clock.now(), dict[str, Any](), list[str]()

    def pass_on(line: str) -> None:
        nonlocal last
        try:
            event = event_of(json_object(line) or {})
        except ValueError:
            return
        if isinstance(event, Done | Failed):
            last = event.data
        else:
            warned.extend([event.message] if isinstance(event, Warned) else [])
            with_command: dict[str, Any] = (
                {"message": _with_command(event.message, row)} if isinstance(event, Warned | StateEntered) else {}
            )
            sink(replace(event, scan=row.scan, **with_command))

    if (place / RECON).is_file():
        return replace(
            row, state="done", seconds=0.0,
            message="an earlier batch made this volume, and ended before it wrote this row; see the report of the "
                    "volume for warnings",
        )  # fmt: skip
    try:
        with atomic_file(place) as work:
            work.mkdir()
            log = work / "stderr.txt"
            call = [*COMMAND, "recon", row.scan, *how, "--output", str(work / RECON), "--beside-scan", "--json"]
            ending, code, stderr = run_to_end(call, log, pass_on, silence=_SILENCE)
            log.unlink()
            reason = str(last.get("message", "")) or stderr.removeprefix("beamline: ")
            if ending is ProcessEnd.SILENT:
                reason = f"the process of this scan was ended, because it printed nothing for {_SILENCE:g} s"
            if code not in _WITH_VOLUME or not (work / RECON).is_file():
                raise DataError(reason or f"no volume: the process of this scan ended with code {code}")
        state, why = _WITH_VOLUME[code], [reason] if code else []
    except DataError as error:  # also happens if another program made a folder of this name
        state, why = "failed", [str(error)]
    return replace(
        row, state=state, seconds=clock.now() - began, method=str(last.get("method", "")),
        residual=last.get("residual_held_out", last.get("residual")), warnings=len(warned),
        message=one_line(_with_command(" ".join([*why, *warned]), row), SENTENCE),
    )  # fmt: skip


def _with_command(message: str, row: BatchRow) -> str:
    """A message of a reconstruction. If it mentions options, the command that takes these options is added."""
    named = re.search(r"(?<![\w-])-(-[a-z]|[a-z]\b)", re.sub(r"`beamline [^`]*`", "", message))
    return message + (
        " If the options in this message apply to all scans, add them to the recipe; otherwise give them to "
        f"`beamline recon {row.scan}`."
        if named
        else ""
    )


def _read(folder: Path) -> list[BatchRow]:
    """The table of an earlier call. A row whose volume no longer exists gets the state "waiting" again.

    Raises:
        DataError: the table cannot be read.
    """
    from pydantic import TypeAdapter, ValidationError  # imported here because help loads this module

    path = folder / TABLE
    try:
        with path.open(encoding="utf-8-sig", errors="surrogateescape", newline="") as file:
            reader = csv.DictReader(file)
            rows = [{name: value for name, value in row.items() if name and value} for row in reader]
            if not {"name", "scan"} <= {*(reader.fieldnames or ())}:
                raise ValueError(f"its first line must have the columns name and scan, but has {reader.fieldnames}")
        table = TypeAdapter(list[BatchRow]).validate_python(rows)
        _refuse_names(table)
        return [
            BatchRow(row.name, row.scan) if row.has_volume and not (folder / row.name / RECON).is_file() else row
            for row in table
        ]
    except ValidationError as error:
        first = error.errors()[0]
        fault = first["msg"]
        place = f"row {int(first['loc'][0]) + 1}, {first['loc'][-1]}"
        raise DataError(f"{path} is not a table of a batch ({place}: {fault}). Nothing was changed.") from error
    except (OSError, ValueError, csv.Error) as error:
        raise DataError(f"{path} is not a table of a batch ({one_line(str(error))}). Nothing was changed.") from error


def _refuse_names(rows: Sequence[BatchRow]) -> None:
    """Raise ValueError for a name that is not safe as a folder, or that another row or file of the batch has."""
    folded = [TABLE, RECIPE, *(row.name.casefold() for row in rows)]
    for n, row in enumerate(rows, start=2):
        if row.name != safe_name(row.name) or folded[n] in folded[:n]:
            raise ValueError(f"{row.name!r} is not a valid folder name for a scan, or two rows have this name")


def _write(folder: Path, rows: Sequence[BatchRow]) -> None:
    write_table(folder / TABLE, [vars(row) for row in rows], [column.name for column in fields(BatchRow)])


def scans_of(ctx: click.Context, param: click.Parameter, value: tuple[str, ...]) -> list[Path]:
    """Scans that match the names and patterns, each once, in the order given."""
    from beamline.storage.interrupted import whole_scan  # imported here because help does not need it

    scans: dict[Path, None] = {}
    for name in value:
        path, root = Path(name), Path(Path(name).anchor)
        matches = [path] if path.exists() else sorted(root.glob(str(path.relative_to(root))))
        if not matches:
            raise click.BadParameter(f"{name!r} is not a file, and no file matches it as a pattern")
        for match in matches:
            scans[scan := whole_scan(match)] = None
            if not match.is_dir() and scan != Path(os.path.realpath(match)):
                click.echo(
                    f"{match} is only a part of a resumed run. {scan}, which has all parts, is used instead.", err=True
                )
    return list(scans)


@click.command()
@click.argument("scans", nargs=-1, required=True, callback=scans_of)
@click.option(
    "--config",
    type=click.Path(path_type=Path, exists=True, dir_okay=False),
    help="Recipe: a YAML file with the options of `beamline recon`, as --write-config writes it. Default: -m auto.",
)
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path, file_okay=False),
    required=True,
    help="Folder for the results. If an earlier batch with the same recipe used this folder, that batch is continued.",
)
@json_option
def batch(scans: list[Path], config: Path | None, output: Path, as_json: bool) -> None:
    """Reconstruct many scans, one after the other, with one recipe.

    \b
    beamline recon SCAN.h5 -m fista-tv --bin 2 --write-config recipe.yaml
    beamline batch "runs/*/scan.h5" --config recipe.yaml -o RESULTS

    SCANS are files, or patterns in quotes. Each scan gets a folder in --output with its volume and report. The table
    batch.csv lists the result of each scan, and the reason if a scan failed. If you call the command again, it
    reconstructs only the scans without a volume. Ctrl-C keeps the scans that are done.

    Exit code: 0 all scans have a volume, 4 stopped, 5 a scan failed.
    """
    if config is not None:
        from beamline.cli.recon import refuse_recipe  # imported here because help does not need it

        refuse_recipe(config)
    with answering(as_json) as answer:
        try:
            rows = run_batch(scans, config, output, answer.sink, answer.clock)
        except KeyboardInterrupt as stop:
            raise ScanStopped(f"The batch was stopped. {output / TABLE} lists the scans that are done.") from stop
        failed = [row for row in rows if not row.has_volume]
        warned = sum(row.has_volume and row.warnings > 0 for row in rows)
        counts = {"done": len(rows) - len(failed), "warned": warned, "failed": len(failed), "output": output / TABLE}
        with_warnings = f", {warned} with warnings" if warned else ""
        finished_lines = (
            [] if failed else [f"{len(rows)} of {len(rows)} scans have a volume{with_warnings}: {output / TABLE}"]
        )
        answer.done(counts, *finished_lines)
    if failed:
        table_file = output / TABLE
        raise DataError(f"{len(failed)} of {len(rows)} scans failed; {table_file} says why.")
