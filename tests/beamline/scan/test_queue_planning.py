"""Planning of a queue: every fault of every scan with its file and line, and what each scan needs."""

from __future__ import annotations

from pathlib import Path

import pytest

from beamline.config.load import config_folder
from beamline.core.errors import ConfigError
from beamline.scan.queue_plan import PlannedScan
from beamline.scan.queue_planning import plan_queue
from tests.beamline.scan.wrong_configs import wrong_configs

SIMULATED, INSTRUMENT = (config_folder() / f"{name}.yaml" for name in ("simulated", "instrument"))


def table(folder: Path, *lines: str) -> Path:
    path = folder / "day.csv"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def faults(*scans: PlannedScan) -> list[str]:
    return [str(fault) for scan in scans for fault in scan.faults]


def test_a_table_has_a_scan_a_line_and_empty_cells_change_nothing(tmp_path: Path) -> None:
    (tmp_path / "own.yaml").write_text(SIMULATED.read_text("utf-8"), encoding="utf-8")
    lines = "config, sample.name,scan.exposure_s", "own.yaml,a,", "", f"{SIMULATED},b,0.02"
    mapping = {"config": SIMULATED, "sample.name": "c", "scan.darks": {"count": 3}}
    plan = plan_queue([table(tmp_path, *lines), SIMULATED, mapping], ["scan.angles.views=120"], place=tmp_path)
    configs = [scan.config for scan in plan.scans if scan.config is not None]
    named = [(config.sample.name, config.scan.exposure_s, config.scan.darks.count) for config in configs]
    assert named == [("a", 0.05, 10), ("b", 0.02, 10), ("battery", 0.05, 10), ("c", 0.05, 3)]
    assert [scan.source for scan in plan.scans] == [
        f"{tmp_path / 'day.csv'}:2", f"{tmp_path / 'day.csv'}:4", str(SIMULATED), str(SIMULATED),
    ]  # fmt: skip
    assert {scan.needs.n_frames for scan in plan.scans[:3]} == {120 + 30} and plan.scans[3].needs.n_frames == 120 + 23
    assert plan.valid and plan.needs.duration == pytest.approx(sum(plan.needs.parts.values()))
    assert plan.needs.total_bytes == sum(scan.needs.total_bytes for scan in plan.scans)
    plan.refuse_impossible()


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (("sample.name", "a"), "{}: {} is not a table of scans"),
        (("config,x",), "is not a table of scans"),
        (("config,config", "a.yaml,b.yaml"), "is not a table of scans"),
        (("config,sample.name", ",a"), "{}:2: ',a' has 2 cells; expected 2, as in the first line, and a file"),
        (("config,sample.name", "a.yaml,b,c"), "{}:2: 'a.yaml,b,c' has 3 cells"),
        (("config,scan.modd", f"{SIMULATED},1"), "{}:2: scan.modd is not a known key (did you mean mode?)"),
        (("config", "none.yaml"), "none.yaml does not exist"),
    ],
)
def test_a_wrong_row_has_a_fault_and_the_others_are_planned(
    tmp_path: Path, lines: tuple[str, ...], message: str
) -> None:
    wrong, good = table(tmp_path, *lines), tmp_path / "good.csv"
    good.write_text(f"config\n{SIMULATED}\n", "utf-8")
    plan = plan_queue([wrong, good], place=tmp_path)
    assert [scan.valid for scan in plan.scans] == [False, True] and not plan.valid
    assert message.format(wrong, wrong).removeprefix(f"{wrong}: ") in faults(plan.scans[0])[0]
    assert plan.needs.duration == plan.scans[1].needs.duration > 0
    with pytest.raises(ConfigError, match=r"^Nothing was started, because 1 scan of 2 cannot run:\n  "):
        plan.refuse_impossible()


def test_a_table_that_is_no_text_is_a_fault(tmp_path: Path) -> None:
    (tmp_path / "day.csv").write_bytes(b"\xff\xfe\x00\x01")
    gone, broken, empty = plan_queue([tmp_path / "gone.csv", tmp_path / "day.csv", {"sample.name": "a"}]).scans
    assert "gone.csv cannot be read as a table" in faults(gone)[0] and not broken.valid
    assert "names no configuration; expected its file under 'config'" in faults(empty)[0]


def test_every_fault_of_a_hundred_scans_has_its_file_and_line(tmp_path: Path) -> None:
    wrong = wrong_configs(tmp_path, 100)
    plan = plan_queue([each.path for each in wrong], place=tmp_path)
    assert [scan.source for scan in plan.scans] == [str(each.path) for each in wrong]
    for each, scan in zip(wrong, plan.scans, strict=True):
        (fault,) = [fault for fault in scan.faults if fault.message.startswith(each.sentence)]
        assert (fault.file, fault.line) == (str(each.path), each.line), fault
    with pytest.raises(ConfigError) as refused:
        plan.refuse_impossible()
    assert all(f"{each.path}:{each.line}: {each.sentence}" in str(refused.value) for each in wrong)


