"""After warm_up no kernel of a fit of the same kind is compiled or loaded any more."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numba
import numpy as np
import pytest

from recon import warm_up as module
from recon.base.geometry import Geometry
from recon.voxels.direct import Fbp
from recon.voxels.view_weights import missing_arc
from recon.warm_up import toy_of, warm_up

# In a process of its own: here, other tests have compiled most of it. All kernels that numba knows of are counted.
_SCRIPT = """
import gc
import numpy as np
import recon
from recon.splatting.settings import FitSettings
from recon.base.kernel import RayModel
from recon.warm_up import warm_up

def compiled():
    kernels = [o for o in gc.get_objects() if type(o).__name__ == "CPUDispatcher"]
    return {id(k): (k.py_func.__qualname__, len(k.signatures)) for k in kernels if "recon" in k.py_func.__module__}

shape = (10, 20)
loss, rays, start, weighted = "l1", RayModel(), "fbp", False
SETTING
rows, cols = (np.arange(n) - (n - 1) / 2 for n in shape)
blob = np.exp(-(rows[:, None] ** 2 + cols**2) / 18)
data = np.tile(blob.astype(np.float32), (views.n_views, 1, 1))
weights = None
if weighted:
    weights = np.ones(data.shape, np.float32)
    weights[2, 3:5, 4:9] = 0
method = recon.R2(steps=120, gaussians=60, start=start, fit=FitSettings(loss=loss, rays=rays))
warm_up(WARM)
before = compiled()
assert sum(n for _, n in before.values()) > 10, before
recon.reconstruct(data, views, method, use=recon.DataUse(weights))
late = sorted(name for key, (name, n) in compiled().items() if n != before.get(key, ("", 0))[1])
print("late:", *late)
"""
_KINDS = {
    "parallel, some views lean, all are shifted, weights": """
loss, start, weighted = "poisson", "tv", True
tilt = [0, 0, 0, 0.05, 0.05, 0]
views = recon.Geometry.parallel(np.linspace(0, 3, 6), shape, pixel_pitch=0.5, tilt=tilt, shifts=np.full((6, 2), 0.7))
""",
    "cone, a short scan, rolled, exact rays": """
loss, rays = "l2", RayModel(exact_above=1e-4)
views = recon.Geometry.cone(np.linspace(0, 2.8, 12), shape, 0.2, 20.0, 40.0, roll=0.02)
""",
}


_OF_THE_FIT = "method, views, weighted=weighted"
_OF_A_PARALLEL_BEAM = "recon.R2(fit=FitSettings(loss=loss))"
_EXACT = "cone, a short scan, rolled, exact rays"
_LEANING = "parallel, some views lean, all are shifted, weights"


def _late(kind: str, warm: str) -> list[str]:
    """Kernels that a fit still has to compile, or to load from the cache, after `warm_up(<warm>)`."""
    code = _SCRIPT.replace("SETTING", _KINDS[kind]).replace("WARM", warm)
    root = Path(__file__).parents[2]
    done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout.removeprefix("late:").split()


@pytest.mark.slow
@pytest.mark.parametrize("kind", [_LEANING, pytest.param(_EXACT, marks=pytest.mark.long)])
def test_a_fit_after_warm_up_compiles_nothing(kind: str) -> None:
    assert _late(kind, _OF_THE_FIT) == []


@pytest.mark.slow
def test_a_cones_fit_would_compile_after_a_warm_up_for_a_parallel_beam() -> None:
    """That is, the count above sees what it should see."""
    found = _late(_EXACT, _OF_A_PARALLEL_BEAM)
    assert any("_forward.<locals>.kernel" in name for name in found) and "_bend" in found


def test_too_short_a_scan_is_refused_by_its_own_degrees() -> None:
    views = Geometry.cone(np.deg2rad(np.arange(0.0, 100)), (24, 48), 0.06, 5.0, 7.0)
    lacking = np.rad2deg(missing_arc(views))
    assert 100 < lacking < 105
    with pytest.raises(ValueError, match=f"{lacking:.4g} degrees"):
        warm_up(Fbp(), views)


def test_half_a_turn_of_a_parallel_beam_that_lacks_views_is_taken() -> None:
    warm_up(Fbp(), Geometry.parallel(np.linspace(0, 0.9 * np.pi, 20), (4, 16), pixel_pitch=0.1))


@pytest.mark.parametrize("turn", [2 * np.pi, 3.6, 3.3])
def test_a_toy_is_of_the_same_kind(turn: float) -> None:
    angles = np.linspace(0, turn, 50, endpoint=False)
    cone = Geometry.cone(
        angles, (100, 200), 0.1, 30.0, 90.0, axis_col=80.0, shifts=np.ones((50, 2)), tilt=np.full(50, 0.01)
    )
    data, toy = toy_of(cone)
    assert toy.is_cone and (missing_arc(toy) > 0) == (missing_arc(cone) > 0) == (turn < 3.4)
    assert (toy.tilt != 0).all() and toy.shifts.any()
    assert data.shape == (toy.n_views, *toy.detector_shape) and data.max() > 0.1
    assert toy.sample_pitch * toy.detector_shape[1] == pytest.approx(cone.sample_pitch * 200)  # as wide a cone
    _, plain = toy_of()
    assert not plain.is_cone and plain.is_straight and not plain.shifts.any()


def test_it_counts_what_it_compiles(monkeypatch: pytest.MonkeyPatch) -> None:
    def compiles(*_: object, **__: object) -> None:
        for _time in range(2):
            numba.njit(lambda x: x + 1)(1.0)

    monkeypatch.setattr(module, "reconstruct", compiles)
    counted: list[int] = []
    cone = Geometry.cone(np.linspace(0, 6, 12), (10, 20), 0.2, 31.7, 40.0)  # which no other test warms up for
    warm_up(geometry=cone, on_kernel=counted.append)
    assert counted == [1, 2, 3, 4]  # of the fit, and of the patches that may make its volume
    warm_up(geometry=cone, on_kernel=counted.append)
    assert counted == [1, 2, 3, 4]  # once in a process
