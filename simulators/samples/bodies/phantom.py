"""Phantom: analytic solids with exact chord lengths, and their true attenuation on a grid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from recon.base.volume import Grid
from simulators.frame.detector import Detector
from simulators.frame.pose import Pose
from simulators.samples.bodies.chords import depths
from simulators.samples.bodies.filling import add_attenuation, put_labels
from simulators.samples.bodies.packing import CYLINDER, ELLIPSOID, Packed, pack
from simulators.samples.bodies.solids import Solid, kind_of
from simulators.samples.bodies.view import view_of

MOST_NAMES = 255  # labels are uint8, and 0 is air


@dataclass(frozen=True, eq=False)
class Phantom:
    """Solids prepared for the kernels. Created by Phantom.of.

    Attributes:
        solids: in the order in which they fill space: in labels, later ones replace earlier ones.
        solid_names: name of each in the labels.
        packed: the solids as flat arrays.
    """

    solids: tuple[Solid, ...]
    solid_names: tuple[str, ...]
    packed: Packed

    @classmethod
    def of(cls, solids: Sequence[Solid], names: Sequence[str] | None = None) -> Phantom:
        """A phantom.

        Args:
            names: one a solid, for the labels; several may share one. None: the names of the kinds.

        Raises:
            ValueError: not as many names as solids, or more than 255 different ones.
        """
        called = tuple(kind_of(solid) for solid in solids) if names is None else tuple(names)
        if len(called) != len(solids):
            raise ValueError(f"{len(solids)} solids have {len(called)} names; give each solid a name, or none")
        if len(set(called)) > MOST_NAMES:
            raise ValueError(f"labels are bytes: at most {MOST_NAMES} names, got {len(set(called))}; let solids share")
        return cls(tuple(solids), called, pack(solids))

    @cached_property
    def radius(self) -> float:
        """mm from the rotation axis to the farthest matter.

        An ellipsoid is bounded by the upright elliptic cylinder around it, turned with its longer axis outwards."""
        p = self.packed
        out = np.hypot(p.centre[:, 0], p.centre[:, 1])
        round_ = p.kind == ELLIPSOID
        across = np.linalg.inv(p.matrix[round_])[:, :2]  # columns: the semi-axes, projected along z
        half = np.linalg.norm(across, ord=2, axis=(1, 2))
        corners = np.repeat(p.centre, np.diff(p.first_vertex), axis=0)[:, :2] + p.vertices[:, :2]
        reaches = ((out + p.size[:, 0])[p.kind == CYLINDER], out[round_] + half, np.hypot(corners[:, 0], corners[:, 1]))
        return max(float(reach.max(initial=0.0)) for reach in reaches)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(self.solid_names))

    def line_integrals(self, angle: ArrayLike | Pose, detector: Detector) -> NDArray[np.float64]:
        """See Sample.line_integrals.

        Raises:
            ValueError: a solid that does not lie wholly in front of a cone's source.
        """
        pose = angle if isinstance(angle, Pose) else Pose.turned(angle, detector.shape[0])
        return depths(self.packed, view_of(self.packed, self.solid_names, pose, detector))

    def attenuation(self, grid: Grid, supersample: int = 3) -> NDArray[np.float32]:
        """See Sample.attenuation."""
        out = np.zeros(grid.shape)
        add_attenuation(self.packed, *_lattice(grid), supersample, out)
        return out.astype(np.float32)

    def labels(self, grid: Grid) -> NDArray[np.uint8]:
        """See Sample.labels; where solids overlap, the later one counts."""
        out = np.zeros(grid.shape, np.uint8)
        index = {name: i + 1 for i, name in enumerate(self.names)}
        label = np.array([index[name] for name in self.solid_names], dtype=np.uint8)
        put_labels(self.packed, label, *_lattice(grid), out)
        return out


def _lattice(grid: Grid) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """(z, y, x) of the first voxel's centre and of a voxel's edges, mm."""
    z, y, x = grid.coordinates()
    dz, dy, dx = grid.spacing
    return (float(z[0]), float(y[0]), float(x[0])), (float(dz), float(dy), float(dx))
