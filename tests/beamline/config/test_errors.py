"""Errors in a configuration name the file, line, key, the value found and the legal values."""

from pathlib import Path

import pytest

from beamline.core.errors import ConfigError
from recon.methods import names_of_one_volume
from tests.beamline.config_file import GOOD, faults, load

FAULTS = {
    "former key": (
        ("sample: {name: test}", "sample: {name: test}\nrecon: {stop_when: null}"),
        "my.yaml:2: recon.stop_when no longer exists; remove it. Use `scan.decide: do` with `scan.target: {quality_db",
    ),
    "decision": (
        ("exposure_s: 0.01", "exposure_s: 0.01\n  decide: perhaps"),
        "my.yaml:5: scan.decide is 'perhaps'; expected off | ask | do",
    ),
    "on is no decision": (("exposure_s: 0.01", "exposure_s: 0.01\n  decide: on"), "decide is true (YAML reads yes"),
    "dose": (
        ("exposure_s: 0.01", "exposure_s: 0.01\n  target: {dose: 50}"),
        "my.yaml:5: scan.target.dose is 50; expected a number > 0 and <= 1 | null",
    ),
    "decision without passes": (
        ("exposure_s: 0.01", "exposure_s: 0.01\n  decide: do\n  mode: step"),
        "my.yaml:5: scan.decide do needs a scan in several passes; set scan.angles to {scheme: interlaced, passes",
    ),
    "decision of a single pass": (
        ("exposure_s: 0.01", "exposure_s: 0.01\n  decide: do\n  mode: step\n  pass_views: 12"),
        "my.yaml:5: scan.decide do needs a scan in several passes; set scan.angles to {scheme: interlaced, passes",
    ),
    "unknown key": (
        ("exposure_s: 0.01", "exposure_s: 0.01\n  setle_s: 1"),
        "my.yaml:5: scan.setle_s is not a known key (did you mean settle_s?); legal keys in this section: mode, angles",
    ),
    "key of another scheme": (
        ("views: 12", "views: 12, seed: 1"),
        "my.yaml:3: scan.angles.seed is not a known key; legal keys in this section: scheme, views, start_deg",
    ),
    "missing": (
        ("exposure_s: 0.01", "settle_s: 0"),
        "my.yaml:2: scan.exposure_s is missing; expected a number > 0 and <= 1e+06",
    ),
    "choice": (
        ("sample: {name: test}", "sample: {name: test}\nrecon: {method: r3}"),
        f"my.yaml:2: recon.method is 'r3'; expected auto | {' | '.join(names_of_one_volume())}",
    ),
    "scheme": (
        ("scheme: fixed", "scheme: goldn"),
        "my.yaml:3: scan.angles.scheme is 'goldn' (did you mean golden?); "
        "expected fixed | sector | random | interlaced | golden | file",
    ),
    "no scheme": (("scheme: fixed, ", ""), "my.yaml:3: scan.angles.scheme is missing; expected fixed | sector"),
    "range": (("exposure_s: 0.01", "exposure_s: -1"), "my.yaml:4: scan.exposure_s is -1; expected a number > 0"),
    "infinite": (("exposure_s: 0.01", "exposure_s: .inf"), "my.yaml:4: scan.exposure_s is .inf; expected a number > 0"),
    "not a number": (("exposure_s: 0.01", "exposure_s: short"), "scan.exposure_s is 'short'; expected a number > 0"),
    "truth": (("views: 12", "views: yes"), "my.yaml:3: scan.angles: views is true (YAML reads yes, no, on and off"),
    "a path of Windows in double quotes": (
        ("sample: {name: test}", 'sample: {name: test}\nstorage: {folder: "D:\\tomo\\new"}'),
        "my.yaml:2: storage: folder is 'D:\\tomo\\new', with the control character '\\t'. In double quotes a "
        "backslash starts a control character; write the text without quotes, or in single quotes",
    ),
    "a line end in a port": (
        ('port: "sim://pm16c"', 'port: "COM3\\n"'),
        "my.yaml:7: devices.stage: port is 'COM3\\n', with the control character '\\n'",
    ),
    "fraction": (("views: 12", "views: 12.5"), "scan.angles.views is 12.5; expected a whole number > 0"),
    "views without end": (
        ("views: 12", "views: 1000000000"),
        "my.yaml:3: scan.angles.views is 1000000000; expected a whole number > 0 and <= 1e+06",
    ),
    "list": (
        ("[0, 0, 8, 8]", "[0, 0, 8]"),
        "my.yaml:8: devices.camera.roi is [0, 0, 8]; expected a list of 4: row0, col0",
    ),
    "list item": (
        ("[0, 0, 8, 8]", "[0, 0, 8, x]"),
        "my.yaml:8: devices.camera.roi.3 is 'x'; expected a whole number >= 1",
    ),
    "name": (("name: test", "name: a/b"), "sample.name is 'a/b'; expected text of letters, digits and _"),
    "no text": (
        ('port: "sim://pm16c"', "port: .nan"),
        "my.yaml:7: devices.stage.port is .nan; expected text that is not empty",
    ),
    "scalar for a group": (
        ("{pixel_size_um: 5}", "5"),
        "my.yaml:11: optics is 5; expected a group of keys: pixel_size_um",
    ),
    "limits": (
        ("counts_per_turn", "low_deg: 3, high_deg: 2, counts_per_turn"),
        "my.yaml:7: devices.stage: low_deg 3.0 must lie below high_deg 2.0",
    ),
    "mixed": (
        ('"sim://pm16c"', "COM3"),
        "my.yaml:7: devices.stage: simulated and real devices cannot be mixed, but camera, "
        "shutter, sample_mover are simulated, and stage is real",
    ),
    "stage of no kind": (
        ("kind: pm16c", "kind: pm16"),
        "my.yaml:7: devices.stage.kind is 'pm16' (did you mean pm16c?); expected epics | pi_gcs | pm16c | zaber",
    ),
    "key of another stage": (
        ("counts_per_turn", "axis: 1, counts_per_turn"),
        "my.yaml:7: devices.stage.axis is not a known key; legal keys in this section: kind, port",
    ),
    "counterpart of another stage": (
        ("kind: pm16c", "kind: pi_gcs"),
        "my.yaml:7: devices.stage: port sim://pm16c does not fit kind pi_gcs; expected sim://pi_gcs, the simulated "
        "controller of this kind",
    ),
    "a stage without a simulated controller": (
        ('kind: pm16c, port: "sim://pm16c"', 'kind: zaber, port: "sim://zaber"'),
        "my.yaml:7: devices.stage: a zaber stage has no simulated controller, so sim://zaber is not a valid port. "
        "Simulate a stage with kind: pi_gcs, port: sim://pi_gcs, or set the real port and rehearse with --rehearse",
    ),
    "an output that the PM16C has not": (
        ("shutter: {kind: simulated}", "shutter: {kind: stage_output, output: 2}"),
        "my.yaml:9: devices: shutter.kind: a pm16c stage has no digital output for a shutter; set shutter.kind to "
        "manual, or use the output of another controller (stage.kind pi_gcs or zaber)",
    ),
    "an electrometer that sees no simulated beam": (
        ("  shutter:", "  beam_monitor: {kind: electrometer, port: COM4}\n  shutter:"),
        "simulated and real devices cannot be mixed, but stage, camera, shutter, sample_mover are simulated, and "
        "beam_monitor is real",
    ),
    "a pattern that finds nothing": (
        ("  shutter:", "  beam_monitor: {kind: ring_current, url: 'http://ring/', pattern: mA}\n  shutter:"),
        "my.yaml:9: devices.beam_monitor.pattern: the pattern 'mA' has no group (...) around the number",
    ),
    "no page": (
        ("  shutter:", "  beam_monitor: {kind: ring_current, url: ring, pattern: (.)}\n  shutter:"),
        "my.yaml:9: devices.beam_monitor.url: 'ring' is not the address of a page; expected http://host/...",
    ),
    "no simulation": (("simulation: {}\n", ""), "simulated devices need a simulation section"),
    "twice": (
        ("  exposure_s: 0.01\n", "  exposure_s: 0.01\n  exposure_s: 0.02\n"),
        "my.yaml:5: scan.exposure_s appears twice (also in line 4)",
    ),
    "no YAML": (("exposure_s: 0.01", "exposure_s: [0.01"), "my.yaml:4: this is not YAML (the [ of this line"),
    "number as key": (("sample: {name: test}", "sample: {name: test, 1: 2}"), "my.yaml:1: sample"),
}


