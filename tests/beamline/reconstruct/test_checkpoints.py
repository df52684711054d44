"""Whether a checkpoint belongs to this fit: every change of data or settings is found and named."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from beamline.core.errors import ConfigError, DataError
from beamline.projections.prepared import PreparedProjections
from beamline.projections.selection import Selection
from beamline.reconstruct.checkpoints import CheckpointOptions, differences, origin_of
from beamline.storage.writers.recon_file import Checkpoint, write_checkpoint
from recon.base.geometry import Geometry
from recon.base.kernel import Kernel
from recon.base.volume import Grid, Volume
from recon.features.reference.methods import FromReference
from recon.splatting import optimise as fit
from recon.splatting.checkpoint import arrays_of
from recon.splatting.gaussians import Gaussians
from recon.splatting.settings import FitSettings
from tests.beamline.prepared_views import prepare
from tests.beamline.scans import TwoCylinders, write_exchange
from tests.messages import refused

SCAN = TwoCylinders(angles=np.radians(np.arange(0, 180, 6.0)), shape=(2, 40))
OTHERS: dict[str, Any] = {"seed": 1, "start": "fbp"}
SETTINGS = FitSettings()
OTHER = next(kernel for kernel in Kernel if kernel is not SETTINGS.kernel)


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> PreparedProjections:
    path = write_exchange(tmp_path_factory.mktemp("prepared") / "scan.h5", SCAN)
    return prepare(path, Selection(axis_col=SCAN.axis_col))[0]


def _flipped(prepared: PreparedProjections) -> PreparedProjections:
    """One bit of one pixel is another."""
    data = prepared.seen.data.copy()
    data.view(np.uint32)[3, 1, 7] ^= 1
    return replace(prepared, lines=replace(prepared.lines, data=data))


def _seen_by(prepared: PreparedProjections, geometry: Geometry) -> PreparedProjections:
    return replace(prepared, lines=replace(prepared.lines, geometry=geometry))


def _turned(prepared: PreparedProjections) -> PreparedProjections:
    angles = prepared.geometry.angles.copy()
    angles[4] += 1e-9
    return _seen_by(prepared, prepared.geometry.at(angles))


CHANGES: dict[str, tuple[Callable[[PreparedProjections], PreparedProjections], FitSettings, dict[str, Any]]] = {
    "projections": (_flipped, SETTINGS, OTHERS),
    "angles": (_turned, SETTINGS, OTHERS),
    "axis_col": (lambda p: _seen_by(p, replace(p.geometry, axis_col=20.0)), SETTINGS, OTHERS),
    "pixel_pitch": (lambda p: _seen_by(p, replace(p.geometry, pixel_pitch=2.0)), SETTINGS, OTHERS),
    "length_unit": (lambda p: p.stating(length_unit="px"), SETTINGS, OTHERS),
    "loss": (lambda p: p, replace(SETTINGS, loss="l2"), OTHERS),
    "kernel": (lambda p: p, replace(SETTINGS, kernel=OTHER), OTHERS),
    "policy": (lambda p: p, replace(SETTINGS, policy=None), OTHERS),
    "seed": (lambda p: p, SETTINGS, {**OTHERS, "seed": 2}),
    "start": (lambda p: p, SETTINGS, {**OTHERS, "start": "tv"}),
}


@pytest.mark.parametrize("name", CHANGES)
def test_every_change_is_told_by_its_name(prepared: PreparedProjections, name: str) -> None:
    before = origin_of(prepared, SETTINGS, OTHERS)
    change, settings, others = CHANGES[name]
    found = differences(origin_of(change(prepared), settings, others), before)
    assert [said.split(" ")[0] for said in found] == [name]


def test_another_reference_is_told(prepared: PreparedProjections) -> None:
    grid = Grid((4, 8, 8))
    volume = np.random.default_rng(1).random(grid.shape).astype(np.float32)
    other = volume.copy()
    other[2, 4, 4] += 0.1
    first, second = (origin_of(prepared, FromReference(Volume(each, grid)), {}) for each in (volume, other))
    assert [said.split(" ")[0] for said in differences(second, first)] == ["reference"]
    assert not differences(origin_of(prepared, FromReference(Volume(volume.copy(), grid)), {}), first)


def _state(**changes: Any) -> dict[str, Any]:
    """Of a fit of five Gaussians that has begun."""
    model = Gaussians.from_physical(np.zeros((5, 3)), np.ones((5, 3)), np.ones(5), density_unit=1.0)
    return {**arrays_of(fit.init(model, 0)), **changes}


def test_it_comes_through_the_file_and_back(tmp_path: Path, prepared: PreparedProjections) -> None:
    path, said = tmp_path / "fit.h5", list[str]()
    origin = origin_of(prepared, SETTINGS, OTHERS)
    CheckpointOptions(path).write(origin, 100, said.append, _state())
    again = CheckpointOptions(path, path)
    again.refuse_existing()  # the one that it begins from may be replaced
    state = again.begin(origin, 100, said.append)
    assert state is not None and not said
    assert state.keys() == _state().keys()
    np.testing.assert_array_equal(state["statistic"], np.zeros(5))
    again.begin(origin, 200, said.append)
    assert "100 steps, but this fit is planned for 200 steps" in said[0]
    with refused(DataError):
        again.begin(origin_of(prepared, replace(SETTINGS, loss="l2"), OTHERS), 100, said.append)


@pytest.mark.parametrize(
    ("kept", "wanted", "words"),
    [
        (0, 0, "from a fit with a time limit, and this fit also has a time limit:"),
        (100, 0, "from a fit that was planned for 100 steps, but this fit is planned for a time limit:"),
        (0, 200, "from a fit that was planned for a time limit, but this fit is planned for 200 steps:"),
    ],
)
def test_a_plan_without_steps_is_told(
    tmp_path: Path, prepared: PreparedProjections, kept: int, wanted: int, words: str
) -> None:
    path, said = tmp_path / "fit.h5", list[str]()
    origin = origin_of(prepared, SETTINGS, OTHERS)
    CheckpointOptions(path).write(origin, kept, said.append, _state())
    assert CheckpointOptions(path, path).begin(origin, wanted, said.append) is not None
    assert len(said) == 1 and words in said[0]


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"statistic": np.full(5, np.nan, np.float32)}, "statistic"),
        ({"best.raw": np.full(5, np.inf)}, "best.raw"),
        ({"scalars": np.array([np.nan, 0.1, 0.1])}, "density unit"),
        ({"first.means": np.full((5, 3), np.nan, np.float32)}, "first.means"),
        ({"generator": np.zeros(3, np.uint64)}, "generator"),
        ({"second.raw": None}, r"second\.raw"),
    ],
)
def test_a_damaged_checkpoint_is_to_blame_before_any_work(tmp_path: Path, changes: dict[str, Any], said: str) -> None:
    state = {name: value for name, value in _state(**changes).items() if value is not None}
    write_checkpoint(tmp_path / "fit.h5", Checkpoint(state, {}, 100))
    with pytest.raises(DataError, match=rf"checkpoint .*fit\.h5 is damaged: .*{said}"):
        CheckpointOptions(None, tmp_path / "fit.h5").refuse_existing()


def test_a_plan_shorter_than_what_is_done_is_refused(tmp_path: Path) -> None:
    counts = np.array([100, 120, 0], np.int64)  # limit, step, seen
    write_checkpoint(tmp_path / "fit.h5", Checkpoint(_state(counts=counts), {}, 200))
    again, said = CheckpointOptions(None, tmp_path / "fit.h5"), list[str]()
    with refused(ConfigError):
        again.begin({}, 20, said.append)
    assert again.begin({}, 120, said.append) is not None and again.begin({}, 0, said.append) is not None


def test_a_file_in_the_way_is_refused_before_the_work(tmp_path: Path) -> None:
    (tmp_path / "fit.h5").write_text("precious")
    with refused(DataError):
        CheckpointOptions(tmp_path / "fit.h5").refuse_existing()
    with refused(DataError):
        CheckpointOptions(tmp_path / "no" / "fit.h5").refuse_existing()
    with refused(DataError):
        CheckpointOptions(None, tmp_path / "fit.h5").refuse_existing()
    assert CheckpointOptions().begin({}, 0, lambda said: None) is None and not CheckpointOptions().wanted


def test_a_disk_that_refuses_does_not_end_the_fit(tmp_path: Path) -> None:
    said: list[str] = []
    CheckpointOptions(tmp_path / "no" / "fit.h5").write({}, 0, said.append, {})
    assert "fit.h5 could not be written" in said[0]
