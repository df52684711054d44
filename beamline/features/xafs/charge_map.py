"""State-of-charge map: the share of one material among several, in each voxel, with a picture.

It comes from volume fractions, as `beamline materials` writes them, or from volumes of attenuation at several energies.
These are separated in each voxel by least squares (Meirer et al., J. Synchrotron Rad. 18, 773, 2011).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import ConfigError, DataError
from beamline.core.machine import free_memory
from beamline.core.quantities import VoxelKind
from beamline.core.text import size
from beamline.energies import Spectra
from beamline.reconstruct.memory import SHARE
from beamline.report.figures import dpi_for, draw_cuts, finish, new_figure, png
from beamline.storage.readers.open import open_scan
from beamline.storage.recon_record import ReconRecord
from beamline.storage.volumes.files import opened_volume
from recon.base.volume import Grid, Volume

_SLAB = 16  # slices read at a time
_GRIDS_ALIKE = 1e-3  # of a voxel


@dataclass(frozen=True, eq=False)
class ChargeMap:
    """A state-of-charge map.

    Attributes:
        record: float32 [z, y, x], 0 ... 1; NaN where the materials fill less than `least`.
        names: of the volumes or materials; the map is the share of the last.
        energies: keV of the volumes; empty where these are volume fractions.
    """

    record: ReconRecord
    names: tuple[str, ...]
    energies: tuple[float, ...]
    least: float

    def data(self) -> dict[str, Any]:
        """Values for programs."""
        return {"of": self.names[-1], "among": self.names, "energies_kev": self.energies, **self.record.metrics}

    def lines(self) -> list[str]:
        """Sentences for people."""
        metrics = self.record.metrics
        return [
            f"map of      {self.names[-1]} in the sum of {', '.join(self.names)}",
            f"voxels      {metrics['filled_share']:.1%} are filled to {self.least:g} or more",
            f"mean        {metrics['mean']:.4f}, a tenth of them below {metrics['percentile_10']:.3f}, a tenth "
            f"above {metrics['percentile_90']:.3f}",
        ]


def charge_map(
    paths: Sequence[Path],
    spectra: Spectra | None,
    least: float,
    counting: Callable[[int, int], None],
    time: float,
) -> ChargeMap:
    """The share of the last material in the sum of all, in each voxel, read sixteen slices at a time.

    Args:
        paths: volume fractions; or, with `spectra`, volumes in 1/mm, each from a scan that states its energy.
        spectra: attenuation of the pure materials.
        least: summed fraction below which a voxel is NaN.
        time: s since the Unix epoch, for the record.

    Raises:
        ConfigError: the volumes do not fit together, or too few energies. DataError: one cannot be read, or its scan.
    """
    if len(paths) < 2:
        raise ConfigError(f"A map needs two volumes or more; got {len(paths)}. Nothing was written.")
    with ExitStack() as opened:
        records = [opened.enter_context(opened_volume(path)) for path in paths]
        first = records[0]
        _refuse_unlike(paths, records, spectra)
        energies = () if spectra is None else tuple(map(_energy_of, records))
        unmix = None if spectra is None else _unmixing(spectra, energies)
        own_names = (str(each.parameters.get("material", path.stem)) for path, each in zip(paths, records, strict=True))
        names = tuple(own_names) if spectra is None else spectra.names
        grid = first.volume.grid
        _refuse_memory(grid)
        charge = np.empty(grid.shape, np.float32)
        for begin in range(0, grid.shape[0], _SLAB):
            part = np.stack([np.asarray(each.volume.data[begin : begin + _SLAB], np.float32) for each in records])
            if unmix is not None:
                part = np.tensordot(unmix, part, 1).astype(np.float32)
            charge[begin : begin + _SLAB] = share_of_last(part, least)
            counting(min(begin + _SLAB, grid.shape[0]), grid.shape[0])
    filled = charge[np.isfinite(charge)]
    if not filled.size:
        raise DataError(f"No voxel is filled to {least:g} by {', '.join(names)}; give --least. Nothing was written.")
    low, high = np.percentile(filled, [10, 90])
    record = ReconRecord(
        volume=Volume(charge, grid),
        length_unit=first.length_unit,
        raw_file=first.raw_file,
        title=f"share of {names[-1]} (state of charge)",
        sample=first.sample,
        time=time,
        kind=VoxelKind.SHARE,
        parameters={"method": "share", "volumes": ", ".join(str(path.resolve()) for path in paths), "least": least},
        metrics={
            "mean": float(filled.mean()),
            "percentile_10": float(low),
            "percentile_90": float(high),
            "filled_share": filled.size / charge.size,
        },
    )
    return ChargeMap(record, names, energies, least)


def share_of_last(fractions: NDArray[np.float32], least: float) -> NDArray[np.float32]:
    """[z, y, x] from [material, z, y, x]: the last one's share of the sum, NaN where the sum is below `least`."""
    kept = np.maximum(np.nan_to_num(fractions), 0)
    total = kept.sum(0)
    return np.where(total >= least, kept[-1] / np.maximum(total, least), np.float32(np.nan))