def test_values_that_do_not_go_together_and_limits_are_found_at_once(tmp_path: Path) -> None:
    text = SIMULATED.read_text("utf-8").replace("energy_kev: 25.0", "energy_kev: 25000")
    (tmp_path / "a.yaml").write_text(text.replace("axis_col: null", "axis_col: 9000"), "utf-8")
    changed = {"config": tmp_path / "a.yaml", "scan.period_s": 0.001}
    one, other = plan_queue([tmp_path / "a.yaml", changed], place=tmp_path).scans
    energy, axis = faults(one)
    assert "a.yaml:91: optics.energy_kev = 25000 keV is outside" in energy
    assert "a.yaml:93: optics.axis_col 9000 is outside the columns of the frame" in axis
    assert faults(other)[0] == energy and faults(other)[-1] == axis
    assert "--set scan.period_s=0.001: scan.period_s 0.001 is below the camera's minimum" in "\n".join(faults(other))
    assert one.warnings == () or "energy" in one.warnings[0]


def test_a_file_of_angles_that_is_wrong_has_the_line_that_names_it(tmp_path: Path) -> None:
    (tmp_path / "angles.txt").write_text("0\n1\nx\n", "utf-8")
    text = SIMULATED.read_text("utf-8")
    (tmp_path / "a.yaml").write_text(
        text.replace("{scheme: fixed, ", "{scheme: file, path: angles.txt} # ", 1), "utf-8"
    )
    (fault,) = plan_queue([tmp_path / "a.yaml"], place=tmp_path).scans[0].faults
    angles = tmp_path / "angles.txt"
    assert fault.message.startswith(
        f"scan.angles.path: {angles}: line 3 contains 'x'; expected one angle in degrees per line"
    )
    assert (fault.file, fault.line) == (str(tmp_path / "a.yaml"), 19)


def test_a_scene_that_is_wrong_is_a_fault_of_its_scans_only(tmp_path: Path) -> None:
    broken = {"config": SIMULATED, "simulation.scene": {"phantom": {"kind": "batery"}, "beam": {"photons_per_s": 1e5}}}
    scan, good = plan_queue([broken, SIMULATED], place=tmp_path).scans
    assert "simulation.scene: " in faults(scan)[0] and "did you mean battery" in faults(scan)[0] and good.valid


def test_what_the_operator_does_and_the_dose(tmp_path: Path) -> None:
    views = {"scan.angles.views": 90, "optics.dose_rate_gy_s": 2.0, "scan.warm_up_s": 5}
    by_hand = {"devices.filter": {"kind": "manual", "places": ["Al"]}, "scan.filter": "Al"}
    plain, hand, simulated = plan_queue(
        [{"config": INSTRUMENT, **views}, {"config": INSTRUMENT, **by_hand, "recon.live": False}, SIMULATED],
        place=tmp_path,
    ).scans
    assert simulated.needs.operator == () and simulated.needs.dose_gy is None
    # closed for darks, opened for flats, closed at the end; out and back for the flats before and after the projections
    shutter, sample = ("open or close the shutter", 3), ("move the sample out of the beam or back", 4)
    assert plain.needs.operator == (shutter, sample)
    assert hand.needs.operator == (("put the filter Al into the beam", 1), shutter, sample)
    assert plain.needs.dose_gy == pytest.approx(2.0 * plain.needs.parts["projection"])
    assert plain.needs.parts["warm_up"] == 5.0
    (first,) = plan_queue([{"config": INSTRUMENT, **views, "scan.flats.at": "end"}], place=tmp_path).scans
    assert first.needs.dose_gy == pytest.approx(
        2.0 * (first.needs.parts["projection"] + 5.0)
    )  # the sample is there from the start
    assert (plain.needs.volume_seconds, hand.needs.volume_seconds) == (1800.0, 0.0)


def test_a_series_of_energies_counts_with_all_its_scans(tmp_path: Path) -> None:
    series = {
        "config": INSTRUMENT, "scan.energies": [8.3, 8.4], "devices.monochromator": {"kind": "manual"},
    }  # fmt: skip
    plan = plan_queue(
        [series, {"config": INSTRUMENT}],
        ["scan.angles.views=90", "scan.period_s=0.5", "optics.dose_rate_gy_s=1.0"],
        place=tmp_path,
    )
    assert faults(*plan.scans) == []
    both, single = plan.scans
    assert (both.needs.n_frames, both.needs.total_bytes) == (2 * single.needs.n_frames, 2 * single.needs.total_bytes)
    assert both.needs.duration == pytest.approx(2 * single.needs.duration, rel=0.01)
    assert both.needs.dose_gy == pytest.approx(2 * (single.needs.dose_gy or 0), rel=0.01)
    assert ("set the monochromator", 2) in both.needs.operator


def test_a_rehearsal_is_planned_with_simulated_devices(tmp_path: Path) -> None:
    said = list[str]()
    plan = plan_queue([INSTRUMENT], ["scan.angles.views=90"], place=tmp_path, rehearse=True, no_live=said.append)
    assert plan.scans[0].needs.operator == () and plan.scans[0].sample == "battery_rehearsal" and said == []
    assert plan.needs.volume_seconds == 0.0
