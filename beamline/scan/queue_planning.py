"""Planning of a queue: reads the configurations and tables of several scans, and finds the faults of each scan."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

from beamline.config.load import Config, ReadConfig, override_of, read_config
from beamline.config.tree import Override
from beamline.core.errors import ConfigError, DataError, user_message
from beamline.core.files import SETTINGS, TABLE, text_in
from beamline.core.text import count
from beamline.scan.dry_run import doubts, dry_run
from beamline.scan.queue_plan import PlannedScan, QueuePlan, ScanFault, queue_of
from beamline.storage.writer_lock import no_locks

_CONFIG = "config"  # the column with the configuration's file
_NOTHING = " Nothing was started."
_KEY = re.compile(rf"\b(?:{'|'.join(Config.model_fields)})(?:\.[a-z]\w*)+")

_Described = tuple[str, Path, Sequence[Override]]
"""A scan: its source, the file of its configuration, and overrides."""


def plan_queue(
    scans: Iterable[Path | Mapping[str, object] | PlannedScan],
    overrides: Sequence[Override] = (),
    *,
    place: Path | None = None,
    rehearse: bool = False,
    no_live: Callable[[str], None] | None = None,
) -> QueuePlan:
    """Plan several scans without devices. If a scan cannot run, the others are still planned.

    Args:
        scans: files of configurations, tables of scans, rows of such tables as mappings, and scans that are already
            planned. A table is a CSV file. Its first line has the name `config`, for the column with files of
            configurations (relative to the table), and names of keys. The values of these keys replace those of the
            file; an empty cell changes nothing. overrides: overrides for all scans, which are applied after those of a
            table. place: folder in which the folders of the runs would be created; None: the configured folder of each
            scan. rehearse, no_live: as in `load`.
    """
    locks = cache(no_locks)  # only once per folder, because it takes time on a network disk

    def planned(source: str, file: Path, own_overrides: Sequence[Override]) -> PlannedScan:
        try:
            read = read_config(file, (*own_overrides, *overrides), rehearse=rehearse, no_live=no_live)
        except (ConfigError, DataError, OSError) as error:
            return PlannedScan(source, faults=_faults_of(error, str(file)))
        return plan_of_config(read.config, place, source, read, locks)

    described = (scan for description in scans for scan in _described(description))
    return queue_of(scan if isinstance(scan, PlannedScan) else planned(*scan) for scan in described)


def _described(scan: Path | Mapping[str, object] | PlannedScan) -> Iterator[_Described | PlannedScan]:
    """The scans of a file, a table or a row. If the description of a scan is wrong, the scan is returned with this
    fault."""
    if isinstance(scan, PlannedScan):
        yield scan
        return
    if isinstance(scan, Path):
        yield from _rows(scan) if scan.suffix.lower() == TABLE else [(str(scan), scan, ())]
        return
    source = str(scan.get(_CONFIG, "a mapping"))
    try:
        if not isinstance(file := scan.get(_CONFIG), str | Path):
            raise ConfigError(
                f"the mapping {dict(scan)} names no configuration; expected its file under {_CONFIG!r}.{_NOTHING}"
            )
        yield source, Path(file), [override_of(key, value) for key, value in scan.items() if key != _CONFIG]
    except ConfigError as error:
        yield PlannedScan(source, faults=_faults_of(error))


def _rows(table: Path) -> Iterator[_Described | PlannedScan]:
    """The scan of each line of a table."""
    try:
        reader = csv.reader(io.StringIO(text_in(table, SETTINGS), newline=""), strict=True)
        numbered = [(reader.line_num, [cell.strip() for cell in row]) for row in reader]
    except (OSError, csv.Error) as error:
        yield PlannedScan(str(table), faults=(ScanFault(f"{table} cannot be read as a table ({error})", str(table)),))
        return
    head = numbered[0][1] if numbered else []
    if _CONFIG not in head or "" in head or len(set(head)) < len(head) or not any(any(row) for _, row in numbered[1:]):
        fault = (
            f"{table} is not a table of scans. Expected a first line with names, such as "
            "config,sample.name,scan.exposure_s, each only once, then one line per scan"
        )
        yield PlannedScan(str(table), faults=(ScanFault(fault, str(table)),))
        return
    for number, row in numbered[1:]:
        if not any(row):
            continue
        cells, place = dict(zip(head, row, strict=False)), f"{table}:{number}"
        if len(row) > len(head) or not cells.get(_CONFIG):
            fault = (
                f"{','.join(row)!r} has {count(len(row), 'cell')}; expected {len(head)}, as in the first line, and a "
                f"file in the column {_CONFIG}"
            )
            yield PlannedScan(place, faults=(ScanFault(fault, str(table), number),))
            continue
        overrides = [(f"{key}={value}", place) for key, value in cells.items() if key != _CONFIG and value]
        yield place, table.parent / cells[_CONFIG], overrides


def plan_of_config(
    config: Config,
    place: Path | None,
    source: str,
    read: ReadConfig | None = None,
    locks: Callable[[Path], str] = no_locks,
) -> PlannedScan:
    """The planned scan of a configuration.

    Args:
        place, source: as in `plan_queue` and `PlannedScan`. read: the configuration with the places of its values and
            its faults; None: no faults are known. locks: as in `dry_run`.
    """
    faults = [] if read is None else [_placed_at(place_of_value, sentence) for place_of_value, sentence in read.faults]
    planned = PlannedScan(source, config.sample.name, config=config)
    try:
        doubtful = doubts(config)
        planned_run = dry_run(config, place, locks=locks)
    except (ConfigError, DataError, OSError) as error:  # the faults of the values may have caused this error
        return replace(planned, faults=tuple(faults or [_placed_by_key(read, fault) for fault in _faults_of(error)]))
    warnings = [warning for warning in doubtful if all(warning not in fault.message for fault in faults)]
    faults += [_placed_by_key(read, ScanFault(sentence)) for sentence in planned_run.timeline.violations]
    planned = replace(planned, faults=tuple(faults), warnings=tuple(warnings))
    return replace(planned, needs=planned_run.needs, disk=planned_run.disk, worked=planned_run)


def _faults_of(error: Exception, file: str | None = None) -> tuple[ScanFault, ...]:
    if isinstance(error, ConfigError) and error.faults:
        return tuple(_placed_at(place, sentence) for place, sentence in error.faults)
    return (ScanFault(user_message(error).removesuffix(_NOTHING).removesuffix("."), file),)


def _placed_at(place: str, sentence: str) -> ScanFault:
    """The fault of a value, made from its place: file:line, an option, or a variable."""
    file, _, line = place.rpartition(":")
    is_file = line.isdecimal() and not place.startswith("--")
    return ScanFault(sentence, file, int(line)) if is_file else ScanFault(f"{place}: {sentence}")


def _placed_by_key(read: ReadConfig | None, fault: ScanFault) -> ScanFault:
    """The fault with the place of the first key that its sentence names."""
    key = _KEY.search(fault.message)
    return fault if read is None or key is None else _placed_at(read.tree.origin((*key[0].split("."),)), fault.message)
