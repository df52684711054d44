"""Options of a reconstruction: scan, selection, method, and the files for the results."""

from __future__ import annotations

import os
import shutil
import tempfile
from dataclasses import dataclass, field, replace
from pathlib import Path

from beamline.core.errors import DataError
from beamline.core.files import REPORT, refuse_existing
from beamline.core.text import size
from beamline.projections.selection import SelectedScan, Selection
from beamline.reconstruct.checkpoints import CheckpointOptions
from beamline.reconstruct.combinations import SLABS_RESUMED
from beamline.reconstruct.region import AroundSample, Region, box_around_sample, rows_around
from beamline.storage.readers.open import SourceOptions
from beamline.storage.writer_lock import PATIENCE
from beamline.storage.writers.recon_file import SUFFIXES
from recon.base.choices import Quality
from recon.base.declared_types import check_settings
from recon.base.geometry import Geometry
from recon.base.method import Method
from recon.splatting.fit_method import Fit
from recon.splatting.initialise import default_count
from recon.splatting.r2 import R2
from recon.voxels.fbp import Filter


def report_beside(output: Path) -> Path:
    """Path of the report: report.html next to the recon.h5 of a run, otherwise the name of the output with .html."""
    return output.with_name(REPORT) if output.stem == "recon" else output.with_suffix(".html")


@dataclass(frozen=True)
class OutputPaths:
    """Paths of the results. report: None if the user does not want a report. replace: True: overwrite older results.
    written: False: no volume is written, and the folder of `output` is used only for temporary files.
    """

    output: Path
    report: Path | None
    replace: bool = False
    written: bool = True

    @property
    def partial(self) -> Path:
        """The file that keeps the finished slabs of a volume until all slabs are finished."""
        return self.output.with_name(f"{self.output.stem}.partial.h5")

    @property
    def live_picture(self) -> Path:
        """The picture of a volume that grows with its scan."""
        return self.output.with_name(f"{self.output.stem}.live.png")

    def refuse_partial(self) -> None:
        """Raise DataError if slabs of an earlier call exist."""
        if os.path.lexists(self.partial):
            raise DataError(
                f"{self.partial} has the finished slabs of an earlier call that was interrupted. Continue with "
                f"--resume {self.partial}, or move the file away. Nothing was changed."
            )

    def refuse_existing(self) -> None:
        """Raise DataError, before any work, if a result already exists or its folder is not writable."""
        if not self.replace:
            for path in (self.output, self.report):
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

    def require_room(self, n_bytes: int, meanwhile: int = 0) -> None:
        """Raise DataError, before any work, if the disk has no room for a volume of `n_bytes` bytes and temporary files
        of `meanwhile` bytes.
        """
        free = shutil.disk_usage(self.output.parent).free
        if n_bytes + meanwhile > free:
            work = f" and {size(meanwhile)} more during the reconstruction" if meanwhile else ""
            raise DataError(
                f"Not enough disk space: the volume needs {size(n_bytes)}{work}, but the disk of {self.output} has "
                f"{size(free)} free. Free some space, name an output on another disk with -o, or use --bin. Nothing "
                "was written."
            )


@dataclass(frozen=True)
class FollowTiming:
    """Intervals for following a scan, in s.

    Attributes:
        poll: time between two readings of the file if there is nothing to fit.
        slice: time of fitting between two readings of the file.
        snapshot: time between two intermediate volumes.
        picture: shortest time between two pictures of FBP slices; drawing takes at most half of the time.
        patience: a scan counts as dead if its file has no lock and no new frame was written for this time.
    """

    poll: float = 0.1
    slice: float = 0.25
    snapshot: float = 5.0
    picture: float = 0.3
    patience: float = PATIENCE


