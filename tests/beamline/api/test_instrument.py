"""Scans from Python: devices stay open, each scan has its own values, Ctrl-C ends the loop and keeps the data."""

import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from beamline import api
from beamline.config.load import config_folder
from beamline.storage.readers.open import open_scan
from tests.beamline.fakes import FakeInstrument, Faults
from tests.messages import refused

SIMULATED = config_folder() / "simulated.yaml"
SMALL = {
    "scan.angles.views": 12,
    "scan.period_s": 0.5,
    "scan.exposure_s": 0.02,
    "scan.darks.count": 3,
    "scan.flats": {"count": 2, "at": "start"},
    "recon.live": False,
}
FRAMES = 3 + 2 + 12

Connected = Callable[..., api.Instrument]


@pytest.fixture
def closed() -> list[FakeInstrument]:
    """Fake instruments whose devices were closed."""
    return []


@pytest.fixture
def connected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, closed: list[FakeInstrument]) -> Connected:
    """`connect` that finds a fake instrument where the devices would be; runs come into `tmp_path`."""

    def connect(
        fake: FakeInstrument | None = None, say: Callable[[str], None] | None = None, **values: object
    ) -> api.Instrument:
        fake = fake or FakeInstrument()
        monkeypatch.setattr(
            "beamline.instrument.connect.connect",
            lambda config, ask=None: replace(fake.connected(), close=lambda: closed.append(fake)),
        )
        return api.connect(SIMULATED, set={**SMALL, "storage.folder": str(tmp_path), **values}, say=say)

    return connect


def test_scans_in_a_row_carry_their_own_sample_energy_time_and_views(
    connected: Connected, closed: list[FakeInstrument]
) -> None:
    with connected() as instrument:
        first = instrument.scan(sample="cathode-1", energy_kev=24.9)
        again = instrument.scan(sample="cathode-2", energy_kev=25.1, set={"scan.angles.views": 6})
        third = instrument.scan()
        assert not closed
    assert len(closed) == 1
    with open_scan(first.path) as one, open_scan(again.path) as two, open_scan(third.path) as three:
        sources = (one, two, three)
        assert [source.attributes["sample"] for source in sources] == ["cathode-1", "cathode-2", "battery"]
        assert [source.energy_kev for source in sources] == [24.9, 25.1, 25.0]
        assert [len(source.plan["angles_deg"]) for source in sources] == [12, 6, 12]
        times = [frame.time for source in sources for frame in source.frames()]
    assert times == sorted(times) and len(set(times)) == len(times)
    assert (first.sample, first.frames, again.frames, third.frames) == ("cathode-1", FRAMES, FRAMES - 6, FRAMES)
    assert first.folder != again.folder and first.folder.name.endswith("_cathode-1")
    assert first.clean and first.missing == () and first.status == "complete" and first.volume is None
    assert instrument.last == third
    page = first._repr_html_()
    assert "cathode-1" in page and f"complete, {FRAMES} frames" in page and "counts" in page
    first.path.unlink()
    assert f"complete, {FRAMES} frames" in first._repr_html_() and "does not exist" in first._repr_html_()


def test_ctrl_c_ends_the_loop_and_keeps_the_data(connected: Connected, closed: list[FakeInstrument]) -> None:
    fake = FakeInstrument(at={8: lambda: signal.raise_signal(signal.SIGINT)})
    before, taken = signal.getsignal(signal.SIGINT), []
    with pytest.raises(api.ScanStopped), connected(fake) as instrument:
        for sample in ("a", "b", "c"):
            taken.append(sample)
            instrument.scan(sample=sample)
    assert taken == ["a"] and closed == [fake]
    assert signal.getsignal(signal.SIGINT) is before
    assert instrument.last is not None and instrument.last.status == "stopped"
    with open_scan(instrument.last.path) as source:
        assert source.finished and len(source.table.kinds) == instrument.last.frames < FRAMES


