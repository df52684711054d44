"""Checkpoints of a fit: saves its state with its origin, and checks the origin before the fit is resumed."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import ConfigError, DataError
from beamline.core.files import refuse_existing, same_file
from beamline.core.sinks import Warn
from beamline.projections.prepared import PreparedProjections
from beamline.storage.recon_record import Value
from beamline.storage.writers.recon_file import Checkpoint, read_checkpoint, write_checkpoint
from recon.base.geometry import arrays_of
from recon.base.volume import Volume
from recon.splatting.checkpoint import state_from
from recon.splatting.optimise import FitState

_SHOWN = 40  # largest number of characters of a value in a message


def origin_of(prepared: PreparedProjections, settings: Any, others: Mapping[str, Value]) -> dict[str, Value]:
    """The origin of a fit or a slab: checksum of its data, geometry and settings.

    Args:
        prepared: line integrals and geometry; held-out projections have no effect.
        settings: the settings of the fit, or a method; a dataclass.
        others: seed, start and similar values, by name.
    """
    data = np.ascontiguousarray(prepared.seen.data, np.float32)
    out: dict[str, Value] = {
        "projections": hashlib.sha256(data.data).hexdigest(),
        "n_views": prepared.geometry.n_views,
        "length_unit": prepared.origin.length_unit,
    }
    out |= arrays_of(prepared.geometry)
    volumes = {
        each.name: setting for each in fields(settings) if isinstance(setting := getattr(settings, each.name), Volume)
    }
    plain = asdict(replace(settings, **dict.fromkeys(volumes)) if volumes else settings)
    out |= {f"setting {name}": str(value) for name, value in plain.items() if name not in volumes}
    for name, volume in volumes.items():
        voxels = np.ascontiguousarray(volume.data, np.float32)
        out[f"setting {name}"] = f"{volume.grid}, {hashlib.sha256(voxels.data).hexdigest()}"
    return out | {f"setting {name}": value for name, value in others.items()}


def differences(now: Mapping[str, Value], before: Mapping[str, Value]) -> list[str]:
    """The differences between two origins (see `origin_of`), in words."""
    out = []
    for name in dict.fromkeys([*now, *before]):
        current, stored = now.get(name), before.get(name)
        if current is None or stored is None:
            out.append(f"only one of the two states {name}")
        elif not np.array_equal(np.asarray(current), np.asarray(stored)):
            out.append(f"{name.removeprefix('setting ')} {_difference(current, stored)}")
    return out


def _difference(current: Value, stored: Value) -> str:
    a, b = np.asarray(current), np.asarray(stored)
    if a.shape != b.shape:
        return f"({a.size} values, {b.size} in the file)"
    if a.size > 3:
        return f"({int((a != b).sum())} of {a.size} values)"
    words = [str(v.tolist()) for v in (a, b)]
    if max(map(len, words)) > _SHOWN:
        return "(other content)"
    return f"({words[0]}, {words[1]} in the file)"


@dataclass(frozen=True)
class CheckpointOptions:
    """The checkpoint files of a fit: where to write, and which to resume from.

    Attributes:
        path: checkpoint to write; None: no checkpoint.
        resume: checkpoint to resume from; None: start from the beginning.
    """

    path: Path | None = None
    resume: Path | None = None

    @property
    def wanted(self) -> bool:
        return self.path is not None or self.resume is not None

    def refuse_existing(self) -> None:
        """Raise DataError, before any work, in two cases: the checkpoint to write exists, or the checkpoint to resume
        from is missing. A fit may replace the checkpoint from which it resumes.
        """
        if self.resume is not None:
            _read_state(self.resume)
        if self.path is not None and not (self.resume is not None and same_file(self.path, self.resume)):
            refuse_existing(self.path)

    def begin(self, origin: Mapping[str, Value], steps: int, warn: Warn) -> Mapping[str, NDArray[Any]] | None:
        """The state to resume from; None if the fit starts from the beginning.

        Args:
            origin: the origin of the fit, see `origin_of`.
            steps: planned number of steps; 0 if a time limit is planned.
            warn: function that gets a sentence if the planned number of steps differs, because the volume then differs
                from the volume of an uninterrupted fit.

        Raises:
            ConfigError: the fit has already made more steps than planned.
            DataError: the checkpoint has another origin.
        """
        if self.resume is None:
            return None
        saved, reached = _read_state(self.resume)
        refuse_other(self.resume, origin, saved.made_from, "fit")
        if 0 < steps < reached.step:
            raise ConfigError(
                f"--resume {self.resume} already contains {reached.step} steps, more than the {steps} steps that "
                f"you requested. Use --steps {reached.step} or more, or start again without --resume."
            )
        if steps != saved.steps or steps == 0:
            was, now = (f"{n} steps" if n else "a time limit" for n in (saved.steps, steps))
            plans = (
                f"The checkpoint is from a fit that was planned for {was}, but this fit is planned for {now}"
                if was != now
                else "The checkpoint is from a fit with a time limit, and this fit also has a time limit"
            )
            warn(f"{plans}: the learning rates continue at the same step of the new plan.")
        return saved.state

    def write(self, origin: Mapping[str, Value], steps: int, warn: Warn, state: Mapping[str, NDArray[Any]]) -> str:
        """Write the checkpoint and return "". If the disk refuses, the fit continues: the function warns and returns
        the reason.
        """
        if self.path is None:
            return ""
        try:
            write_checkpoint(self.path, Checkpoint(state, origin, steps))
        except DataError as error:
            warn(f"A checkpoint could not be written: {error}")
            return str(error)
        return ""


def _read_state(path: Path) -> tuple[Checkpoint, FitState]:
    """The checkpoint, and the state in it.

    Raises:
        DataError: there is no checkpoint, or it does not contain a state to resume from.
    """
    saved = read_checkpoint(path)
    try:
        reached = state_from(saved.state)
        for name, values in saved.state.items():
            # The last loss, and the best one of the held-out views, may be NaN; a Gaussian's exponent is infinite.
            if name not in ("scalars", "watch", "kernel_exponent") and not np.isfinite(values).all():
                raise ValueError(f"{name} of the checkpoint has values that are not finite")
        if not (np.isfinite(reached.unit) and reached.unit > 0):
            raise ValueError(f"the density unit of the checkpoint must be above 0, but it is {reached.unit}")
    except ValueError as error:
        raise DataError(
            f"The checkpoint {path} is damaged: {error}. Resume from another checkpoint, or start again without "
            "--resume."
        ) from error
    return saved, reached


def refuse_other(path: Path, now: Mapping[str, Value], before: Mapping[str, Value], content: str) -> None:
    """Raise DataError with the differences if a file has another origin; `content` names the content of the file."""
    others = differences(now, before)
    if others:
        listed = "; ".join(others[:6]) + (f"; and {len(others) - 6} more" if len(others) > 6 else "")
        raise DataError(
            f"{path} belongs to another {content}, so it cannot be resumed: {listed}. Use the options with which "
            f"{path} was written, or start again without --resume. No file was changed."
        )
