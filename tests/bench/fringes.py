"""Fringes behind cathodes: dB and CPU seconds by default, by no filter, by the filter of the truth, and by that chosen.

    python -m tests.bench.fringes [--cases 0,1,2,3,4] [--methods fista-tv] [--ways none,true,auto]

Scenes `cathode` of 256 columns x 16 rows x 90 views, whose transport moves light as the wave does between sample and
detector. PSNR in dB inside the cylinder that all views see, values clipped at 0.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from beamline.scenes.scene_file import geometry_of, open_scene, truth_of
from drivers.base.frame import FrameKind
from recon.base.geometry import Geometry
from simulators.scenes.expose import Scan, expose

F32 = NDArray[np.float32]
ENERGY, PIXEL_UM = 25.0, 4.6


class FringeCase(NamedTuple):
    """A scan: ratio delta / beta (0: no fringes), distance in mm, photons a pixel and exposure, seed of the packing."""

    delta_beta: float
    distance_mm: float
    photons: float
    seed: int


CASES = (
    FringeCase(90, 30, 3e4, 7),
    FringeCase(200, 30, 1e4, 11),
    FringeCase(90, 150, 3e4, 12),
    FringeCase(400, 20, 3e3, 13),
    FringeCase(45, 30, 1e5, 14),
)


def scan_of(case: FringeCase, cols: int = 256, rows: int = 16, views: int = 90) -> tuple[F32, F32, Geometry]:
    """Line integrals [view, row, col], the truth [z, y, x] in 1/mm, and the geometry."""
    fringes = (
        f"{{kind: phase_fringes, delta_beta: {case.delta_beta}, distance: {case.distance_mm}, energy: {ENERGY}, "
        "method: transport}, "
    )
    scene = open_scene(
        "cathode",
        [
            f"phantom.diameter={0.94 * cols * PIXEL_UM * 1e-3}",
            f"phantom.seed={case.seed}",
            "phantom.height=0.3",
            f"detector.shape=[{rows},{cols}]",
            f"beam.photons_per_s={case.photons / 0.05}",
            f"detector.electrons_per_count={case.photons / 3e4}",
            f"effects=[pixel_area, {fringes if case.delta_beta else ''}photon_noise]",
        ],
    ).scene
    scan = Scan.of(scene, case.seed, views)
    flats, images, angles = [], [], []
    for planned in scan:
        if planned.kind is FrameKind.DARK:
            continue
        counts = expose(scene, planned.shot).astype(np.float32)
        if planned.kind is FrameKind.FLAT:
            flats.append(counts)
        else:
            images.append(counts)
            angles.append(planned.shot.angle)
    data = -np.log(np.maximum(images, 0.5) / np.mean(flats, axis=0))
    truth = truth_of(scene.sample, scan.detector, 1).values
    return data.astype(np.float32), truth, geometry_of(scan.detector, np.array(angles))
