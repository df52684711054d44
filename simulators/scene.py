"""Scene: what stands in the beam and which departures from Beer-Lambert are simulated; read from a YAML mapping.

Keys are the field names of the dataclasses; mm, s, 1/mm and electrons throughout:

    phantom: {kind: battery, field_of_view: [0.9, 0.9], n_particles: 150, seed: 7}
    # or:    {kind: solids, solids: [{kind: cylinder, radius: 0.3, height: 0.6, attenuation: 1.5}, ...]}
    beam: {photons_per_s: 1.0e5}        # detected a second and sensor pixel (quantum efficiency included)
    axis_offset_px: 3.4                 # rotation axis right of the sensor's middle, in sensor pixels
    effects: [photon_noise, {kind: zingers, rate: 5.0}]
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from simulators.battery import battery
from simulators.effects.beam_decay import BeamDecay
from simulators.effects.beam_profile import BeamProfile
from simulators.effects.chain import Chain, ImageEffect, MotionEffect
from simulators.effects.hot_pixels import HotPixels
from simulators.effects.motion_blur import MotionBlur
from simulators.effects.rolling_shutter import RollingShutter
from simulators.effects.zingers import Zingers
from simulators.mapping import SceneError, build, choose, keys, number
from simulators.phantom import Detector, Phantom
from simulators.sensor import DarkCurrent, Offset, PhotonNoise, ReadNoise
from simulators.solids import Box, Cylinder, Ellipsoid, Octahedron, Solid, Tube

SOLIDS: Mapping[str, type[Solid]] = MappingProxyType(
    {cls.__name__.lower(): cls for cls in (Cylinder, Tube, Ellipsoid, Box, Octahedron)}
)
_EFFECTS = (
    *(MotionBlur, RollingShutter),
    *(BeamProfile, BeamDecay, PhotonNoise),
    *(DarkCurrent, HotPixels, Zingers, ReadNoise),
    Offset,
)
EFFECTS: Mapping[str, type[MotionEffect | ImageEffect]] = MappingProxyType({cls.name: cls for cls in _EFFECTS})


@dataclass(frozen=True)
class Beam:
    """The beam: photons detected a second by each (unbinned) sensor pixel where nothing stands in the way."""

    photons_per_s: float

    def __post_init__(self) -> None:
        if not self.photons_per_s >= 0:
            raise ValueError(f"photons_per_s must be >= 0, got {self.photons_per_s}")


@dataclass(frozen=True)
class Battery:
    """Arguments of simulators.battery.battery, with the seed of its generator."""

    field_of_view: tuple[float, float]
    n_particles: int = 150
    fill: float = 0.12
    seed: int = 0

    def solids(self) -> tuple[Solid, ...]:
        return battery(np.random.default_rng(self.seed), self.field_of_view, self.n_particles, self.fill)


@dataclass(frozen=True, eq=False)
class Scene:
    """What stands in the beam.

    Attributes:
        phantom: the sample.
        beam: the light.
        chain: the effects, in order; with none a frame is exactly Beer-Lambert.
        axis_offset_px: columns by which the rotation axis lies right of the sensor's middle, in sensor pixels.
    """

    phantom: Phantom
    beam: Beam
    chain: Chain
    axis_offset_px: float = 0.0

    def line_integrals(self, angle: ArrayLike, detector: Detector) -> NDArray[np.float64]:
        """Float64 [row, col]; see Phantom.line_integrals."""
        return self.phantom.line_integrals(angle, detector)


def load_scene(mapping: Mapping[str, Any]) -> Scene:
    """A scene from a mapping as YAML gives it; the keys are shown at the head of this module.

    Raises:
        SceneError: an unknown or missing key, a wrong value, or effects in an order that physics does not allow.
    """
    legal = ("phantom", "beam", "axis_offset_px", "effects")
    mapping = keys("scene", mapping, legal=legal, needed=("phantom", "beam"))
    effects = [choose(f"scene.effects[{i}]", EFFECTS, entry) for i, entry in _items("effects", mapping)]
    try:
        chain = Chain.of(effects)
    except ValueError as error:
        raise SceneError(f"scene.effects: {error}") from None
    return Scene(
        phantom=Phantom.of(_solids(mapping["phantom"])),
        beam=build(Beam, "scene.beam", mapping["beam"]),
        chain=chain,
        axis_offset_px=number("scene.axis_offset_px", mapping.get("axis_offset_px", 0.0)),
    )


def _solids(mapping: Any) -> tuple[Solid, ...]:
    where = "scene.phantom"
    kind = mapping.get("kind") if isinstance(mapping, Mapping) else mapping
    if kind not in ("battery", "solids"):
        raise SceneError(f"{where}: kind {kind!r} is unknown; legal: battery, solids")
    if kind == "solids":
        mapping = keys(where, mapping, legal=("kind", "solids"), needed=("solids",))
        return tuple(choose(f"{where}.solids[{i}]", SOLIDS, entry) for i, entry in _items("solids", mapping))
    try:
        return choose(where, {"battery": Battery}, mapping).solids()
    except ValueError as error:
        raise SceneError(f"{where}: {error}") from None


def _items(key: str, mapping: Mapping[str, Any]) -> list[tuple[int, Any]]:
    entries = mapping.get(key) or []
    if not isinstance(entries, list | tuple):
        raise SceneError(f"scene: {key} must be a list, got {entries!r}")
    return list(enumerate(entries))
