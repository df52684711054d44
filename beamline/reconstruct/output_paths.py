"""Where the results of a reconstruction go, and what is refused before any work."""

from __future__ import annotations

import math
import os
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path

from beamline.core.errors import DataError
from beamline.core.files import REPORT, refuse_existing
from beamline.core.text import size
from beamline.storage.writers.recon_file import SUFFIXES as RECON_SUFFIXES
from recon.base.volume import Grid

_ROOM = 3.0  # times a volume: free disk from which on a second one is kept


def report_beside(output: Path) -> Path:
    """The page of an output: report.html beside a run's recon.h5, else the output's own name with .html."""
    return output.with_name(REPORT) if output.stem == "recon" else output.with_suffix(".html")


@dataclass(frozen=True)
class OutputPaths:
    """Where results go. `report` is None where none is wanted; `replace` takes the place of older results. Where the
    file `output` is not to be `written`, its folder is only worked in.
    `names`: of volumes that get a file each, OUTPUT's stem + _NAME; empty: there is one file, `output` itself."""

    output: Path
    report: Path | None
    replace: bool = False
    written: bool = True
    names: tuple[str, ...] = ()

    @property
    def outputs(self) -> tuple[Path, ...]:
        """The files of volumes, in their order."""
        stem, suffix = self.output.stem, self.output.suffix
        return tuple(self.output.with_name(f"{stem}_{name}{suffix}") for name in self.names) or (self.output,)

    @property
    def partial(self) -> Path:
        """The file of a volume in slabs, while it is made."""
        return self.output.with_name(f"{self.output.stem}.partial.h5")

    @property
    def live_picture(self) -> Path:
        """The picture of a volume that grows with its scan."""
        return self.output.with_name(f"{self.output.stem}.live.png")

    def refuse_partial(self) -> None:
        """Raise DataError if there are slabs of an earlier call."""
        if os.path.lexists(self.partial):
            raise DataError(
                f"{self.partial} exists: it keeps the slabs of a call that was stopped. Go on from it with --resume "
                f"{self.partial}, or move it away. Nothing was touched."
            )

    def refuse_existing(self) -> None:
        """Raise DataError before any work if a result exists, or its folder cannot be written to."""
        if not self.replace:
            for path in (*self.outputs, self.report):
                if path is not None:
                    refuse_existing(path)
        try:
            with tempfile.TemporaryFile(dir=self.output.parent):
                pass
        except OSError as error:
            raise DataError(
                f"{self.output.parent} cannot be written to ({error.strerror or error}). Name an output elsewhere with "
                "-o. Nothing was read."
            ) from error

    def takes_a_second(self, grid: Grid) -> bool:
        """The output is a file of ours, and its disk has room for a second volume of this size."""
        room = shutil.disk_usage(self.output.parent).free > _ROOM * 4 * math.prod(grid.shape)
        return self.written and room and self.output.suffix.lower() in RECON_SUFFIXES

    def require_room(self, n_bytes: int, meanwhile: int = 0) -> None:
        """Raise DataError before the work if the disk has no room for a volume of so many bytes and temporary files of
        `meanwhile` bytes."""
        free = shutil.disk_usage(self.output.parent).free
        if n_bytes + meanwhile > free:
            work = f" and {size(meanwhile)} while it is made" if meanwhile else ""
            raise DataError(
                f"The volume takes {size(n_bytes)}{work}, the disk of {self.output} has {size(free)} free. Free some "
                "space, name an output elsewhere with -o, or give --bin. Nothing was written."
            )