@dataclass(frozen=True)
class ReconOptions:
    """The options of a reconstruction; the help of `beamline recon` explains them further.

    Attributes:
        method: the method with its settings. `R2.seconds` limits the whole call, or the time after the end of the scan
            if the scan is followed.
        budget: time limit in s from the line integrals to the volume; `auto` does not try methods that would take
            longer.
        quality: a preset for the number of steps and Gaussians.
        filter: filter of the FBP that the volume is compared with.
        truth: ground truth for the comparison, as FILE or FILE:first:end.
        unfinished: True: use the existing frames of a scan that is still running or died.
        follow: settings for a scan that is still running; None for a finished scan.
        memory: bytes that the reconstruction may use; None: 70 % of the free memory.
        cluster: workers that reconstruct slabs, in the form of `--cluster`; None: this process does it.
        region: the box of the volume to reconstruct; None: the whole volume.
        partial: partial volume whose missing slabs are reconstructed; None: start from the beginning.
        reference: an earlier volume of the same sample, or the scan of it, for a method that uses a reference.
        uncertainty: True: also compute the standard deviation of each voxel, see `recon.error_bars`.
        command: the command line of this call; it is written to the volume file.
        recipe: the options that apply to any scan, as YAML; it is written to the volume file.
    """

    source: SourceOptions
    target: OutputPaths
    selection: Selection
    method: Method = field(default_factory=R2)
    budget: float | None = None
    quality: Quality | None = None
    device: str = "cpu"
    checkpoints: CheckpointOptions = field(default_factory=CheckpointOptions)
    filter: Filter = "hann"
    seed: int = 0
    truth: str | None = None
    unfinished: bool = False
    follow: FollowTiming | None = None
    memory: int | None = None
    region: Region | AroundSample | None = None
    cluster: str | None = None
    partial: Path | None = None
    reference: Path | None = None
    uncertainty: bool = False
    command: str = ""
    recipe: str = ""

    def __post_init__(self) -> None:
        check_settings(self)

    @property
    def given(self) -> frozenset[str]:
        """What these options ask for, by its names in `combinations.EXCLUDED`."""
        values = {
            "follow": self.follow, "budget": self.budget, "quality": self.quality, "reference": self.reference,
            "volumes": self.method.volumes > 1, "uncertainty": self.uncertainty, "truth": self.truth,
            "roi": self.region, "cluster": self.cluster, "memory": self.memory, SLABS_RESUMED: self.partial,
        }  # fmt: skip
        return frozenset(name for name, value in values.items() if value not in (None, False))

    def disk_needs(self, volume: int, *, in_slabs: bool) -> tuple[int, int]:
        """(bytes on disk for the result, bytes for temporary files), for a volume of `volume` bytes.

        With a reference, an HDF5 file also contains the change and, unless the volume is made in slabs, the three
        components of the displacement.
        """
        bars, change = self.uncertainty, self.reference is not None
        beside = change * (1 if in_slabs else 4) if self.target.output.suffix.lower() in SUFFIXES else 0
        output = volume * self.target.written * (1 + bars + beside)
        if not in_slabs:
            return output, 0
        compared = self.target.report is not None and self.method.fitted
        slabs = self.partial is None  # otherwise the file of the slabs already exists
        return output, volume * (slabs * (1 + change) + compared + bars)

    def around_region(self, scan: SelectedScan) -> tuple[ReconOptions, SelectedScan]:
        """The options and the scan, narrowed to the detector rows that show the region; unchanged if the options ask
        for the whole volume. If the options ask for the region around the sample, the region is found first.

        Raises:
            ConfigError, DataError: see `region.rows_around` and `region.box_around_sample`.
        """
        region = self.region
        if region is None:
            return self, scan
        if isinstance(region, AroundSample):
            region = box_around_sample(scan)
        scan = rows_around(scan, region, self.method.halo)
        return replace(self, selection=scan.selection.asked, region=region), scan

    @property
    def partial_path(self) -> Path:
        """The file in which finished slabs are stored while the others are reconstructed."""
        return self.target.partial if self.partial is None else self.partial

    def method_for(self, geometry: Geometry) -> Method:
        """The method for these projections, with the steps and Gaussians of the preset if there is one."""
        if self.quality is None:
            return self.method
        return self.method.with_quality(self.quality, default_count(geometry, geometry.sample_pitch))

    @property
    def streaming(self) -> Fit:
        """The method for a scan that is followed while it runs; may be used only if `streams` is True."""
        assert isinstance(self.method, Fit)
        return self.method

    @property
    def streams(self) -> bool:
        """Whether the volume of the method can grow during a scan; other methods wait for the end of the scan."""
        return isinstance(self.method, Fit)