@pytest.mark.parametrize(("change", "message"), FAULTS.values(), ids=FAULTS.keys())
def test_faults_say_where_what_and_what_is_legal(tmp_path: Path, change: tuple[str, str], message: str) -> None:
    assert change[0] in GOOD
    text = faults(tmp_path, GOOD.replace(*change))
    assert message in text
    assert "pydantic" not in text.lower()
    assert "\n" not in text  # one fault, one sentence


def test_all_faults_are_said_at_once(tmp_path: Path) -> None:
    text = faults(tmp_path, GOOD.replace("0.01", "0").replace("views: 12", "views: 0").replace("name: test", "nam: x"))
    assert text.startswith("my.yaml has 4 faults, nothing was started:\n  my.yaml:1: sample.name is missing")
    assert len(text.splitlines()) == 5


@pytest.mark.parametrize("text", ["", "# nothing\n", "- a\n- b\n", "just words", "a: !!python/object:os.system {}"])
def test_files_that_are_no_configuration(tmp_path: Path, text: str) -> None:
    assert "my.yaml" in faults(tmp_path, text)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"absent\.yaml does not exist"):
        load(tmp_path / "absent.yaml")
    (tmp_path / "latin.yaml").write_bytes(b"sample: {name: \xe9}")
    with pytest.raises(ConfigError, match="UTF-8"):
        load(tmp_path / "latin.yaml")


def test_faults_of_overrides_name_the_override(tmp_path: Path) -> None:
    text = faults(tmp_path, GOOD, "scan.perid_s=1")
    assert text.startswith("--set scan.perid_s=1: scan.perid_s is not a known key (did you mean period_s?)")
    text = faults(tmp_path, GOOD, BEAMLINE_SCAN__ANGLES__VIEWS="many")
    assert text.startswith("BEAMLINE_SCAN__ANGLES__VIEWS: scan.angles.views is 'many'; expected a whole number > 0")
    assert "expected section.key=value" in faults(tmp_path, GOOD, "scan.period_s")
    assert "--set scan.period_s=[: this is not YAML" in faults(tmp_path, GOOD, "scan.period_s=[")


def test_a_configuration_that_is_no_regular_file_or_far_too_large(tmp_path: Path) -> None:
    large = tmp_path / "large.yaml"
    large.write_text("# " + "x" * 2**20, encoding="utf-8")
    for path, said in ((tmp_path, "It is a folder"), (large, r"too large \(1048578 bytes, at most 1048576\)")):
        with pytest.raises(ConfigError, match=said):
            load(path)
