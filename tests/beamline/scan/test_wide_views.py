"""Wide views: the sample is stepped across the beam after the views, so that frames side by side show all of it."""

import json
import math
from pathlib import Path

import h5py
import numpy as np
import pytest

from beamline.core.errors import ConfigError
from beamline.features.files.validate import describe, validate
from beamline.plan.plan import Mode
from beamline.projections.prepare import prepare_projections
from beamline.projections.selection import Selection
from beamline.scan.preflight import dry_run
from beamline.scan.run import run_scan
from beamline.storage.readers.open import open_scan
from beamline.storage.writers import layout
from drivers.base.frame import FrameKind
from recon.base.volume import Grid
from recon.voxels.projector import Projector
from tests.beamline.ball_scan import COMMON, shipped, with_scene

# A can three fields wide with a ball near its wall, which no ordinary view at 0 degrees shows.
PIXEL, COLS = 4.6e-3, 40
FIELD = PIXEL * COLS
BALL, RADIUS = (0.2, 0.05, 0.01), 0.03
SCENE = {
    "phantom": {
        "kind": "solids",
        "solids": [
            {"kind": "cylinder", "radius": 1.4 * FIELD, "height": 1.0, "attenuation": 3.0},
            {"kind": "ellipsoid", "semi_axes": [RADIUS] * 3, "attenuation": 20.0, "centre": list(BALL)},
        ],
    },
    "beam": {"photons_per_s": 1.0e5},
    "effects": ["photon_noise"],
}
DIAMETER = 2.8 * FIELD
ASKED = ("scan.wide_views=2", f"sample.diameter_mm={DIAMETER}")
SHORT = (
    "scan.angles={scheme: fixed, views: 12}", "scan.flats={count: 2, at: both}", "scan.darks={count: 2}",
    "devices.camera.roi=[1136, 2028, 32, 40]", "simulation.clock=virtual", "recon.live=false", "scan.mode=step", "scan.period_s=0.6",
)  # fmt: skip
MOTOR = (
    "devices.sample_mover={{kind: stage, in_deg: 1, out_deg: 12, mm_per_deg: {}, speed_deg_s: 10, "
    f"stage: {{{{kind: epics, port: 'sim://epics', unit: mm, {COMMON}}}}}}}}}"
)


def asked(*words: str):  # noqa: ANN201
    return with_scene(shipped("simulated", *SHORT, *words), SCENE)
