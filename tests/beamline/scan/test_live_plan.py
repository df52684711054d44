"""The live volume that is possible during a scan, and the messages about it."""

import pytest

from beamline.config.load import config_folder, load
from beamline.config.planned import plan_of
from beamline.scan.live_plan import better_order, live_need, live_plan


@pytest.mark.parametrize(
    ("shape", "n_views", "free", "planned"),
    [
        ((256, 256), 180, 8e9, (1, 1)),
        ((2048, 2048), 1800, 64e9, (4, 1)),
        ((2304, 4096), 3600, 24e9, (8, 3)),
        ((2048, 2048), 1800, 3e9, (8, 8)),
        ((2048, 2048), 60, 24e9, (4, 1)),
    ],
)
def test_the_live_volume_fits_into_half_of_the_memory(
    shape: tuple[int, int], n_views: int, free: float, planned: tuple[int, int]
) -> None:
    plan = live_plan(shape, n_views, int(free))
    assert (plan.binning, plan.one_in) == planned
    assert plan.bytes <= free / 2


def test_its_need_of_memory_and_the_reason_are_stated() -> None:
    # 256² x (50 B x 256 + 40 B x 180) = 1.31 GB; 2304 x 4096 x (50 B x 4096 + 40 B x 3600) = 3.29 TB.
    whole = live_need((256, 256), 180, int(8e9))
    assert whole == (
        "the live volume uses 180 projections of 256 x 256 pixels and about 1.31 GB of memory; at most half of the "
        "8 GB of free memory is allowed"
    )
    reduced = live_need((2304, 4096), 3600, int(24e9))
    for part in (
        "uses 1200 projections of 288 x 512 pixels", "one projection in 3, pixels binned 8 x 8", "at most 512 columns",
        "half of the 24 GB of free memory", "all 3600 projections of 2304 x 4096 would need 3.29 TB",
    ):  # fmt: skip
        assert part in reduced
    assert "columns" not in live_need((256, 256), 180, int(1e9))


@pytest.mark.parametrize(
    ("changes", "proposed"),
    [
        ((), "{scheme: interlaced, passes: 6} the PSNR was 22.0"),
        (("scan.mode=step", "scan.period_s=1"), "{scheme: golden} the PSNR was 22.9"),
        (("scan.angles.views=181",), None),  # of no number of equal passes
        (("scan.angles={scheme: interlaced, views: 180, passes: 6}",), None),
        (("scan.angles.views=24",), None),  # over before anybody looks
    ],
)
def test_an_order_whose_live_volume_is_better_is_proposed_in_the_words_of_the_configuration(
    changes: tuple[str, ...], proposed: str | None
) -> None:
    said = better_order(plan_of(load(config_folder() / "demo.yaml", changes)))
    assert len(said) == (proposed is not None)
    if proposed is not None:
        assert proposed in said[0] and "15.0, 19.6, 22.7" in said[0]
