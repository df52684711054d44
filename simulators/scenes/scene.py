"""Scene: the sample, the beam and the simulated deviations from Beer-Lambert, read from a YAML mapping.

Only the parts that a scene names are imported. Keys are the field names of the dataclasses; units are mm, s, 1/mm,
electrons:

    phantom: {kind: battery, field_of_view: [0.9, 0.9], n_particles: 150, seed: 7}
    # or:    {kind: solids, solids: [{kind: cylinder, radius: 0.3, height: 0.6, attenuation: 1.5}, ...]}
    # or:    kind cathode or foam (samples.builders.cathode, ...), or volume, from a file (voxels)
    #        {kind: foam, change: {kind: settle, share: 0.2, over_s: 9}}      # while it is scanned (builders.change)
    beam: {photons_per_s: 1.0e5}        # detected per second in each sensor pixel (with quantum efficiency)
    axis_offset_px: 3.4                 # rotation axis right of the sensor's middle, in sensor pixels
    effects: [photon_noise, {kind: zingers, rate: 5.0}]
    detector: {shape: [512, 512]}       # for `beamline simulate`; an instrument's configuration brings its own
    scan: {views: 180}                  # likewise
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, Literal

from drivers.orca_quest import SENSOR_SHAPE
from recon.base.setting import Setting, setting
from simulators.effects.catalogue import CATALOGUE, load_effect
from simulators.effects.chain import Chain
from simulators.frame.mapping import Positive, build, located, named
from simulators.light import Beam
from simulators.samples.composed import build_sample
from simulators.samples.sample import Sample

if TYPE_CHECKING:
    from simulators.samples.sample import ReadVolume


Frames = Annotated[int, Setting(ge=0, le=1_000_000)]  # as in a configuration
Seconds = Annotated[float, Setting(gt=0, le=1e6)]


@dataclass(frozen=True)
class DetectorSettings:
    """Attributes: shape: (rows, cols) of the frame, after binning. pixel_size_um: size of an unbinned pixel at the
    sample. exposure_s: exposure time of a frame. binning: number of sensor pixels summed per side. readout: mode of the
    camera. electrons_per_count: conversion; None: the value of the camera.
    """

    shape: tuple[Annotated[int, Setting(ge=1)], Annotated[int, Setting(ge=1)]] = (512, 512)
    pixel_size_um: float = setting(4.6, ge=1e-3, le=1e6)
    exposure_s: Seconds = 0.05
    binning: Literal[1, 2, 4] = 1
    readout: Literal["standard", "ultra_quiet", "photon_number"] = "standard"
    electrons_per_count: Positive | None = None

    def __post_init__(self) -> None:
        if any(n * self.binning > whole for n, whole in zip(self.shape, SENSOR_SHAPE, strict=True)):
            raise ValueError(
                f"{self.shape} pixels of {self.binning} x {self.binning} do not fit on the sensor of "
                f"{SENSOR_SHAPE[0]} x {SENSOR_SHAPE[1]}"
            )


@dataclass(frozen=True)
class ScanSettings:
    """Attributes: views: number of projections, evenly spaced over the range, whose end is excluded. range_deg: range
    of angles in degrees. period_s: s from one trigger to the next. fly: true: the stage turns steadily; false: it is at
    rest while a projection is exposed. darks, flats: numbers of frames before the projections.
    """

    views: int = setting(180, ge=1, le=1_000_000)
    range_deg: float = setting(180.0, ge=-1e6, le=1e6)
    period_s: Seconds = 0.1
    fly: bool = True
    darks: Frames = 10
    flats: Frames = 10

    def __post_init__(self) -> None:
        if self.range_deg == 0:
            raise ValueError("range_deg must not be 0")


@dataclass(frozen=True, eq=False)
class Scene:
    """Sample, beam and effects.

    Attributes:
        sample: the sample in the beam.
        beam: the beam.
        chain: the effects in order. Without effects, a frame follows Beer-Lambert exactly.
        axis_offset_px: columns by which the rotation axis lies right of the sensor's middle, in sensor pixels.
        detector, scan: settings for `beamline simulate`; a configured run has its own settings.
    """

    sample: Sample
    beam: Beam
    chain: Chain
    axis_offset_px: float = 0.0
    detector: DetectorSettings = field(default_factory=DetectorSettings)
    scan: ScanSettings = field(default_factory=ScanSettings)


@dataclass(frozen=True)
class _SceneKeys:
    """The keys of a scene's mapping. The keys of a phantom or an effect depend on its kind."""

    phantom: Any
    beam: Beam
    axis_offset_px: float = 0.0
    effects: tuple[Any, ...] | None = None
    detector: DetectorSettings = field(default_factory=DetectorSettings)
    scan: ScanSettings = field(default_factory=ScanSettings)


def load_scene(mapping: Mapping[str, Any], read: ReadVolume | None = None) -> Scene:
    """A scene from a mapping of YAML; see the module's docstring for the keys.

    Args:
        read: reads the file of a volume; None: the sample cannot be a volume.

    Raises:
        SceneError: a key is unknown or missing, a value is wrong, or the order of the effects is wrong.
    """
    keys = build(_SceneKeys, "scene", mapping)
    effects = []
    for i, entry in enumerate(keys.effects or ()):
        where = f"scene.effects[{i}]"
        kind, rest = named(where, list(CATALOGUE), entry)
        effects.append(build(load_effect(kind), f"{where} ({kind})", rest))
    with located("scene.effects"):
        chain = Chain.of(effects)
    sample = build_sample("scene.phantom", keys.phantom, keys.beam, read)
    return Scene(sample, keys.beam, chain, keys.axis_offset_px, keys.detector, keys.scan)
