"""Ellipsoids projected with the exact rays of any geometry: projections and volume with a known answer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from recon.base.geometry import Geometry
from recon.base.volume import Grid

_FINE = 0.25 * np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]])  # rays of a pixel; its value is their mean


@dataclass(frozen=True, eq=False)
class Bodies:
    """Ellipsoids; where they overlap, their densities add up.

    Attributes:
        centre: [body, 3] mm, x, y, z.
        inverse: [body, 3, 3], matrix that maps an ellipsoid (about its centre) to the unit ball.
        density: [body], 1/mm.
    """

    centre: NDArray[np.float64]
    inverse: NDArray[np.float64]
    density: NDArray[np.float64]

    def views(self, geometry: Geometry, noise: float = 0.0, seed: int = 0) -> NDArray[np.float32]:
        """Line integrals [view, row, col], with noise; `noise`: standard deviation as a share of the largest one."""
        rows, cols = geometry.detector_shape
        out, pitch = np.zeros((geometry.n_views, rows * cols)), geometry.pixel_pitch
        at = np.stack([each.ravel() for each in np.meshgrid(np.arange(cols), np.arange(rows))], axis=1)
        for view in range(geometry.n_views):
            along_cols, along_rows, beam = geometry.axes(view)
            for fine in _FINE:
                across = (at + fine - geometry.origin(view)) * pitch @ np.stack((along_cols, along_rows))
                if geometry.is_cone:
                    start = np.broadcast_to(-geometry.sod * beam, across.shape)
                    rays = across + geometry.sdd * beam
                    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
                else:
                    start, rays = across, np.broadcast_to(beam, across.shape)
                out[view] += self._integrals(start, rays) / len(_FINE)
        views = out.reshape(geometry.n_views, rows, cols)
        return (views + np.random.default_rng(seed).normal(0, noise * views.max(), views.shape)).astype(np.float32)

    def _integrals(self, start: NDArray[np.float64], rays: NDArray[np.float64]) -> NDArray[np.float64]:
        total = np.zeros(len(rays))
        for centre, inverse, density in zip(self.centre, self.inverse, self.density, strict=True):
            o, d = (start - centre) @ inverse.T, rays @ inverse.T
            dd, od = np.einsum("ri,ri->r", d, d), np.einsum("ri,ri->r", o, d)
            left = od**2 - dd * (np.einsum("ri,ri->r", o, o) - 1)
            total += density * 2 * np.sqrt(np.maximum(left, 0)) / dd
        return total

    def volume(self, grid: Grid) -> NDArray[np.float32]:
        """Densities [z, y, x], the mean of eight points of each voxel."""
        out = np.zeros(grid.shape)
        z, y, x = grid.coordinates()
        for fine in np.ndindex(2, 2, 2):
            dz, dy, dx = (np.array(fine) - 0.5) / 2 * grid.spacing
            points = np.stack(np.meshgrid(z + dz, y + dy, x + dx, indexing="ij")[::-1], axis=-1)
            for centre, inverse, density in zip(self.centre, self.inverse, self.density, strict=True):
                out += density / 8 * (np.linalg.norm((points - centre) @ inverse.T, axis=-1) <= 1)
        return out.astype(np.float32)


def balls(radius: float, height: float, seed: int = 0, count: int = 30) -> Bodies:
    """Balls in a cylinder of this radius and height in mm; they extend beyond its ends."""
    rng = np.random.default_rng(seed)
    away, turn = 0.85 * radius * np.sqrt(rng.random(count)), 2 * np.pi * rng.random(count)
    centre = np.stack((away * np.cos(turn), away * np.sin(turn), (rng.random(count) - 0.5) * height), axis=1)
    size = radius * rng.uniform(0.06, 0.2, count)
    return Bodies(centre, np.eye(3) / size[:, None, None], rng.uniform(0.5, 1.5, count) / radius)


def sponge(radius: float, height: float, seed: int = 0, count: int = 40) -> Bodies:
    """A body with oblong pores and grains, wider than deep, and longer than the height of the field of view."""
    rng = np.random.default_rng(seed)
    away, turn = 0.6 * radius * np.sqrt(rng.random(count)), 2 * np.pi * rng.random(count)
    centre = np.stack((away * np.cos(turn), 0.75 * away * np.sin(turn), (rng.random(count) - 0.5) * height), axis=1)
    size = radius * rng.uniform(0.05, 0.16, (count, 3))
    turned = Rotation.random(count, random_state=seed).as_matrix()
    inverse = np.einsum("bi,bij->bij", 1 / size, turned)
    density = np.where(rng.random(count) < 0.6, -1.0, 1.2) / radius
    body = np.diag(1 / np.array([0.9 * radius, 0.7 * radius, 1.2 * height]))
    return Bodies(
        np.concatenate(([[0.02 * radius, -0.03 * radius, 0]], centre)),
        np.concatenate((body[None], inverse)),
        np.concatenate(([1 / radius], density)),
    )
