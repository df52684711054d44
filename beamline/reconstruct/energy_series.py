"""Scans of one sample at several energies, and a table of spectra: one volume for each material."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from beamline.core.errors import ConfigError
from beamline.core.events import Sink
from beamline.core.files import refuse_existing, remove
from beamline.core.sinks import Warnings
from beamline.core.stop import StopOnSignal
from beamline.core.voxel_kind import VoxelKind
from beamline.projections.prepared import PreparedProjections
from beamline.projections.selection import Selection
from beamline.reconstruct.energy_views import Spectra, energy_views
from beamline.reconstruct.progress import sweeps_told
from beamline.storage.readers.open import SourceOptions
from beamline.storage.recon_record import ReconRecord
from beamline.storage.volumes.files import write_volume
from drivers.base.clock import Clock
from recon.base.volume import Grid, Volume
from recon.energy_fit import EnergyViews
from recon.registration import register_energies
from recon.share_fit import STEPS as SHARE_STEPS
from recon.share_fit import fit_share
from recon.spectral import Materials, fit_materials
from recon.voxels.displacement import Displacement

_SWEEPS = 20
_SUFFIX = ".h5"


@dataclass(frozen=True)
class MaterialOptions:
    """What `reconstruct_materials` does beside the fit.

    Attributes:
        register: find where the sample stood in each scan, and how the image is shifted and magnified; correct it.
        states: names of two materials that are two states of the same one, so that the share of the second is smooth
            within matter; empty: no such pair.
    """

    register: bool = False
    states: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class MaterialRun:
    """What `reconstruct_materials` made.

    Attributes:
        outputs: the volume file of each material, by name.
        residual: what the volumes leave of the views, over the norm of the views.
        early: the fit was stopped, and the volumes are those reached.
        moves: where the sample stood in each scan, mm; empty where it was not looked for.
    """

    outputs: dict[str, Path]
    residual: float
    early: bool
    moves: tuple[Displacement, ...] = ()


def reconstruct_materials(
    scans: Sequence[tuple[SourceOptions, Selection]],
    spectra: Spectra,
    output: Path,
    sink: Sink,
    clock: Clock,
    counting: Callable[[str], Callable[[int, int], None]],
    stop: StopOnSignal,
    options: MaterialOptions = MaterialOptions(),
) -> MaterialRun:
    """Fit the volume fraction of each material to all scans, and write OUTPUT's stem + _NAME.h5 for each of them.

    The rotation axis of the first scan is used for the others, unless it is told. Views of another pixel size, as a
    lens gives it at another energy, are interpolated to that of the first scan. Ctrl-C ends the fit with the volumes so
    far.

    Raises:
        ConfigError: scans that do not fit together, energies that are missing or do not tell the materials apart, or
            too little memory. DataError: a scan cannot be read, or an output exists. Nothing is written then.
    """
    if output.suffix.lower() != _SUFFIX:
        raise ConfigError(f"--output {output}: expected a name that ends in {_SUFFIX}. Nothing was written.")
    outputs = {name: output.with_name(f"{output.stem}_{name}{_SUFFIX}") for name in spectra.names}
    for path in outputs.values():
        refuse_existing(path)
    states = spectra.states(options.states)
    views, first = energy_views(scans, spectra, Warnings(sink, clock), counting("scans"), registered=options.register)
    moves: tuple[Displacement, ...] = ()
    if options.register:
        try:
            views, moves = register_energies(views, counting("registration"))
        except ValueError as error:
            raise ConfigError(f"--register: {error}. Nothing was written.") from error
    grid = Grid.matching(first.geometry)
    early = False

    def go_on(sweep: int, residual: float) -> bool:
        nonlocal early
        heard(sweep)
        early = stopping()
        return not early

    stop.ready, heard = True, sweeps_told(counting, _SWEEPS)
    try:
        with stop() as stopping:
            made = fit_materials(views, grid, sweeps=_SWEEPS, go_on=go_on, stop=stopping)
            early = early or stopping()
            if states is not None and not early:
                made, early = _with_share(views, made, states, counting("share"), stopping)
    except ValueError as error:
        raise ConfigError(f"{error}. Nothing was written.") from error
    facts: dict[str, Any] = {"ended_early": True} if early else {}
    if states is not None and not early:
        facts |= {"states": ",".join(options.states)}
    if moves:
        facts |= {"displacements": np.array([astuple(move) for move in moves])}
    _write(made, first, scans, outputs, facts, clock.now())
    return MaterialRun(outputs, made.residual, early, moves)


def _with_share(
    views: EnergyViews,
    made: Materials,
    states: tuple[int, int],
    told: Callable[[int, int], None],
    stopping: Callable[[], bool],
) -> tuple[Materials, bool]:
    """`fit_share`, and whether it was stopped."""
    early = False

    def go_on(steps_left: int) -> bool:
        nonlocal early
        told(SHARE_STEPS - steps_left, SHARE_STEPS)
        early = stopping()
        return not early

    return fit_share(views, made, states, go_on, stopping), early or stopping()


def _write(
    made: Materials,
    first: PreparedProjections,
    scans: Sequence[tuple[SourceOptions, Selection]],
    outputs: dict[str, Path],
    facts: dict[str, Any],
    time: float,
) -> None:
    """All files, or none of them."""
    written: list[Path] = []
    paths = [str(Path(source.path).resolve()) for source, _ in scans]
    try:
        for (name, path), density in zip(outputs.items(), made.densities, strict=True):
            record = ReconRecord(
                volume=first.stretched(Volume(density, made.grid)),
                length_unit=first.length_unit,
                raw_file=paths[0],
                title=f"volume fraction of {name}",
                sample="not stated",
                time=time,
                kind=VoxelKind.SHARE,
                parameters={
                    "method": "materials",
                    "scans": ", ".join(paths),
                    **facts,
                    "material": name,
                    "axis_col": first.axis_col,
                    "weights": made.weights,
                },
                metrics={"residual": made.residual},
            )
            write_volume(path, record)
            written.append(path)
    except BaseException:
        for path in written:
            remove(path)
        raise