def test_a_second_ctrl_c_aborts(connected: Connected) -> None:
    fake = FakeInstrument(at={8: lambda: [signal.raise_signal(signal.SIGINT) for _ in range(2)]})
    with pytest.raises(api.ScanAborted), connected(fake) as instrument:
        instrument.scan()
    assert instrument.last is not None and instrument.last.frames == 9


def test_in_another_thread_a_request_stops_it_and_no_signal_is_caught(connected: Connected) -> None:
    stop, raised = api.StopRequest(), []
    fake = FakeInstrument(at={8: lambda: stop.stop("the button")})

    def work() -> None:
        with connected(fake) as instrument:
            try:
                instrument.scan(stop=stop)
            except api.ScanStopped as error:
                raised.append(str(error))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join(60)
    assert len(raised) == 1 and "the button" in raised[0]


def test_lost_frames_raise_what_the_command_says_and_leave_the_result(connected: Connected) -> None:
    with connected(FakeInstrument(Faults(lost={9}))) as instrument:
        with refused(api.DataError):
            instrument.scan()
        assert instrument.last is not None
        assert (instrument.last.missing, instrument.last.status, instrument.last.clean) == ((9,), "failed", False)
        assert instrument.scan(sample="next").clean  # the fault was of the first trigger of that number


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"scan.angles.views": 0}, "--set scan.angles.views=0"),
        ({"scan.angels": 3}, "--set scan.angels=3"),
        ({"sample.name": "a/b"}, "a/b"),
        ({"scan.period_s": object()}, "scan.period_s: "),
        ({"devices.stage.max_speed_deg_s": 3}, "belongs to devices that are open"),
        ({"simulation.seed": 3}, "belongs to devices that are open"),
        ({"scan.period_s": 1e-3}, "nothing was started"),
    ],
)
def test_a_wrong_value_starts_nothing(
    connected: Connected, tmp_path: Path, values: dict[str, object], said: str
) -> None:
    with connected() as instrument:
        with pytest.raises(api.ConfigError, match=said):
            instrument.scan(set=values)
        assert list(tmp_path.iterdir()) == [] and instrument.last is None
        assert instrument.scan(set={"devices.camera.readout": "ultra_quiet"}).clean


def test_a_closed_instrument_and_a_second_scan_at_a_time_are_refused(connected: Connected) -> None:
    said: list[str] = []

    def another() -> None:
        with refused(api.ConfigError):
            instrument.scan(sample="second")
        said.append("refused")

    with connected(FakeInstrument(at={3: another})) as instrument:
        assert instrument.scan().clean and said == ["refused"]
    with refused(api.ConfigError):
        instrument.scan()


def test_events_and_sentences_are_those_of_the_command(
    connected: Connected, capsys: pytest.CaptureFixture[str]
) -> None:
    heard: list[str] = []
    with connected() as instrument:
        instrument.scan(on_event=lambda event: heard.append(event.event))
        assert capsys.readouterr() == ("", "")
    with connected(say=api.to_stderr) as instrument:
        instrument.scan()
    assert {"run_started", "state", "scan_done", "done"} <= set(heard)
    out, err = capsys.readouterr()
    assert out == "" and f"Scan complete: {FRAMES} frames" in err


def test_without_a_live_reconstruction_it_says_that_nothing_is_decided(connected: Connected) -> None:
    said: list[str] = []
    words = {"scan.decide": "do", "recon.live": True, "scan.mode": "step", "scan.pass_views": 5}
    with connected(say=said.append, **words) as instrument:
        assert instrument.scan(live=False).clean
        instrument.scan(live=False, set={"scan.decide": "off"})
    sentence = "The scan follows its plan, because it has no live reconstruction, which scan.decide do needs."
    assert said.count(sentence) == 1


def test_importing_the_package_loads_nothing_heavy() -> None:
    heavy = {"torch", "numba", "matplotlib", "h5py", "pydantic", "click", "scipy"}
    code = f"import sys, beamline.api; print(sorted({heavy} & set(sys.modules)))"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert said.strip() == "[]"
    code = "import sys, beamline.api as api; api.connect; api.stream; print('torch' in sys.modules)"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert said.strip() == "False"