def _unmixing(spectra: Spectra, energies: Sequence[float]) -> NDArray[np.float32]:
    """[material, energy]: volume fractions from attenuation, by least squares."""
    pure = np.array([spectra.at(energy) for energy in energies])
    if np.linalg.matrix_rank(pure, tol=1e-3 * np.abs(pure).max()) < pure.shape[1]:
        raise ConfigError(
            f"{len(energies)} energies, {', '.join(f'{energy:.7g}' for energy in energies)} keV, do not tell "
            f"{pure.shape[1]} materials apart. Nothing was written."
        )
    return np.linalg.pinv(pure).astype(np.float32)


def _energy_of(record: ReconRecord) -> float:
    with open_scan(record.raw_file) as scan:
        if scan.energy_kev is None:
            raise ConfigError(
                f"{record.raw_file} does not state its energy; expected /entry/instrument/beam/incident_energy. "
                "Nothing was written."
            )
        return scan.energy_kev


def _refuse_unlike(paths: Sequence[Path], records: Sequence[ReconRecord], spectra: Spectra | None) -> None:
    grid = records[0].volume.grid
    for path, record in zip(paths, records, strict=True):
        own = record.volume.grid
        apart = np.abs(np.subtract(own.centre, grid.centre)).max() / grid.voxel_size
        alike = math.isclose(own.voxel_size, grid.voxel_size, rel_tol=_GRIDS_ALIKE / max(grid.shape))
        if own.shape != grid.shape or not alike or apart > _GRIDS_ALIKE:
            raise ConfigError(
                f"{path} has voxels at other places than {paths[0]}: {_words(own)}, not {_words(grid)}. Reconstruct "
                "both with the same --axis, --rows and --bin. Nothing was written."
            )
        if spectra is None and record.kind is not VoxelKind.SHARE:
            raise ConfigError(
                f"{path} holds attenuation and not volume fractions, as `beamline materials` writes them; volumes of "
                "several energies need --spectra. Nothing was written."
            )
        if spectra is not None and record.unit != "1/mm":
            unit = f"in {record.unit}" if record.unit else "a volume fraction"
            raise ConfigError(f"{path} is {unit}; with --spectra volumes in 1/mm are expected. Nothing was written.")


def _words(grid: Grid) -> str:
    return f"{grid.shape} of {grid.voxel_size:.6g} around {tuple(round(float(at), 6) for at in grid.centre)}"


def _refuse_memory(grid: Grid) -> None:
    needs = 4 * (2 * math.prod(grid.shape) + 4 * _SLAB * math.prod(grid.shape[1:]))
    if needs > (may_use := SHARE * free_memory()):
        raise ConfigError(
            f"A map of {grid.shape} voxels needs {size(needs)} of memory; {size(may_use)} may be used; take volumes of "
            "fewer rows. Nothing was written."
        )


def picture(charge: ChargeMap) -> bytes:
    """PNG: three orthogonal slices where most voxels are filled, from 0 to 1, and how many voxels have which charge."""
    volume, unit = charge.record.volume, charge.record.length_unit
    filled = np.isfinite(volume.data)
    at = [int(filled.sum(axis=tuple({0, 1, 2} - {axis})).argmax()) for axis in range(3)]
    height = max(volume.grid.shape[1] / volume.grid.shape[2], volume.grid.shape[0] / volume.grid.shape[2], 0.3)
    figure = new_figure((11, 2.6 * height + 3.2), dpi_for(volume.grid.shape[2], 3.0))
    upper, lower = np.ravel(np.asarray(figure.subfigures(2, 1, height_ratios=(2.6 * height + 0.8, 2.4))))
    panels = np.ravel(np.asarray(upper.subplots(1, 3)))
    for axes in panels:
        axes.set_facecolor("0.85")
    shown = draw_cuts(list(panels), volume, at, unit, "", (0, 1), "viridis")
    upper.colorbar(shown, ax=list(panels), shrink=0.8).set_label(f"share of {charge.names[-1]}")
    counts = lower.subplots()
    counts.hist(volume.data[filled], bins=100, range=(0, 1), color="0.35")
    counts.set_xlim(0, 1)
    finish(counts, f"share of {charge.names[-1]} (state of charge)", "voxels", grid=True)
    return png(figure)
