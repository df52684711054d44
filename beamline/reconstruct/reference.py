"""The reference of a reconstruction: an earlier volume of the same sample, read from its file or made from its scan."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from beamline.core.errors import DataError, ScanStopped
from beamline.core.events import Sink, StateEntered
from beamline.core.files import same_file
from beamline.core.quantities import VoxelKind
from beamline.core.recon_events import VolumeDone
from beamline.core.text import safe_name
from beamline.projections.selection import Selection
from beamline.projections.views import select, stated_geometry
from beamline.reconstruct.options import OutputPaths, ReconOptions
from beamline.storage.readers.open import SourceOptions
from beamline.storage.recon_record import ReconRecord
from beamline.storage.run_record import is_series_folder
from beamline.storage.volumes.files import NXtomoproc, volume_format
from drivers.base.clock import Clock
from recon.auto import Auto
from recon.base.volume import Volume
from recon.methods import with_settings
from recon.voxels.held_out import LEAST_VIEWS


def with_reference(
    options: ReconOptions,
    path: Path,
    reconstruct: Callable[[ReconOptions, Sink], ReconRecord],
    sink: Sink,
    clock: Clock,
) -> ReconOptions:
    """The options with the reference volume as a setting of the method. A scan is reconstructed first, with `auto`.

    The volume is written to `<name of the scan>_reference.h5` next to the output; if the output belongs to a run of a
    series, it is written to the folder of the series. Later calls use it again. If the state has fewer than 16
    projections, the scan is not reconstructed, because the method cannot test whether a reference helps.

    Raises:
        DataError: the file is neither a volume of attenuation nor a scan, a voxel is not finite, or the output and the
            volume of the reference have the same name.
        ScanStopped: the reconstruction of the reference was stopped; its volume was removed.
    """
    kind, scan = volume_format(path), None
    if kind is None:
        folder = options.target.output.parent
        # one reference for all states of a series
        folder = folder.parent if is_series_folder(folder.parent) else folder
        scan, path = path, folder / f"{safe_name(path.stem)}_reference.h5"
        if path == options.target.output:
            raise DataError(
                f"The reference {scan.name} is a scan. The volume of the reference and the output would have the "
                f"same name, {path}. Name another output. Nothing was computed."
            )
        if _too_few(options):
            return options  # the method reports this, and does not use a reference
        if not path.exists():
            source, target = SourceOptions(scan), OutputPaths(path, None)
            first = ReconOptions(source, target, Selection(), Auto(), seed=options.seed, memory=options.memory)
            _reconstruct_first(first, reconstruct, sink, clock)
        kind = NXtomoproc()
    with kind.open(path) as record:
        if scan is not None and not same_file(Path(record.raw_file), scan):
            raise DataError(
                f"{path} was made from {record.raw_file}, not from {scan.resolve()}. Move {path} away, or give the "
                "volume of the reference instead of its scan. Nothing was changed."
            )
        if record.kind is not VoxelKind.ATTENUATION or record.series is not None:
            raise DataError(f"{path} is not a single volume of attenuation; give a volume that `beamline recon` wrote.")
        data = np.array(record.volume.data[: record.grid.shape[0]], np.float32)
        volume = Volume(data, record.grid)
    try:
        method = with_settings(options.method, {"reference": volume})
    except ValueError as error:
        raise DataError(
            f"{path} cannot be used as the reference: {error}. The later scan was not reconstructed."
        ) from None
    return replace(options, method=method)


def _reconstruct_first(
    first: ReconOptions, reconstruct: Callable[[ReconOptions, Sink], ReconRecord], sink: Sink, clock: Clock
) -> None:
    """Reconstruct the scan of the reference with the options `first`, and write its volume.

    Raises:
        ScanStopped: the reconstruction was stopped; the volume was removed.
    """
    name, volume_path = Path(first.source.path).name, first.target.output
    message = f"The reference {name} is a scan: it is reconstructed first, into {volume_path.name}"
    sink(StateEntered("reference", message, {"reference": volume_path}, time=clock.now()))
    record = reconstruct(first, lambda event: None if isinstance(event, VolumeDone) else sink(event))
    if record.ended_early:  # a reference that ended early is poor, and later calls would use it
        volume_path.unlink()
        raise ScanStopped(
            f"The reconstruction of the reference {name} was stopped, so its volume {volume_path} was removed. The "
            "later scan was not reconstructed."
        )


def _too_few(options: ReconOptions) -> bool:
    """Whether a finished scan has too few projections to test whether a reference helps."""
    if options.follow is not None:
        return False
    with options.source.open() as source:
        return stated_geometry(select(source, options.selection)).n_views < LEAST_VIEWS
