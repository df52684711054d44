"""The law of a sample beyond the field: by each method, what the field shows has its density, however wide the sample.

What serves the law is tested where it is made: reach and box in `voxels/test_beyond_field.py`, the projections that FBP
continues in `voxels/test_fbp_truncated.py`, half acquisition in `test_wide_field.py`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

import recon
from recon.base.reach import SAMPLE
from recon.base.view_data import Views
from recon.voxels.beyond_field import reach_of, whole_reach
from tests.recon.voxels.test_beyond_field import COLS, FIELD, GEOMETRY, can, error, views_of
from tests.slow_cases import others_slow

METHODS = (
    recon.Fbp(), recon.FistaTv(iterations=20), recon.Discrete(iterations=20), recon.PnpDct(),
    recon.OsSirtTv(iterations=12), recon.Sirt(iterations=60), recon.Sart(iterations=4), recon.Cgls(iterations=12),
    recon.AsdPocs(iterations=8), recon.R2(steps=60, gaussians=1500),
)  # fmt: skip
SOON_ENDED = "sart", "cgls", "asd-pocs", "r2"  # after few iterations, so that the test is short


@pytest.fixture(scope="module", params=[1.0, 1.3, 2.0], ids="{} fields".format)
def wide(request: pytest.FixtureRequest) -> tuple[float, Views, NDArray[np.float32]]:
    """How many times as far as the field a can reaches, its views, and its density in the field."""
    sample = can(request.param * COLS / 2)
    views = Views(views_of(sample), GEOMETRY)
    truth = sample.attenuation(recon.Grid.matching(GEOMETRY)).astype(np.float32)
    return request.param, replace(views, reach=whole_reach(views)), truth


@pytest.mark.slow
def test_a_sample_is_wider_only_if_it_goes_beyond(wide: tuple[float, Views, NDArray[np.float32]]) -> None:
    fields, views, _ = wide
    assert views.reach is not None
    assert (views.reach.sample is not None) is (fields > 1)
    assert reach_of(views).beyond


@pytest.mark.parametrize("method", others_slow(METHODS, 2), ids=lambda method: method.name)
@pytest.mark.usefixtures("one_thread")
def test_the_field_has_the_density_of_the_sample(
    method: recon.Method, wide: tuple[float, Views, NDArray[np.float32]]
) -> None:
    fields, views, truth = wide
    made = recon.reconstruct(views, method=method)
    assert made.volume.grid == recon.Grid.matching(GEOMETRY)
    wider = fields > 1 and method.name != "fbp"
    assert (SAMPLE in made.settings) is wider is (made.outside is not None)
    # what lies beyond adds a nearly even density, which a method finds last
    even, detail = (0.02, 0.05) if fields <= 1 else (0.3, 0.15) if method.name in SOON_ENDED else (0.1, 0.06)
    assert made.volume.data[:, FIELD].mean() == pytest.approx(truth[:, FIELD].mean(), rel=even)
    assert error(made.volume.data, truth) < detail
