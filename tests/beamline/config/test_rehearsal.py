"""A real configuration also runs with simulated devices, for all kinds of devices; errors name their line."""

from dataclasses import astuple
from pathlib import Path
from typing import Any

import pytest

from beamline.config.load import Config, config_folder, load
from beamline.core.errors import ConfigError
from beamline.core.events import Event
from beamline.scan.dry_run import dry_run
from beamline.scan.run import run_scan
from beamline.storage.readers.open import open_scan
from drivers.base.frame import FrameKind
from tests.slow_cases import others_slow

INSTRUMENT = config_folder() / "instrument.yaml"
LIMITS = "counts_per_turn: 360000, max_speed_deg_s: 10, acceleration_deg_s2: 20, low_deg: -5, high_deg: 365"
STAGE = {
    "pm16c": "{kind: pm16c, port: COM3, %s}",
    "pi_gcs": '{kind: pi_gcs, port: COM3, axis: "1", %s}',
    "zaber": "{kind: zaber, port: COM3, device: 1, axis: 1, %s}",
    "epics": '{kind: epics, port: "ca://2bma:m49", %s}',
}
DEVICES = {
    "as shipped": (),
    "shutter behind EPICS": (
        "devices.shutter={kind: epics, open_pv: 'ca://S:OPEN', close_pv: 'ca://S:CLOSE', status_pv: 'ca://S:BEAM'}",
    ),
    "shutter on an output": (
        f"devices.stage={STAGE['pi_gcs'] % LIMITS}", "devices.shutter={kind: stage_output, output: 2}",
    ),
    "sample moved by a motor": (
        "devices.sample_mover={kind: stage, in_deg: 0, out_deg: 20, stage: "
        f"{STAGE['epics'] % LIMITS}}}",
    ),
    "filters by hand": ("devices.filter={kind: manual, places: [none, Al 1 mm]}", "scan.filter=Al 1 mm"),
    "filters behind EPICS": (
        "devices.filter={kind: epics, pv: 'ca://F', places: {none: 0, Al 1 mm: 1}}", "scan.filter=Al 1 mm",
    ),
    "filters on a motor": (
        f"devices.filter={{kind: stage, places: {{none: 0, Al 1 mm: 90}}, stage: {STAGE['zaber'] % LIMITS}}}",
        "scan.filter=none",
    ),
    "monochromator by hand": ("devices.monochromator={kind: manual, range_kev: [4, 40]}", "scan.energy=30"),
    "monochromator behind EPICS": (
        "devices.monochromator={kind: epics, pv: 'ca://E.VAL', status_pv: 'ca://E.RBV', unit: eV}", "scan.energy=20",
    ),
    "electrometer that pauses": (
        "devices.beam_monitor={kind: electrometer, port: COM4, pause_below: 1.0e+3, resume_above: 2.0e+3}",
    ),
    "ring current": ("devices.beam_monitor={kind: ring_current, url: 'http://ring/', pattern: '([0-9.]+) mA'}",),
    "inverted pulses": (
        f"devices.stage={STAGE['zaber'] % LIMITS}", "devices.stage.active_high=false",
        "devices.camera.trigger_polarity=negative",
    ),
    "an axis that was measured": ("optics.axis_col=900", "recon.axis=901.5"),
}  # fmt: skip
SMALL = (
    "scan.mode=step", "scan.angles={scheme: fixed, views: 4}", "scan.darks.count=1", "scan.flats.count=1",
    "recon.live=false", "devices.camera.roi=[1100,1900,32,64]",
)  # fmt: skip


def _rehearsed(*overrides: str) -> Config:
    return load(INSTRUMENT, overrides, environment={}, rehearse=True)


@pytest.mark.parametrize("overrides", DEVICES.values(), ids=DEVICES.keys())
def test_every_device_has_a_simulated_counterpart(tmp_path: Path, overrides: tuple[str, ...]) -> None:
    real, found = load(INSTRUMENT, overrides, environment={}), _rehearsed(*overrides)
    assert not real.simulated and all(found.devices.simulated_or_not().values())
    assert found.scan == real.scan
    turned, turns = (astuple(each.devices.stage.settings.limits()) for each in (real, found))
    assert turns[:-1] == pytest.approx(
        turned[:-1]
    )  # but the tolerance: a stage that is simulated by another has its own
    for key in ("roi", "binning", "readout", "model"):
        assert getattr(found.devices.camera, key) == getattr(real.devices.camera, key)
    planned, wanted = (dry_run(each, tmp_path).timeline for each in (found, real))
    assert (planned.n_frames, planned.duration) == (wanted.n_frames, wanted.duration)


