"""Refusals: why a reconstruction would not begin, known before any frame is read. A dry run refuses the same."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import ConfigError, DataError
from beamline.projections.selection import check_axis
from beamline.reconstruct.error_bars import refuse_impossible
from beamline.reconstruct.measure import read_truth
from beamline.reconstruct.options import ReconOptions
from beamline.reconstruct.output_paths import OutputPaths
from beamline.reconstruct.several_scans import SeveralScans, scans_of
from beamline.reconstruct.workers import cluster
from beamline.storage.interrupted import next_step
from beamline.storage.readers.base import ScanSource
from beamline.storage.writers.recon_file import SUFFIXES
from recon.base.views import parse_views
from recon.splatting.backend import backend_for


def refuse_before_reading(options: ReconOptions) -> NDArray[np.float32] | None:
    """Check all that can be checked without reading a frame.

    Returns:
        The truth [z, y, x] that the volume is to be compared with; None without one.

    Raises:
        ConfigError, DataError: a check failed; nothing was written.
    """
    if options.follow is not None:
        _refuse_unfollowed(options)
    options.target.refuse_existing()
    options.checkpoints.refuse_existing()
    _check_device(options.device)
    options.refuse_contradictions()
    if isinstance(options.source, SeveralScans):
        options.source.refuse(options.method, options.given)
    elif options.method.traits.by_energy:
        wanted = "scans at several energies, and spectra of the materials"
        raise ConfigError(f"{options.method.name} takes {wanted}. Choose another method. Nothing was read.")
    if options.method.traits.several:
        _require_hdf5(options.target)
    if options.uncertainty:
        refuse_impossible(options)
    if options.cluster is not None:
        cluster().refuse_unusable(options.cluster)
    truth = None if options.truth is None else read_truth(options.truth)
    if options.follow is None:
        for each in scans_of(options.source):
            with each.open() as source:
                _require_finished(source, options)
                if options.selection.axis_col is not None:
                    check_axis(source, options.selection.axis_col)
    return truth


def _refuse_unfollowed(options: ReconOptions) -> None:
    """Raises ConfigError for a method or views that a growing scan cannot have."""
    method, views = options.streaming, options.selection.views
    if not (views == "all" or views.startswith("every:")) or method.steps is not None:
        raise ConfigError(
            "--follow takes views as they come, and fits for --seconds after the end: leave out --views, but for "
            "every:K, and --steps."
        )
    try:
        parse_views(views, [0.0])
    except ValueError as error:
        raise ConfigError(f"{error}. Nothing was written.") from error


def _require_finished(source: ScanSource, options: ReconOptions) -> None:
    """Raises DataError for an unfinished scan, unless it is to be taken as it is."""
    if source.finished or options.unfinished:
        return
    raise DataError(
        f"{source.path} is not finished. {next_step(source.path)} --unfinished takes the {source.image_key.size} "
        "frames that are there as they are. Nothing was written."
    )


def _check_device(device: str) -> None:
    """Raises ConfigError if a fit cannot compute on the device."""
    try:
        backend_for(device)
    except (ImportError, RuntimeError, ValueError) as error:
        raise ConfigError(f"--device {device}: {error}. Leave it out to compute on the CPU.") from error


def _require_hdf5(target: OutputPaths) -> None:
    """Raises ConfigError for a file that holds one volume."""
    if target.written and target.output.suffix.lower() not in SUFFIXES:
        raise ConfigError(f"-o {target.output}: several volumes go into HDF5 files; give a name that ends in .h5.")
