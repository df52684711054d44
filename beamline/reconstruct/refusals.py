"""Refusals: checks the options of a reconstruction, and the file of the scan, before any frame is read."""

from __future__ import annotations

import math

from beamline.core.errors import ConfigError, DataError
from beamline.core.files import refuse_not_utf8
from beamline.core.text import size
from beamline.projections.selection import check_axis
from beamline.reconstruct.combinations import contradiction
from beamline.reconstruct.memory import allowed_memory, cluster, local_workers
from beamline.reconstruct.options import ReconOptions
from beamline.reconstruct.truth import read_truth
from beamline.storage.interrupted import next_step
from beamline.storage.readers.base import ScanSource
from beamline.storage.writers.recon_file import SUFFIXES
from recon.base.arrays import F32
from recon.base.views import parse_views
from recon.methods import names_where
from recon.splatting.backend import backend_for
from recon.splatting.fit_method import Fit


def refuse_before_reading(options: ReconOptions) -> F32 | None:
    """Check all that can be checked without reading a frame.

    Returns:
        The ground truth [z, y, x] with which the volume is compared; None without a ground truth.

    Raises:
        ConfigError, DataError: a check failed; nothing was written.
    """
    if options.follow is not None and options.streams:
        _refuse_unfollowed(options.streaming, options.selection.views)
    for path in (options.source.path, options.target.output):
        refuse_not_utf8(path)
    options.target.refuse_existing()
    options.checkpoints.refuse_existing()
    _refuse_device(options.device)
    _refuse_combinations(options)
    if options.cluster is not None:
        workers = cluster(options.cluster)
        if not local_workers(options.cluster):
            with workers:  # raises ConfigError if a scheduler does not have them
                pass
    truth = None if options.truth is None else read_truth(options.truth)
    if options.follow is None:
        with options.source.open() as source:
            allowed = allowed_memory(options.memory, options.cluster)
            _refuse_file(source, allowed, unfinished=options.unfinished)
            if options.selection.axis_col is not None:
                check_axis(source, options.selection.axis_col)
    return truth


def _refuse_unfollowed(method: Fit, views: str) -> None:
    """Raise ConfigError for a fit, or a choice of views, that cannot be used for a growing scan."""
    if not (views == "all" or views.startswith("every:")) or method.steps is not None:
        raise ConfigError(
            "Leave out --steps. Also leave out --views, unless it is every:K. The reason: --follow uses the "
            "projections in the order in which "
            "they are recorded, and fits for --seconds after the end of the scan."
        )
    try:
        parse_views(views, [0.0])
    except ValueError as error:
        raise ConfigError(f"{error}. Nothing was written.") from error


def _refuse_device(device: str) -> None:
    """Raise ConfigError if methods cannot compute on the device."""
    try:
        backend_for(device)
    except (ImportError, RuntimeError, ValueError) as error:
        raise ConfigError(f"--device {device}: {error}. Leave out --device to compute on the CPU.") from error


def _refuse_combinations(options: ReconOptions) -> None:
    """Raise ConfigError for options that exclude each other, and for a file or a method that several volumes or error
    bars cannot have.
    """
    if (pair := contradiction(options.given)) is not None:
        raise ConfigError(f"{pair.name} cannot be combined with {pair.other}: {pair.why}. Nothing was computed.")
    method, target = options.method, options.target
    needs_hdf5 = target.written and target.output.suffix.lower() not in SUFFIXES
    if method.volumes > 1 and needs_hdf5:
        raise ConfigError(
            f"-o {target.output}: several volumes can only be written to HDF5. Use a name that ends in .h5."
        )
    if options.uncertainty and not all(each.error_bars for each in method.alternatives):
        possible_methods = ", ".join(names_where(lambda each: each.error_bars))
        raise ConfigError(
            f"--uncertainty does not work with {method.name}, only with {possible_methods}. Leave out --uncertainty, "
            "or choose another method."
        )
    if options.uncertainty and needs_hdf5:
        raise ConfigError(
            "--uncertainty writes two volumes into one file, which needs HDF5: use -o "
            f"{target.output.with_suffix('.h5')}. You can then export each of the two volumes with `beamline export "
            "--dataset`."
        )


def _refuse_file(source: ScanSource, allowed: int, *, unfinished: bool) -> None:
    """Raise DataError in two cases: the scan is not finished, or a chunk of its file does not fit into the memory when
    it is unpacked.

    Args:
        allowed: bytes of memory that may be used. unfinished: True if the scan may be unfinished.
    """
    if not (source.finished or unfinished):
        raise DataError(
            f"{source.path} is not finished. {next_step(source.path)} To use the {len(source.table)} frames recorded "
            "so far, add --unfinished. Nothing was written."
        )
    if source.unpack_bytes > allowed:
        needed_mb = math.ceil(source.unpack_bytes / 1e6)
        raise DataError(
            f"{source.path} is stored in chunks, and unpacking one chunk needs {size(source.unpack_bytes)} of "
            f"memory, but {size(allowed)} is allowed. Use --memory {needed_mb}M if the "
            "computer has this much memory, or copy the file with one frame in each chunk. Nothing was read."
        )