@pytest.mark.parametrize(
    "name", others_slow(["as shipped", "inverted pulses", "sample moved by a motor", "filters behind EPICS"], 2)
)
def test_the_scan_runs_to_its_end(tmp_path: Path, name: str) -> None:
    events: list[Event] = []
    result = run_scan(_rehearsed(*SMALL, *DEVICES[name]), tmp_path, [events.append])
    assert result.n_frames == 7 and not result.missing
    with open_scan(result.path) as source:
        assert source.table.views.size == 4
        views = [frame.counts for frame in source.frames() if frame.kind is FrameKind.PROJECTION]
        flat = next(frame.counts for frame in source.frames() if frame.kind is FrameKind.FLAT)
    assert all((view.mean() < 0.9 * flat.mean()) and view.mean() > 0.02 * flat.mean() for view in views)
    assert result.path.parent.name.endswith("battery_rehearsal")
    again = load(result.path.parent / "config.resolved.yaml", environment={})
    assert again.simulated  # --resume goes on with simulated devices


def test_a_transcript_is_a_file_of_its_own(tmp_path: Path) -> None:
    found = _rehearsed(f"devices.stage.transcript={tmp_path / 'stage.txt'}")
    assert found.devices.stage.transcript == str(tmp_path / "stage_rehearsal.txt")  # type: ignore[attr-defined]


def test_a_stage_without_a_simulated_controller_rehearses_as_another_and_gives_pulses_as_close() -> None:
    shaped = "pulse_width_s: 4.0e-3, output: 3, active_high: false, serial: '42', timeout_s: 2, transcript: a.txt"
    words = f"devices.stage={STAGE['zaber'][:-1] % LIMITS}, {shaped}}}", "devices.camera.trigger_polarity=negative"
    stage = _rehearsed(*words).devices.stage
    assert (stage.kind, stage.port, stage.settings.pulse_output) == ("pi_gcs", "sim://pi_gcs", 3)
    assert stage.settings.limits().pulse_spacing == 8e-3 and not stage.settings.active_high
    assert stage.settings.timeout == 2 and str(stage.settings.transcript) == "a_rehearsal.txt"  # type: ignore[attr-defined]


def test_a_simulated_configuration_stays_as_it_is() -> None:
    path = config_folder() / "simulated.yaml"
    assert load(path, environment={}, rehearse=True) == load(path, environment={})


def _edited(path: Path, **changes: Any) -> Path:
    """instrument.yaml with text replaced, line by line."""
    text = INSTRUMENT.read_text("utf-8")
    for old, new in changes.values():
        assert old in text
        text = text.replace(old, new, 1)
    path.write_text(text, "utf-8")
    return path


SIMULATED = {
    "stage": ("port: /dev/ttyUSB0 ", "port: sim://pm16c "),
    "camera": ("kind: dcam ", "kind: simulated_orca "),
    "shutter": ("shutter: {kind: manual}", "shutter: {kind: simulated}"),
    "mover": ("sample_mover: {kind: manual}", "sample_mover: {kind: simulated}"),
}


def _line(path: Path, text: str) -> int:
    return next(n for n, line in enumerate(path.read_text("utf-8").splitlines(), 1) if line.strip().startswith(text))


def test_keys_of_a_real_camera_are_one_fault_that_names_the_way(tmp_path: Path) -> None:
    path = _edited(tmp_path / "my.yaml", **SIMULATED)
    with pytest.raises(ConfigError) as refused:
        load(path, environment={})
    said = str(refused.value)
    assert said.startswith(f"{path}:{_line(path, 'library:')}: devices.camera: remove the keys library, index, link, ")
    assert "because they do not belong to the stated kind" in said and "--rehearse" in said and "\n" not in said
