"""Options of a reconstruction: scan, selection, method and output."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from beamline.core.errors import ConfigError
from beamline.projections.selection import Selection
from beamline.reconstruct.checkpoints import CheckpointOptions
from beamline.reconstruct.option_rules import RULES, contradiction, of_other_methods
from beamline.reconstruct.output_paths import OutputPaths
from beamline.reconstruct.region import AroundSample, Region, selection_around
from beamline.reconstruct.several_scans import SeveralScans
from beamline.storage.readers.base import ScanSource
from beamline.storage.readers.open import SourceOptions
from beamline.storage.writer_lock import PATIENCE
from beamline.storage.writers.partial_volume import can_become
from recon.base.choices import Quality
from recon.base.geometry import Geometry
from recon.base.method import EarlyStopMethod, Method, PresetMethod
from recon.base.settings_check import check_settings
from recon.methods import has_setting, names, streams
from recon.splatting.fit_method import StreamingMethod
from recon.splatting.initialise import default_count
from recon.splatting.r2 import R2
from recon.voxels.enough_views import Goal
from recon.voxels.fbp import Filter


@dataclass(frozen=True)
class FollowTiming:
    """How a scan is followed; all in s.

    Attributes:
        poll: between looks at the file while there is nothing to fit.
        slice: of fitting between looks at the file.
        snapshot: between intermediate volumes.
        picture: between slices by FBP, at least; drawing them takes at most half of the time.
        patience: without a new frame, before a file without the lock of its writer counts as one that died.
    """

    poll: float = 0.1
    slice: float = 0.25
    snapshot: float = 5.0
    picture: float = 0.3
    patience: float = PATIENCE


@dataclass(frozen=True)
class ReconOptions:
    """The options of a reconstruction; those of `beamline recon` say more in its help.

    Attributes:
        method: with its settings; `R2.seconds` are those of the whole call, of a followed scan from its end.
        budget: s for everything from line integrals to volume; chooses the method and all settings.
        quality: a preset instead of the fit's steps, Gaussians.
        filter: of the FBP that the volume is compared with.
        truth: FILE or FILE:first:end to compare with.
        unfinished: take the present frames of a scan that still runs or died.
        follow: settings for a scan that is still running; None for one that has ended.
        enough: for a followed scan: when its views are enough; None: no such goal.
        memory: bytes that the reconstruction may use; None: 70 % of the free memory.
        cluster: whose workers reconstruct slabs, see `workers.cluster`; None: this process does.
        region: the box of the volume to make; None: all of it.
        partial: volume whose missing slabs are reconstructed; None begins anew.
        uncertainty: make the standard deviation of each voxel, too, see `recon.error_bars`.
        command: that repeats this, for the record.
        recipe: its options that hold for any scan, as YAML, for the record.
    """

    source: SourceOptions | SeveralScans
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
    enough: Goal | None = None
    memory: int | None = None
    region: Region | AroundSample | None = None
    cluster: str | None = None
    partial: Path | None = None
    uncertainty: bool = False
    command: str = ""
    recipe: str = ""

    def __post_init__(self) -> None:
        check_settings(self)

    @property
    def given(self) -> frozenset[str]:
        """Names of the options, as `option_rules` has them, whose values differ from their defaults."""
        usual = {each.name: each.default for each in fields(self)}
        run = {name for name, rule in RULES.items() if _at(self, rule.value) not in (None, usual.get(rule.value))}
        unset = type(self.method)()
        of_method = {
            name
            for name, rule in RULES.items()
            if rule.setting and has_setting(type(self.method), rule.setting)
            if _at(self.method, rule.setting) != _at(unset, rule.setting)
        }
        return frozenset(run | of_method | ({"time"} if self.method.traits.in_time else set()))

    def refuse_contradictions(self) -> None:
        """Raises ConfigError for values that do not go together, or that the method would silently ignore."""
        given = self.given
        if why := contradiction(RULES, given, one_method=True) or of_other_methods(RULES, given, self.method.name):
            raise ConfigError(why)

    @property
    def becomes_output(self) -> bool:
        """Whether a volume made in slabs becomes the output without a copy."""
        alone = self.region is None and not self.uncertainty
        return alone and self.target.written and can_become(self.target.output)

    def disk_needs(self, volume: int, *, in_slabs: bool) -> tuple[int, int]:
        """Bytes on the disk for the result, and for temporary files, of a volume of so many bytes."""
        if not in_slabs:
            return volume * self.target.written * (1 + self.uncertainty), 0
        compared = self.target.report is not None and not self.method.traits.direct
        slabs = self.partial is None  # else they are there
        bars = self.uncertainty
        if not self.target.written:
            return 0, (slabs + compared + bars) * volume
        if self.becomes_output:
            return slabs * volume, compared * volume
        return (1 + bars) * volume, (slabs + compared + bars) * volume

    def around_region(self, source: ScanSource) -> ReconOptions:
        """The same with the rows that show the region, which is found where it is the one around the sample; the same
        options where all of the volume is wanted.

        Raises:
            ConfigError, DataError: see `region.selection_around` and `sample_box.box_around_sample`.
        """
        region = self.region
        if region is None:
            return self
        if isinstance(region, AroundSample):
            from beamline.reconstruct.region import box_around_sample

            region = box_around_sample(source, self.selection)
        selection = selection_around(source, self.selection, region, self.method.traits.halo)
        return replace(self, selection=selection, region=region)

    @property
    def partial_path(self) -> Path:
        """Where slabs are kept while others are made."""
        return self.target.partial if self.partial is None else self.partial

    def method_for(self, geometry: Geometry) -> Method:
        """The method for these views, with the steps and Gaussians of the preset, if there is one."""
        if self.quality is None or not isinstance(self.method, PresetMethod):
            return self.method
        return self.method.with_quality(self.quality, default_count(geometry, geometry.sample_pitch))

    @property
    def stops_early(self) -> bool:
        """Whether the method ends early by views held out."""
        return isinstance(self.method, EarlyStopMethod) and self.method.early_stop

    @property
    def streaming(self) -> StreamingMethod:
        """The method for a followed scan.

        Raises:
            ConfigError: it needs the whole scan.
        """
        if not isinstance(self.method, StreamingMethod):
            raise ConfigError(
                f"--follow needs a method whose volume grows with the views ({', '.join(filter(streams, names()))}); "
                f"run {self.method.name} without --follow when the scan has ended."
            )
        return self.method


def _at(whole: Any, path: str) -> Any:
    """The value at a path such as `fit.loss`; None where there is none."""
    for name in path.split("."):
        whole = getattr(whole, name, None)
    return whole
