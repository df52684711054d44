"""The methods of the benchmark: ours and other packages, each with its default and other values of its main setting.

A volume is [z, y, x] in 1/pixel. The second axis of other packages' volumes has the opposite direction to ours. A
setting that does not support a geometry on the CPU raises NotImplementedError.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import recon
from recon.base.geometry import Geometry
from recon.base.method import Method
from recon.warm_up import warm_up
from tests.bench.quality_cases import Case

F32 = NDArray[np.float32]
Value = Any  # value of a method's main setting, a number or a name; None: the default
DEFAULT = "default"
WEIGHTS = 1e-4, 3e-4, 1e-3, 3e-3, 1e-2, 3e-2
THRESHOLDS = 0.01, 0.02, 0.04, 0.08


@dataclass(frozen=True)
class Competitor:
    """A program and its reconstruction method.

    Attributes:
        settings: functions that make the volume of a case, by the label of the setting, the default first.
        module: module that must be installed.
        slice_by_slice: True: slices are independent, so that a few of them suffice for quality and time.
        compiles: True: the first volume of a shape includes compilation and does not count.
        prepare: called before the time is measured.
    """

    settings: Mapping[str, Callable[[Case], F32]]
    module: str = "recon"
    slice_by_slice: bool = False
    compiles: bool = False
    prepare: Callable[[Case], None] = field(default=lambda case: None)

    @property
    def default(self) -> str:
        return next(iter(self.settings))

    @property
    def is_installed(self) -> bool:
        return find_spec(self.module) is not None


def off_middle(geometry: Geometry) -> float:
    """Columns from the middle of the detector to the rotation axis."""
    return geometry.axis_col - (geometry.detector_shape[1] - 1) / 2


def _ours(*methods: tuple[str, Method]) -> Competitor:
    def make(method: Method) -> Callable[[Case], F32]:
        def volume(case: Case) -> F32:
            use = recon.DataUse(case.weights)
            made = recon.reconstruct(case.projections, case.geometry, method, grid=case.grid, use=use)
            return made.volume.data * np.float32(case.geometry.sample_pitch)

        return volume

    def prepare(case: Case) -> None:
        for _, method in methods:
            warm_up(method, case.geometry, weighted=case.weights is not None)

    return Competitor({label: make(method) for label, method in methods}, prepare=prepare)


def _by_slices(make: Callable[[F32, Geometry], F32], axis_off: bool = False) -> Callable[[Case], F32]:
    """`make` turns line integrals [view, col] into a slice; `axis_off`: also with the axis off the middle."""

    def volume(case: Case) -> F32:
        geometry = case.geometry
        if geometry.is_cone or not (axis_off or abs(off_middle(geometry)) < 1e-6):
            raise NotImplementedError
        return np.stack([make(np.ascontiguousarray(row), geometry) for row in case.projections.swapaxes(0, 1)])[:, ::-1]

    return volume


def _iradon(views: F32, geometry: Geometry) -> F32:
    from skimage.transform import iradon

    return np.asarray(iradon(views.T, np.rad2deg(geometry.angles)), np.float32)


def _iradon_sart(sweeps: int) -> Callable[[Case], F32]:
    def volume(views: F32, geometry: Geometry) -> F32:
        from skimage.transform import iradon_sart

        image = None
        for _ in range(sweeps):
            image = iradon_sart(views.T, np.rad2deg(geometry.angles), image=image, clip=(0, np.inf))
        return np.asarray(image, np.float32)

    return _by_slices(volume)


def _within(volume: F32, side: int) -> F32:
    """The middle part of wider slices [z, y, x]."""
    first = (volume.shape[2] - side) // 2
    return volume[:, first : first + side, first : first + side]


def _wider(side: int, by: float) -> int:
    """The width of wider slices; the difference is even."""
    return side + 2 * round((by - 1) * side / 2)


def _astra(algorithm: str, iterations: int = 1, widen: float = 1) -> Callable[[Case], F32]:
    """`widen`: width of the slices divided by that of the field of view."""

    def volume(views: F32, geometry: Geometry) -> F32:
        import astra

        side, whole = views.shape[1], _wider(views.shape[1], widen)
        plane, beam = (
            astra.create_vol_geom(whole, whole),
            astra.create_proj_geom("parallel", 1.0, side, geometry.angles),
        )
        if off_middle(geometry):
            beam = astra.geom_postalignment(beam, -off_middle(geometry))
        projector = astra.create_projector("linear", beam, plane)
        data, image = astra.data2d.create("-sino", beam, views), astra.data2d.create("-vol", plane)
        what = {**astra.astra_dict(algorithm), "ProjectorId": projector, "ProjectionDataId": data}
        what |= {"ReconstructionDataId": image, "option": {"MinConstraint": 0.0} if algorithm == "SIRT" else {}}
        run = astra.algorithm.create(what)
        astra.algorithm.run(run, iterations)
        found = astra.data2d.get(image)
        astra.clear()
        return _within(np.asarray(found, np.float32)[None], side)[0]

    return _by_slices(volume, axis_off=algorithm != "FBP")


def _svmbir(widen: float = 1, **settings: float) -> Callable[[Case], F32]:
    """`widen`: width of the slices divided by that of the field of view; svmbir's own way to treat a wider sample."""

    def volume(case: Case) -> F32:
        import svmbir

        if case.geometry.is_cone:
            raise NotImplementedError
        side = case.geometry.detector_shape[1]
        whole, threads = _wider(side, widen), int(os.environ.get("OMP_NUM_THREADS", 2))
        # a new folder, because it stores system matrices of earlier scans
        with tempfile.TemporaryDirectory() as folder:
            found = svmbir.recon(
                case.projections, case.geometry.angles, weights=case.weights, center_offset=off_middle(case.geometry),
                num_rows=whole, num_cols=whole, num_threads=threads, verbose=0, svmbir_lib_path=folder, **settings,
            )  # fmt: skip
        return _within(np.asarray(found, np.float32).swapaxes(1, 2)[:, ::-1], side)

    return volume


