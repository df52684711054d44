"""warm_up: compiles every kernel of a method on a small example, before a reconstruction is timed."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
from numba.core import event

from recon.base.arrays import F32
from recon.base.geometry import Geometry, arrays_of
from recon.base.method import DataUse, Method
from recon.base.method_kinds import Series
from recon.base.volume import Grid
from recon.methods import DEFAULT, by_name
from recon.reconstruction import reconstruct
from recon.splatting.fit_method import Fit
from recon.voxels.back_project import compile_gridding
from recon.voxels.fbp import is_gridded
from recon.voxels.view_weights import missing_arc

_SHAPE, _VIEWS = (12, 16), 4
_SEVERAL = 12  # factor on the number of projections, for methods that make several volumes
_LEAN, _SHIFT = 0.1, 0.3  # radians; pixels
_RECONSTRUCTED: set[tuple[object, ...]] = set()
"""The small examples (method and geometry) whose kernels this process has already loaded."""


def warm_up(
    method: Method | None = None,
    geometry: Geometry | None = None,
    *,
    device: str = "cpu",
    weighted: bool = False,
    on_kernel: Callable[[int], None] | None = None,
) -> None:
    """Compile all kernels of a method by reconstructing a small example.

    For a fit, this takes 1 to 2 minutes the first time on a machine, and a fraction of a second each later time. A
    process reconstructs each example once. numba stores compiled kernels next to the package (or in the user's cache
    folder), once for each kind of processor.

    Kernels for another kind of geometry, first volume or ray are compiled only if they are needed. Tilted projections,
    a cone or weights add a sixth of the time. The start "tv" adds a third, and a short cone scan with exact rays adds
    two thirds.

    Args:
        method: the method with the settings of the later run; None: the default method with its default settings.
        geometry: geometry of the later run; None: a parallel beam without roll and tilt.
        weighted: True if the rays have weights, or values that are not finite.
        on_kernel: function called after each compiled function, with the number of functions compiled so far. It is
            never called if all kernels are cached.

    Raises:
        ValueError: the method cannot use such projections.
    """
    method = method or by_name(DEFAULT)()
    if geometry is not None:
        method.views_wanted(
            geometry
        )  # with this geometry, an error states the missing degrees of the later run, not those of the example
    data, views = toy_of(geometry, _SEVERAL if isinstance(method, Series) else 1)
    stated_key = str([value.tolist() for value in arrays_of(views).values()])
    with counted(on_kernel or (lambda n: None)):
        # A fit may end with PnP-DCT steps.
        for warmed in (method, by_name("pnp-dct")()) if isinstance(method, Fit) else (method,):
            toy = warmed.toy()
            if (key := (type(toy), repr(toy), stated_key, device, weighted)) not in _RECONSTRUCTED:
                _reconstruct_silently(toy, data, views, device, weighted)
                _RECONSTRUCTED.add(key)
        if geometry is not None and is_gridded(geometry, Grid.matching(geometry), "hann"):
            compile_gridding()


def _reconstruct_silently(toy: Method, data: F32, views: Geometry, device: str, weighted: bool) -> None:
    """Reconstruct a small example, without warnings."""
    weights = None
    if weighted:
        weights = np.ones(data.shape, np.float32)
        weights[::2, 3, 4] = 0  # projections with and without weight 0 use different code
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        reconstruct(data, views, toy, device=device, use=DataUse(weights))


@contextmanager
def counted(on_kernel: Callable[[int], None]) -> Iterator[None]:
    """Call `on_kernel` after each compiled function, with the number of functions compiled so far."""

    class Counter(event.Listener):
        n = 0

        def on_start(self, compilation: Any) -> None:
            pass

        def on_end(self, compilation: Any) -> None:
            self.n += 1
            on_kernel(self.n)

    with event.install_listener("numba:compile", Counter()):
        yield


def toy_of(geometry: Geometry | None = None, times: int = 1) -> tuple[F32, Geometry]:
    """Line integrals [view, row, col] of a Gaussian in four small projections, and their geometry. They run the same
    kernels as `geometry`.

    The four projections have the same beam, roll, tilt and shifts as `geometry`. They cover 360° if `geometry` does.
    The four projections are repeated `times` times.
    """
    views_once = views = _views_like(geometry)
    for _ in range(times - 1):
        views = views.followed_by(views_once)
    width, density = _blob(views_once)
    rows, cols = (np.arange(n) for n in views_once.detector_shape)
    col, row = np.array([views_once.origin(view) for view in range(views_once.n_views)]).T[:, :, None]
    u, v = (cols - col) * views_once.pixel_pitch, (rows - row) * views_once.pixel_pitch
    from_axis = u[:, None, :] ** 2 + v[:, :, None] ** 2  # mm² at the point where the ray meets the detector
    if views_once.is_cone:  # mm² at the point where the ray passes the origin
        from_axis *= views_once.sod**2 / (views_once.sdd**2 + from_axis)
    lines = density * width * np.sqrt(2 * np.pi) * np.exp(-from_axis / (2 * width**2))
    return np.tile(lines.astype(np.float32), (times, 1, 1)), views


def _views_like(geometry: Geometry | None) -> Geometry:
    if geometry is None or not geometry.is_cone:
        views = Geometry.parallel(np.linspace(0, np.pi, _VIEWS, endpoint=False), _SHAPE)
    else:
        arc = 2 * np.pi if missing_arc(geometry) == 0 else np.pi
        pitch = geometry.pixel_pitch * geometry.detector_shape[1] / _SHAPE[1]  # the same field of view
        angles = np.linspace(0, arc, _VIEWS, endpoint=False)
        views = Geometry.cone(angles, _SHAPE, pitch, geometry.sod, geometry.sdd)
    if geometry is not None:
        leaning = (geometry.roll != 0) | (geometry.tilt != 0) | geometry.centres.any(axis=1)
        # If only some projections of `geometry` are tilted, only some are tilted here.
        tilt = np.where(np.arange(_VIEWS) % 2 == 0, _LEAN * leaning.any(), _LEAN * leaning.all())
        views = replace(views, tilt=tilt, shifts=np.full((_VIEWS, 2), _SHIFT * geometry.shifts.any()))
    return views


def _blob(views: Geometry) -> tuple[float, float]:
    """Standard deviation in mm and density in 1/mm of a Gaussian at the origin."""
    width = 2 * views.sample_pitch
    return width, 0.2 / width
