"""Checkpoint files: a fit's state and what it was made from, in HDF5; each whole, in place of the one before."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.files import whole_file
from beamline.core.shipped import version
from beamline.storage import hdf5
from beamline.storage.recon_record import Value
from beamline.storage.structure import require_harmless
from beamline.storage.writer_lock import opened_whole
from beamline.storage.writers.recon_file import value_of

_FORMAT = "splatline checkpoint 1"


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """The state of an interrupted fit.

    Attributes:
        state: arrays by name, see recon.splatting.checkpoint.
        made_from: data and settings of the fit, by name; they must be the same when it resumes.
        steps: that were planned; 0 where a time was.
    """

    state: Mapping[str, NDArray[Any]]
    made_from: Mapping[str, Value]
    steps: int


def write_checkpoint(path: Path, checkpoint: Checkpoint) -> None:
    """Put `checkpoint` at `path`, in place of an older one in one step.

    Raises:
        DataError: the disk refuses; an older checkpoint stays as it was.
    """
    with whole_file(path, replace=True) as partial, hdf5.created(partial) as file:
        file.attrs["format"], file.attrs["version"] = _FORMAT, version()
        file.attrs["steps"], file.attrs["digest"] = checkpoint.steps, _digest(checkpoint)
        for group, values in (("state", checkpoint.state), ("made_from", checkpoint.made_from)):
            node = file.create_group(group)
            for name, value in values.items():
                node[name] = value


def read_checkpoint(path: Path) -> Checkpoint:
    """The checkpoint that `write_checkpoint` wrote.

    Raises:
        DataError: there is none, the file is something else, or damaged: its content differs from its digest.
    """
    if not path.is_file():
        raise DataError(f"{path} is not there; name a checkpoint of recon --checkpoint.")
    try:
        with opened_whole(path) as file:
            require_harmless(file)
            format_of_file = file.attrs.get("format")
            if format_of_file != _FORMAT:
                raise KeyError(f"its format is {format_of_file!r}, expected {_FORMAT!r}")
            kept = Checkpoint(
                {name: np.asarray(node[()]) for name, node in file["state"].items()},
                {name: value_of(node) for name, node in file["made_from"].items()},
                int(file.attrs["steps"]),
            )
            digest = file.attrs["digest"]
    except (OSError, RuntimeError, LookupError, ValueError, TypeError, AttributeError, MemoryError) as error:  # h5py's
        raise DataError(f"{path} is not a readable checkpoint ({error}); recon --checkpoint makes one.") from error
    if digest != _digest(kept):
        raise DataError(
            f"The checkpoint {path} is damaged: its content is not what was written (its digest differs). Resume from "
            "another, or start anew."
        )
    return kept


def _digest(checkpoint: Checkpoint) -> str:
    """SHA-256 of names, types, shapes and values."""
    digest = hashlib.sha256(str(checkpoint.steps).encode())
    for group in (checkpoint.state, checkpoint.made_from):
        for name in sorted(group):
            value = np.asarray(group[name])
            digest.update(f"|{name} {value.dtype.str} {value.shape} ".encode())
            digest.update(np.ascontiguousarray(value).tobytes())
    return digest.hexdigest()
