"""Shots: a scene, the conditions of an exposure and a frame for tests, each with the changes of the test."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from simulators.frame.sensor import CONVERSION
from simulators.frame.shot import AngleAt, Detector, Shot
from simulators.scenes.expose import expose
from simulators.scenes.scene import Scene, load_scene

PHANTOM = {
    "kind": "solids",
    "solids": [
        {"kind": "cylinder", "radius": 0.3, "height": 0.5, "attenuation": 2.0},
        {"kind": "ellipsoid", "semi_axes": [0.15, 0.05, 0.1], "attenuation": 3.0, "centre": [0.1, 0.05, 0.0]},
    ],
}


def never(time: float) -> float:
    raise AssertionError("a scene without motion read the stage's angle")


def shot(**changes: Any) -> Shot:
    """A shot of 10 ms with 60 x 80 pixels of 10 um in the middle of the sensor, sample at 0.4 rad.

    Reading the angle of the stage at another time fails.
    """
    values: dict[str, Any] = {
        "detector": Detector.centred((60, 80), 0.01),
        "exposure": 0.01,
        "time": 1000.0,
        "angle": 0.4,
        "elapsed": 50.0,
        "row_period": 3.6e-6,
        "roi": (1120, 2008, 60, 80),
        "binning": 1,
        "readout": "standard",
        "conversion": CONVERSION[changes.get("readout", "standard")],
        "angle_at": never,
        "beam": True,
        "sample": True,
        "radius": 0.3,
        "seed": 1,
        "frame": 2,
        "view": 0,
    }
    return Shot(**(values | changes))


def sized(rows: int, cols: int, **changes: Any) -> Shot:
    """A shot of unbinned pixels, from the first row and column of the sensor."""
    return shot(**({"detector": Detector.centred((rows, cols), 0.01), "roi": (0, 0, rows, cols)} | changes))


def scene(*effects: Any, flux: float = 4e5, phantom: Any = PHANTOM) -> Scene:
    """A scene with two solids (or others) and the effects; with the default `flux` (photons/s) a shot has 4000
    photons."""
    return load_scene({"phantom": phantom, "beam": {"photons_per_s": flux}, "effects": list(effects)})


def frame(of_scene: Scene, of: Shot | None = None, angle_at: AngleAt = never, **state: Any) -> NDArray[np.uint16]:
    """Counts of a scene; `state`: beam and sample."""
    return expose(of_scene, replace(of or shot(), angle_at=angle_at, **state))


def depth(of_scene: Scene, angle: float) -> NDArray[np.float64]:
    """Line integrals of the sample of a scene in `shot()` at `angle` radians."""
    return of_scene.sample.line_integrals(angle, shot().detector)
