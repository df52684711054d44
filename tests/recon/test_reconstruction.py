"""The public call: both methods are better than the baseline, and bad input is an error."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import recon
import recon.splatting.initialise
from recon import R2, DataUse, Fbp, RunControl
from recon.assess.metrics import psnr
from recon.axis_held_out import axis_by_views
from recon.base.geometry import Geometry
from recon.base.view_data import Views
from recon.methods import accepting, build, by_name, names_of_one_volume
from recon.voxels.beyond_field import whole_reach
from simulators.frame.shot import Detector
from simulators.samples.bodies.phantom import Phantom
from tests.messages import refused
from tests.recon.few_views import ANGLES, GRID, PITCH, SHAPE, VIEWS
from tests.refused_calls import refused_calls
from tests.slow_cases import others_slow


def test_few_noisy_views_beat_fbp(phantom: Phantom, noisy: np.ndarray) -> None:
    truth = phantom.attenuation(GRID)
    best = max(
        psnr(truth, recon.reconstruct(noisy, VIEWS, Fbp(name)).volume.data)
        for name in ("ram-lak", "shepp-logan", "hann")
    )
    result = recon.reconstruct(noisy, VIEWS, R2(steps=250, gaussians=2000))
    assert psnr(truth, result.volume.data) > best + 1
    assert result.volume.data.shape == GRID.shape and result.volume.data.dtype == np.float32
    assert result.history[-1].step == 250 and result.gaussians is not None
    assert result.settings["seed"] == 0


def test_another_seed_gives_another_volume(noisy: np.ndarray) -> None:
    fit = R2(steps=10, gaussians=300, finish=0)
    one, other = (recon.reconstruct(noisy, VIEWS, fit, seed=seed).volume.data for seed in (4, 5))
    assert not np.array_equal(one, other)


@pytest.mark.slow
def test_a_small_box_equals_that_part_of_the_whole_volume(noisy: np.ndarray) -> None:
    # The matter outside the box is in the views, so it must be in the model.
    z, y, x = GRID.coordinates()
    box = recon.Grid((6, 12, 10), PITCH, centre=(float(z[9:15].mean()), float(y[20:32].mean()), float(x[5:15].mean())))
    fit = R2(steps=60, finish=0)
    whole, part = (recon.reconstruct(noisy, VIEWS, fit, grid=grid).volume.data for grid in (GRID, box))
    np.testing.assert_allclose(part, whole[9:15, 20:32, 5:15], atol=1e-3 * whole.max())


@pytest.mark.parametrize(
    "kind",
    [
        lambda a: torch.from_numpy(a.astype(np.float64)).requires_grad_(),
        lambda a: np.asfortranarray(a),
        lambda a: np.repeat(a, 2, axis=2)[:, :, ::2],
        lambda a: a.astype(np.float64).tolist(),
    ],
)
def test_any_kind_of_array_gives_the_same_volume(noisy: np.ndarray, kind: Callable[[np.ndarray], object]) -> None:
    found, expected = (recon.reconstruct(each, VIEWS, "fbp").volume.data for each in (kind(noisy), noisy))  # type: ignore[arg-type]
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"method": "magic"}, "method 'magic' is unknown; legal: r2, .*fbp, "),
        ({"projections": np.zeros((3, 20, 40))}, "to match the geometry"),
        ({"projections": np.full((24, 20, 40), np.nan)}, r"no usable value\. A usable value is finite"),
        ({"projections": np.full((24, 20, 40), 1e300)}, r"no usable value\. A usable value is finite"),
        ({"projections": np.ones((24, 20, 40), complex)}, "real numbers"),
        ({"projections": np.zeros((24, 20, 40))}, "no material"),
        ({"method": R2(early_stop=True)}, "needs held-out projections"),
        ({"use": DataUse(held_out=(24,))}, "projection numbers 0 to 23"),
        ({"use": DataUse(held_out=tuple(range(24)))}, "no projection is left"),
        ({"control": RunControl(resume={})}, "not the checkpoint"),
        ({"device": "abacus"}, "got 'abacus'"),
        ({"seed": -1}, "seed"),
        ({"geometry": VIEWS.at(np.pi * np.arange(24) + 0.3)}, "got only one direction"),
        ({"geometry": replace(VIEWS, axis_col=60.0)}, "column 60, is outside the detector's columns 0 to 39, .*crop"),
        ({"geometry": replace(VIEWS, axis_col=-0.6)}, "columns 0 to 39"),
    ],
)
def test_bad_input_is_refused(noisy: np.ndarray, change: dict[str, object], message: str) -> None:
    arguments = {"projections": noisy, "geometry": VIEWS} | change
    with pytest.raises(ValueError, match=message):
        recon.reconstruct(**arguments)  # type: ignore[arg-type]


OF_A_FIT: dict[str, dict[str, object]] = {
    "held_out": {"use": DataUse(held_out=(3,))},
    "times": {"use": DataUse(times=np.arange(VIEWS.n_views, dtype=np.float64))},
    "resume": {"control": RunControl(resume={})},
    "on_checkpoint": {"control": RunControl(on_checkpoint=print)},
    "device 'cuda'": {"device": "cuda"},
}


OF_FITS = r"\(of r2, r2-published\)"
ON_DEVICES = r"\(of r2, fista-tv, pnp-dct, discrete, r2-published"
OWNERS = {
    "times": r"\(of series\)", "device 'cuda'": ON_DEVICES,
}  # fmt: skip
MODELS = "r2", "r2-published"


@pytest.mark.parametrize("method", [name for name in names_of_one_volume() if name not in MODELS])
def test_no_argument_silently_does_nothing(noisy: np.ndarray, method: str) -> None:
    for name, argument in OF_A_FIT.items():
        if "device" in name and method in accepting("device"):
            continue
        with pytest.raises(ValueError, match=rf"method '{method}' has no option {name} {OWNERS.get(name, OF_FITS)}"):
            recon.reconstruct(noisy, VIEWS, method, **argument)  # type: ignore[arg-type]


def test_all_that_does_not_go_together_is_said_at_once(noisy: np.ndarray) -> None:
    with pytest.raises(ValueError, match=rf"held_out {OF_FITS}, on_checkpoint {OF_FITS}"):
        recon.reconstruct(
            noisy, VIEWS, "sirt", use=DataUse(held_out=(3,)), control=RunControl(on_checkpoint=print)
        )  # fmt: skip


@pytest.mark.parametrize(
    ("method", "iterations", "margin"),
    others_slow([("fista-tv", 10, 3.0), ("sirt", 40, 1.0), ("sart", 8, 0.0), ("cgls", 8, 0.5), ("asd-pocs", 8, 1.0),
                 ("os-sirt-tv", 16, 3.0)]),
)  # fmt: skip
def test_classical_methods_by_the_same_call_beat_fbp(
    phantom: Phantom, noisy: np.ndarray, method: str, iterations: int, margin: float
) -> None:
    truth = phantom.attenuation(GRID)
    baseline = psnr(truth, recon.reconstruct(noisy, VIEWS, "fbp").volume.data)
    seen: list[int] = []
    chosen = build(by_name(method), {"iterations": iterations})
    result = recon.reconstruct(
        noisy, VIEWS, chosen, control=RunControl(on_progress=lambda p: None if p.unit else seen.append(p.step))
    )
    assert psnr(truth, result.volume.data) > baseline + margin
    assert seen == list(range(1, iterations + 1)) and result.history[-1].residual < 0.2
    assert result.gaussians is None and result.settings["iterations"] == iterations


def test_tilted_views_half_a_turn_apart_are_two_sides(noisy: np.ndarray) -> None:
    views = recon.Geometry.parallel([0.0, np.pi], SHAPE, pixel_pitch=PITCH, axis_col=18.3, tilt=0.3)
    with pytest.warns(UserWarning, match="is tilted along the beam"):
        made = recon.reconstruct(noisy[[0, 0]], views, R2(steps=2, gaussians=200), grid=GRID)
    assert np.isfinite(made.volume.data).all()
    with refused(ValueError):
        recon.reconstruct(noisy[[0, 0]], views.at([0.3, 0.3 + 2 * np.pi]), grid=GRID)


def test_one_view_is_refused(noisy: np.ndarray) -> None:
    with refused(ValueError):
        recon.reconstruct(noisy[:1], VIEWS.select([0]))


@pytest.mark.parametrize("method", ["fbp", "fista-tv", recon.Auto()])
def test_line_integrals_beyond_any_are_refused_with_their_size(noisy: np.ndarray, method: str) -> None:
    with refused(ValueError):
        recon.reconstruct(noisy * np.float32(1e20), VIEWS, method)


def test_masked_values_are_as_those_that_are_not_finite_or_refused(noisy: np.ndarray) -> None:
    hole = np.zeros(noisy.shape, bool)
    hole[:, :, 20:22] = True
    masked = np.ma.array(np.where(hole, 0, noisy), mask=hole)
    unseen, nothing_masked = np.where(hole, np.nan, noisy), np.ma.array(noisy, mask=False)
    with pytest.warns(UserWarning, match="960 of 19200 values .* are not finite"):
        volumes = [recon.reconstruct(each, VIEWS, "fbp").volume.data for each in (masked, [*masked], unseen)]
    assert np.array_equal(volumes[0], volumes[2]) and np.array_equal(volumes[1], volumes[2])
    one, other = (recon.reconstruct(each, VIEWS, "fbp").volume.data for each in (nothing_masked, noisy))
    assert np.array_equal(one, other)
    light, dark = np.round(2e4 * np.exp(-noisy)).astype(np.uint16), np.zeros(SHAPE, np.float32)
    flat = np.full((2, *SHAPE), 2e4, np.float32)
    counted = np.ma.array(np.where(hole, 65535, light), mask=hole)
    assert np.abs(recon.correct(counted, np.arange(24), recon.References(dark, ((0, flat),))).data - noisy).max() < 1.5
    some = np.ma.array(flat, mask=np.broadcast_to(np.arange(40) == 7, flat.shape))
    lost = recon.correct(light, np.arange(24), recon.References(np.ma.array(dark, mask=hole[0]), ((0, some),))).masked
    assert lost[:, [7, 20, 21]].all() and not lost[:, 30].any()
    model = recon.StreamingFit(VIEWS)
    for call in (
        lambda: recon.find_axis(masked, ANGLES),
        lambda: recon.remove_rings(masked, ANGLES),
        lambda: model.add_views(masked, ANGLES),
        lambda: recon.Geometry.parallel(np.ma.array(ANGLES, mask=ANGLES > 1), SHAPE),
        lambda: DataUse(weights=np.ma.array(noisy, mask=hole)),
    ):
        with refused(ValueError):
            call()
    assert model.n_views == 0


def test_degrees_are_told_as_views_come(noisy: np.ndarray) -> None:
    model = recon.StreamingFit(VIEWS, gaussians=100)
    with pytest.warns(UserWarning, match=r"look like degrees.*np\.deg2rad") as told:
        for view, angle in zip(noisy, np.rad2deg(ANGLES), strict=True):
            model.add_views(view[None], [angle])
    assert len(told) == 1 and told[0].filename == __file__  # once
    uneven = np.linspace(0, 180, 23, endpoint=False)
    model = recon.StreamingFit(VIEWS, gaussians=100)
    model.add_views(noisy[:23], uneven)  # part of a scan of many turns could be as wide
    with pytest.warns(UserWarning, match=r"look like degrees"):
        model.finish(0.0)


def test_degrees_and_counts_cause_a_warning_with_advice(noisy: np.ndarray) -> None:
    degrees = recon.Geometry.parallel(np.rad2deg(ANGLES), SHAPE, pixel_pitch=PITCH, axis_col=18.3)
    with pytest.warns(UserWarning, match=r"reach 172\.5 and .*np\.deg2rad"):
        recon.reconstruct(noisy, degrees, "fbp")
    with (
        pytest.warns(UserWarning, match=r"reach 172\.5 and .*np\.deg2rad") as told,
        suppress(ValueError),
    ):
        recon.find_axis(noisy, np.rad2deg(ANGLES))
    assert told[0].filename == __file__  # the line of the caller
    with pytest.warns(UserWarning, match="look like counts.*recon.correct"):
        recon.reconstruct(np.round(2e4 * np.exp(-noisy)), VIEWS, "fbp")


@pytest.mark.parametrize(
    "call",
    [
        lambda light: recon.reconstruct(light, VIEWS, "fbp"),
        lambda light: recon.find_axis(light, ANGLES),
        lambda light: recon.remove_rings(light, ANGLES),
        pytest.param(lambda light: axis_by_views(light, VIEWS), marks=pytest.mark.slow),
    ],
)
def test_transmission_causes_a_warning_with_advice(noisy: np.ndarray, call: Callable[[np.ndarray], object]) -> None:
    light = np.exp(-noisy)
    with pytest.warns(UserWarning, match=r"look like transmission.*-np\.log") as told, suppress(ValueError):
        call(light)
    assert told[0].filename == __file__
    call(-np.log(light))


def test_line_integrals_of_the_other_sign_cause_a_warning(noisy: np.ndarray) -> None:
    """They gave a volume of zeros without a word."""
    for method in ("fista-tv", "fbp"):
        with pytest.warns(UserWarning, match="change the sign.*are below 0"):
            recon.reconstruct(-noisy, VIEWS, method)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        recon.reconstruct(noisy - noisy[::-1], VIEWS, "fbp")  # errors of views have both signs


def test_from_counts_to_a_volume_by_public_names(phantom: Phantom, rng: np.random.Generator) -> None:
    detector = Detector(SHAPE, PITCH, VIEWS.axis_col, (SHAPE[0] - 1) / 2)
    dark, flat = np.full(SHAPE, 100.0), np.full(SHAPE, 20100.0)
    lines = np.stack([phantom.line_integrals(a, detector) for a in ANGLES])
    counts = rng.poisson(100 + 2e4 * np.exp(-lines))
    views = recon.correct(counts, np.arange(len(ANGLES)), recon.References(dark, ((0.0, flat),)))
    assert np.abs(views.data - lines).mean() < 0.01
    assert recon.find_axis(views.data, ANGLES).value == pytest.approx(VIEWS.axis_col, abs=0.25)
    result = recon.reconstruct(views.data, VIEWS, "fbp")
    assert psnr(phantom.attenuation(GRID), result.volume.data) > 15


@pytest.mark.slow
def test_rings_go_by_the_public_name_and_the_views_stay() -> None:
    """A disc off the axis, whose views are chords, in 240 columns of which three answer 4 % too little."""
    angles, col = np.arange(0, np.pi, np.pi / 90), np.arange(240)
    away = col[:, None] - 119.5 - 24 * np.cos(angles)
    clean = 0.02 * np.sqrt(np.clip(60.0**2 - away**2, 0, None)).T[:, None]
    noisy = clean + np.random.default_rng(3).normal(0, 0.01, clean.shape)
    odd = np.isin(col, (70, 104, 160))
    striped = (noisy + np.where(odd, 0.04, 0)).astype(np.float32)
    before = striped.copy()
    found = recon.remove_rings(striped, angles, "sort")
    np.testing.assert_array_equal(striped, before)
    np.testing.assert_allclose(found.taken, (striped - found.data).mean(axis=0), atol=1e-6)
    left = (found.data - noisy)[:, 0].mean(axis=0)
    assert np.abs(left[odd]).max() < 0.02 and np.abs(left).mean() < 0.005
    assert found.sentence.startswith("Rings: removed by sort")
    for views, wanted, way in ((striped[0], "must be", "sort"), (striped, "legal: none, auto", "rings")):
        with pytest.raises(ValueError, match=wanted):
            recon.remove_rings(views, angles, way)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="NaN"):
        recon.remove_rings(striped * np.nan, angles)


def test_a_result_says_in_a_line_what_it_is(noisy: np.ndarray) -> None:
    result = recon.reconstruct(noisy, VIEWS, "fbp")
    text = repr(result)
    assert text.startswith("Reconstruction(fbp: Volume(20 x 40 x 40 voxels [z, y, x] of 0.1), ") and len(text) < 100
    assert repr(VIEWS) == (
        "Geometry(parallel, 24 views from 0 to 172.5 degrees, detector 20 x 40, pitch 0.1, axis_col 18.3)"
    )


def test_a_result_is_saved_as_a_whole(noisy: np.ndarray, tmp_path: Path) -> None:
    result = recon.reconstruct(noisy, VIEWS, "fbp")
    result.save(tmp_path / "v.npz")
    with np.load(tmp_path / "v.npz", allow_pickle=False) as saved:
        np.testing.assert_array_equal(saved["volume"], result.volume.data)
        assert (float(saved["voxel_mm"]), str(saved["method"])) == (PITCH, "fbp")
        assert json.loads(str(saved["settings"]))["filter"] == "hann"


@pytest.mark.parametrize("method", others_slow([recon.FistaTv(), recon.R2(steps=150)]))
def test_a_helical_scan_is_a_height_a_view(method: recon.Method) -> None:
    """A ball higher than the detector, in two turns; without its heights it is a smear."""
    heights = np.column_stack((np.zeros(40), np.linspace(-8, 8, 40)))
    still = recon.Geometry.cone(np.linspace(0, 4 * np.pi, 40, endpoint=False), (16, 32), 1.0, 300.0, 300.0)
    helix, grid = replace(still, shifts=heights), recon.Grid((32, 32, 32), 1.0)
    z, y, x = np.indices(grid.shape) - 15.5
    truth = (np.hypot(np.hypot(x - 3, y), z) < 11).astype(np.float32)
    views = recon.Projector(helix, grid).forward(truth)
    found, smeared = (psnr(truth, recon.reconstruct(views, g, method, grid=grid).volume.data) for g in (helix, still))
    assert found > 25 and found > smeared + 10


@pytest.mark.parametrize(
    ("lean", "method", "warned"),
    [
        (30.0, recon.FistaTv(iterations=1), True),
        (30.0, recon.FistaTv(iterations=1, tv_weight=1e-3), False),
        (30.0, recon.Fbp(), False),
        (0.5, recon.FistaTv(iterations=1), False),  # half a pixel over the field is 1.8 degrees
    ],
)
def test_a_leaning_axis_asks_for_a_weight_as_no_view_judges_structure_along_it(
    lean: float, method: recon.Method, warned: bool
) -> None:
    angles = np.arange(12) * np.pi / 6
    geometry = Geometry.parallel(angles, (12, 32), tilt=np.full(12, np.radians(lean)))
    assert geometry.unseen_cone == pytest.approx(np.radians(lean) if lean > 2 else 0)
    views = np.zeros((12, 12, 32), np.float32)
    views[:, 5:8, 12:20] = 1.0
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        recon.reconstruct(views, geometry, method)
    said = [str(each.message) for each in told if "tilted along the beam by 30 degrees" in str(each.message)]
    assert bool(said) is warned
    assert all("tv_weight 0.001" in each for each in said)


test_calls_that_are_refused = refused_calls(__file__, globals())


def test_views_bring_their_geometry_weights_and_reach(noisy: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    """As arrays do, to the bit; what they state is neither stated twice nor measured again."""
    weights, method = np.ones_like(noisy), recon.Sirt(iterations=2)
    weights[5] = 0.5
    views = Views(noisy, VIEWS, weights)
    by_arrays = recon.reconstruct(noisy, VIEWS, method, use=DataUse(weights))
    views = replace(views, reach=whole_reach(views))
    monkeypatch.setattr("recon.voxels.beyond_field.edges_of", None)
    by_views = recon.reconstruct(views, method=method)
    np.testing.assert_array_equal(by_views.volume.data, by_arrays.volume.data)
    with refused(ValueError):
        recon.reconstruct(views, VIEWS, method, use=DataUse(weights))
    with refused(ValueError):
        recon.reconstruct(noisy, method=method)