def _mbirjax(**settings: float) -> Callable[[Case], F32]:
    """In pixels of the detector."""

    def volume(case: Case) -> F32:
        import mbirjax

        geometry, grid = case.geometry, case.grid
        if not geometry.is_cone:
            raise NotImplementedError  # the same method as svmbir, by the same authors, but slower
        distances = geometry.sdd / geometry.pixel_pitch, geometry.sod / geometry.pixel_pitch
        np.random.seed(0)  # noqa: NPY002 - the order of its updates
        model = mbirjax.ConeBeamModel(case.projections.shape, geometry.angles, *distances)
        depth, height, width = grid.shape
        model.set_params(
            no_warning=True, recon_shape=(height, width, depth), delta_voxel=grid.voxel_size / geometry.pixel_pitch
        )
        model.set_params(no_warning=True, **settings)
        found, _ = model.recon(case.projections, print_logs=False, logfile_path=None)
        scale = geometry.sample_pitch / geometry.pixel_pitch
        return np.moveaxis(np.asarray(found, np.float32), 2, 0)[:, ::-1] * np.float32(scale)

    return volume


def _mbir_parallel(module: str, widen: float = 1, **settings: float) -> Callable[[Case], F32]:
    """mbirjax or mbirtorch, by the authors of svmbir, for a parallel beam; `widen` as for svmbir."""

    def volume(case: Case) -> F32:
        if case.geometry.is_cone or case.grid.shape[1] != case.geometry.detector_shape[1]:
            raise NotImplementedError
        (rows, side), whole = case.geometry.detector_shape, _wider(case.geometry.detector_shape[1], widen)
        np.random.seed(0)  # noqa: NPY002 - the order of its updates
        model = import_module(module).ParallelBeamModel(case.projections.shape, case.geometry.angles)
        offset = off_middle(case.geometry)
        model.set_params(no_warning=True, recon_shape=(whole, whole, rows), det_channel_offset=offset, **settings)
        found, _ = model.recon(case.projections, weights=case.weights, print_logs=False, logfile_path=None)
        return _within(np.moveaxis(np.asarray(found, np.float32), 2, 0)[:, ::-1], side)

    return volume


def _corrct(weight: float | None, iterations: int) -> Callable[[Case], F32]:
    """corrct, with scikit-image's projector if there is no CUDA."""

    def volume(views: F32, geometry: Geometry) -> F32:
        from corrct import projectors, regularizers, solvers

        side = views.shape[1]
        solver = solvers.SIRT() if weight is None else solvers.PDHG(regularizer=regularizers.Regularizer_TV2D(weight))
        with projectors.ProjectorUncorrected((side, side), geometry.angles) as beam:
            return np.asarray(solver(beam, views, iterations, lower_limit=0.0)[0], np.float32)

    return _by_slices(volume)


