"""Needs of several scans are the sums of those of each."""

from beamline.plan.needs import NOTHING, OperatorRequest, ScanNeeds, all_needs

OPEN, MOUNT = OperatorRequest("open the shutter", 2), OperatorRequest("move the sample", 1)
ONE = ScanNeeds({"dark": 1.0, "projection": 10.0}, 30, 600, None, 5.0, (OPEN,))
OTHER = ScanNeeds({"projection": 2.0, "return": 0.5}, 4, 80, 1.5, 0.0, (MOUNT, OPEN))


def test_needs_add_up() -> None:
    both = all_needs([ONE, OTHER, OTHER])
    assert both.parts == {"dark": 1.0, "projection": 14.0, "return": 1.0} and both.duration == 16.0
    assert (both.n_frames, both.total_bytes, both.dose_gy, both.volume_seconds) == (38, 760, 3.0, 5.0)
    assert both.operator == (("open the shutter", 6), ("move the sample", 2))
    assert all_needs([ONE]) == ONE and all_needs([]) == NOTHING


def test_programs_get_every_value_by_name() -> None:
    data = OTHER.data()
    assert data["duration"] == 2.5 and data["operator"][0] == {"request": "move the sample", "times": 1}
    assert {*data} == {"duration", "parts", "n_frames", "total_bytes", "dose_gy", "volume_seconds", "operator"}
