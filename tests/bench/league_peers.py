"""Who plays in the league: our methods and peers, each by default first, then by other values of its main setting.

A volume is [z, y, x] in 1/pixel. The second axis of the peers' volumes runs against ours. A setting that does not take
a geometry on the CPU raises NotImplementedError.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib.util import find_spec

import numpy as np
from numpy.typing import NDArray

import recon
from recon.base.geometry import Geometry
from recon.base.method import Method
from recon.warm_up import warm_up
from tests.bench.quality_cases import Case

F32 = NDArray[np.float32]
WEIGHTS = 1e-4, 3e-4, 1e-3, 3e-3, 1e-2, 3e-2


@dataclass(frozen=True)
class Competitor:
    """A program with a way to reconstruct.

    Attributes:
        settings: by what distinguishes them, the default first; each makes the volume of a case.
        module: that must be installed.
        slice_by_slice: slices do not know each other, so that some of them tell quality and time of all.
        compiles: the first volume compiles for its shape, and does not count.
        prepare: is called before time is taken.
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


def _astra(algorithm: str, iterations: int = 1) -> Callable[[Case], F32]:
    def volume(views: F32, geometry: Geometry) -> F32:
        import astra

        side = views.shape[1]
        plane, beam = astra.create_vol_geom(side, side), astra.create_proj_geom("parallel", 1.0, side, geometry.angles)
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
        return np.asarray(found, np.float32)

    return _by_slices(volume, axis_off=algorithm != "FBP")


def _svmbir(**settings: float) -> Callable[[Case], F32]:
    def volume(case: Case) -> F32:
        import svmbir

        if case.geometry.is_cone:
            raise NotImplementedError
        with tempfile.TemporaryDirectory() as folder:  # system matrices of earlier scans
            found = svmbir.recon(
                case.projections, case.geometry.angles, weights=case.weights, center_offset=off_middle(case.geometry),
                num_threads=2, verbose=0, svmbir_lib_path=folder, **settings,
            )  # fmt: skip
        return np.asarray(found, np.float32).swapaxes(1, 2)[:, ::-1]

    return volume


def _mbirjax(**settings: float) -> Callable[[Case], F32]:
    """In pixels of the detector."""

    def volume(case: Case) -> F32:
        import mbirjax

        geometry, grid = case.geometry, case.grid
        if not geometry.is_cone:
            raise NotImplementedError  # as svmbir, of the same authors, but slower
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


def _corrct(weight: float | None, iterations: int) -> Callable[[Case], F32]:
    """By scikit-image's projector where there is no CUDA."""

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