LEAGUE: dict[str, Competitor] = {
    "splatline fbp": _ours(("ram-lak", recon.Fbp(filter="ram-lak")), ("hann", recon.Fbp(filter="hann"))),
    "splatline fista-tv": _ours(
        ("default", recon.FistaTv()), *((f"weight {weight:g}", recon.FistaTv(tv_weight=weight)) for weight in WEIGHTS)
    ),
    "splatline pnp-dct": _ours(
        ("default", recon.PnpDct()),
        *((f"threshold {value:g}", recon.PnpDct(patch_threshold=value)) for value in THRESHOLDS),
    ),
    "splatline discrete": _ours(("default", recon.Discrete())),
    "splatline r2": _ours(("default", recon.R2())),
    "splatline auto": _ours(("default", recon.Auto())),
    "scikit-image": Competitor(
        {"iradon": _by_slices(_iradon), **{f"iradon_sart {n}": _iradon_sart(n) for n in (1, 3, 10)}},
        module="skimage",
        slice_by_slice=True,
    ),
    "ASTRA": Competitor(
        {"FBP": _astra("FBP"), **{f"SIRT {n}": _astra("SIRT", n) for n in (50, 100, 200)}},
        module="astra",
        slice_by_slice=True,
    ),
    "svmbir": Competitor(
        {"default": _svmbir(), **{f"sharpness {value:g}": _svmbir(sharpness=value) for value in (1, 2)}},
        module="svmbir",
    ),
    "mbirjax": Competitor(
        {"default": _mbirjax(), **{f"sharpness {value:g}": _mbirjax(sharpness=value) for value in (1, 2)}},
        module="mbirjax",
        compiles=True,
    ),
    "corrct": Competitor(
        {"SIRT 50": _corrct(None, 50), "SIRT 100": _corrct(None, 100), "PDHG, TV 0.3": _corrct(0.3, 50)},
        module="corrct",
        slice_by_slice=True,
    ),
}


class Entrant(NamedTuple):
    """A method in tests.bench.first_users.

    Attributes:
        of: function that gives the competitor for a value of its main setting and a sample width (divided by the
            field).
        setting: name of the main setting.
        at: function that gives value k of the search, in order; None: there is no further value.
        wide_alone: True: takes part only if the sample is wider than the field.
    """

    of: Callable[[Value, float], Competitor]
    setting: str = ""
    at: Callable[[int], Value] = lambda k: DEFAULT if k == 0 else None
    wide_alone: bool = False


def _own(method: Callable[[Value], Method]) -> Callable[[Value, float], Competitor]:
    return lambda value, over: _ours((DEFAULT, method(value)))


def _of_peer(
    module: str, make: Callable[..., Callable[[Case], F32]], wide: bool, compiles: bool = False
) -> Callable[[Value, float], Competitor]:
    def of(value: Value, over: float) -> Competitor:
        settings = {} if value is None else {"sharpness": value}
        return Competitor({DEFAULT: make(widen=over if wide else 1.0, **settings)}, module, compiles=compiles)

    return of


def _sirt(wide: bool) -> Callable[[Value, float], Competitor]:
    def of(value: Value, over: float) -> Competitor:
        iterations = 100 if value is None else round(float(value))
        return Competitor({DEFAULT: _astra("SIRT", iterations, over if wide else 1.0)}, "astra", slice_by_slice=True)

    return of


def _fbp(value: Value) -> Method:
    return recon.Fbp() if value is None else recon.Fbp(filter=value)


def _mbir(module: str) -> Callable[..., Callable[[Case], F32]]:
    return lambda **settings: _mbir_parallel(module, **settings)


def _peers() -> Iterator[tuple[str, Entrant]]:
    for wide in (False, True):
        end = " wide" if wide else ""
        yield f"svmbir{end}", Entrant(_of_peer("svmbir", _svmbir, wide), "sharpness", lambda k: k or DEFAULT, wide)
        for module in ("mbirtorch", "mbirjax"):
            of = _of_peer(module, _mbir(module), wide, compiles=True)
            yield f"{module}{end}", Entrant(of, "sharpness", lambda k: 1.0 + k if k else DEFAULT, wide)
        yield f"sirt{end}", Entrant(_sirt(wide), "iterations", lambda k: round(100 * 2**k) if k else DEFAULT, wide)


ENTRANTS: dict[str, Entrant] = {
    "fbp": Entrant(_own(_fbp), "filter", {0: DEFAULT, 1: "shepp-logan", 2: "ram-lak"}.get),
    "fista-tv": Entrant(_own(lambda value: recon.FistaTv(tv_weight=value)), "weight", lambda k: 1e-3 * 2**k),
    "pnp-dct": Entrant(_own(lambda value: recon.PnpDct(patch_threshold=value)), "threshold", lambda k: 0.04 * 2**k),
    "discrete": Entrant(_own(lambda value: recon.Discrete())),
    "r2": Entrant(_own(lambda value: recon.R2())),
    "auto": Entrant(_own(lambda value: recon.Auto())),
    **dict(_peers()),
}
"""The entrants of tests.bench.first_users, in the order of its tables."""
