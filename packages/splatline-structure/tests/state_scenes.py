"""The scene `operando` of the simulator, small: views of any state, a reference, and the truth of each particle."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

import recon
from beamline.config.tree import override, read
from beamline.core.installed import shipped_scenes
from recon.base.arrays import F32
from simulators.frame.shot import Detector, Pose
from simulators.samples.sample import Changing
from simulators.scenes.scene import load_scene

PITCH = 0.65e-3  # mm


@dataclass(frozen=True)
class States:
    """A packing and its cycle, and how it is scanned.

    Attributes:
        seed: of the packing, of the cycle and of all noise.
        others: other values of the scene, `KEY=VALUE`.
    """

    seed: int = 0
    columns: int = 160
    rows: int = 48
    photons: float = 1e4
    others: tuple[str, ...] = field(default=())

    def sample(self, state: float) -> Changing:
        """The sample in a state; 0 is the reference."""
        across, tall = 0.92 * self.columns * PITCH, (self.rows + 32) * PITCH
        path = shipped_scenes()["operando"]
        values = (
            f"phantom.diameter={across:g}", f"phantom.height={tall:g}", f"phantom.seed={self.seed}", "phantom.fill=0.4",
            f"phantom.change.seed={self.seed}", f"phantom.change.state={state:g}", *self.others,
        )  # fmt: skip
        tree = override(read(path.read_text(encoding="utf-8"), str(path)), values, environment={})
        sample = load_scene(tree.data).sample
        assert isinstance(sample, Changing)
        return sample

    def geometry(self, views: int) -> recon.Geometry:
        angles = np.arange(views) * np.pi / views
        return recon.Geometry.parallel(angles, (self.rows, self.columns), pixel_pitch=PITCH)

    def lines(self, state: float, views: int, noise: int = 0) -> F32:
        """Noisy line integrals [view, row, col]; four rays a pixel."""
        sample, geometry = self.sample(state), self.geometry(views)
        detector = Detector.centred((self.rows, self.columns), PITCH)
        rng = np.random.default_rng([self.seed, int(state * 8), views, noise])
        out = np.empty((views, self.rows, self.columns), np.float32)
        for view, angle in enumerate(geometry.angles):
            pose = Pose.turned(angle, self.rows)
            rays = [
                np.exp(-sample.line_integrals(pose, detector.aimed(a, b))) for a in (-0.25, 0.25) for b in (-0.25, 0.25)
            ]
            counts = rng.poisson(self.photons * np.mean(rays, axis=0))
            out[view] = -np.log(np.maximum(counts, 0.5) / self.photons)
        return out

    def truth(self, state: float) -> dict[str, NDArray[Any]]:
        return dict(self.sample(state).table)

    def reference(self, views: int, method: str = "fista-tv") -> recon.Volume:
        return recon.reconstruct(self.lines(0, views), self.geometry(views), method).volume
