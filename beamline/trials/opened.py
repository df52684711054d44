"""What a trade-off and a study share: how they open the scan, and how Ctrl-C ends them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import Field, dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Protocol, TypeVar

from beamline.core.files import refuse_existing
from beamline.core.sinks import Warn
from beamline.projections.prepare import prepare_projections
from beamline.projections.prepared import PreparedProjections
from beamline.projections.scan_statistics import Light, LightAsked, light_in
from beamline.projections.selection import Selection
from beamline.reconstruct.measure import fit_truth, read_truth
from beamline.reconstruct.outcome import facts_of
from beamline.storage.readers.open import SourceOptions
from recon.base.arrays import F32
from recon.base.volume import Grid


@dataclass(frozen=True)
class ComparedScan:
    """The scan of a trade-off or a study.

    Attributes:
        folder: for the results; must not exist.
        truth: FILE or FILE:first:end to compare with.
        light: what the user knows of it; None: the dose is counted in frames.
    """

    source: SourceOptions
    selection: Selection
    folder: Path
    truth: str | None = None
    light: LightAsked | None = None


@dataclass(frozen=True, eq=False)
class OpenedScan:
    """A scan ready for many reconstructions.

    Attributes:
        facts: for people, by name.
        truth: on `grid`; None where nobody knows it.
        light: of a view; None: not asked for, and the dose is counted in frames.
    """

    facts: Mapping[str, str]
    prepared: PreparedProjections
    grid: Grid
    truth: F32 | None
    light: Light | None


def opened_scan(asked: ComparedScan, warn: Warn) -> OpenedScan:
    """Read and correct the views. What is refused is refused first.

    Raises:
        ConfigError, DataError: nothing was written.
    """
    refuse_existing(asked.folder)
    wanted = None if asked.truth is None else read_truth(asked.truth)
    with asked.source.open() as source:
        light, facts = light_in(source, asked.light), dict(facts_of(source).table)
        prepared = prepare_projections(source, asked.selection, warn)
    grid = Grid.matching(prepared.geometry)
    truth = None if wanted is None else fit_truth(wanted, grid, asked.selection.binning).data
    facts["volume"] = " × ".join(map(str, grid.shape))
    if light is not None:
        facts["light"] = "; ".join(light.said())
    return OpenedScan(facts, prepared, grid, truth, light)


class GrowingTable(Protocol):
    """A table of rows with a field `stopped`."""

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    @property
    def n_done(self) -> int: ...


T = TypeVar("T", bound=GrowingTable)


def until_stopped(table: T, grown: Iterable[T], folder: Path, write: Callable[[Path, T], None]) -> T:
    """The last table of `grown`, which is written into the folder each time; after Ctrl-C it is `stopped`.

    Raises:
        KeyboardInterrupt: before any row was done; nothing was written.
    """
    try:
        for table in grown:
            if table.n_done:
                write(folder, table)
    except KeyboardInterrupt:
        if not table.n_done:
            raise
        table = replace(table, stopped=True)
    write(folder, table)
    return table
