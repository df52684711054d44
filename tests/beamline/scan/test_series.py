"""A series of states: one scan of each in one folder, with the darks and flats of the first, at planned times."""

import json
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from click.testing import CliRunner, Result

from beamline.cli.main import main
from beamline.config.load import config_folder, each_scan, load
from beamline.features.files.validate import validate
from beamline.scan.control import State, Verb, running, state_of, tell
from beamline.scan.dry_run import dry_run
from beamline.storage.readers.open import open_scan
from drivers.base.frame import FrameKind
from simulators.devices.camera import SimulatedOrcaQuest
from tests.clock import wait_until

VIEWS, STATES, EVERY = 16, 3, 40.0
DARKS, FLATS = 2, 4
FIRST = DARKS + FLATS + VIEWS  # frames of the first state


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A configuration of three states of a foam that settles."""
    tree = yaml.safe_load((config_folder() / "simulated.yaml").read_text("utf-8"))
    tree["sample"]["name"] = "ageing"
    tree["scan"] |= {
        "mode": "step",
        "angles": {"scheme": "fixed", "views": VIEWS, "start_deg": 0, "span_deg": 180},
        "states": {"count": STATES, "every_s": EVERY},
        "darks": {"count": DARKS},
        "flats": {"count": FLATS},
    }
    tree["devices"]["camera"]["roi"] = [1148, 2016, 4, 64]
    tree["recon"]["live"] = False
    tree["monitor"]["bands"]["alarm"] = 0.99
    solids = [{"kind": "cylinder", "radius": 0.1, "height": 1.0, "attenuation": 3.0}]
    scene = {"phantom": {"kind": "solids", "solids": solids}, "beam": {"photons_per_s": 1.0e5}}
    tree["simulation"] |= {"scene": scene | {"effects": ["photon_noise"]}, "clock": "virtual"}
    path = tmp_path_factory.mktemp("config") / "states.yaml"
    path.write_text(yaml.safe_dump(tree), "utf-8")
    return path


def beamline(*words: Any) -> Result:
    return CliRunner().invoke(main, [str(word) for word in words])


def stopped_at(monkeypatch: pytest.MonkeyPatch, frame: int, *signals: int) -> None:
    """Send signals to this process when the camera is asked for its n-th frame."""
    taken, take = [0], SimulatedOrcaQuest.next_frame

    def stopping(self: SimulatedOrcaQuest, timeout: float) -> Any:
        taken[0] += 1
        if taken[0] == frame:
            for number in signals:
                signal.raise_signal(number)
        return take(self, timeout)

    monkeypatch.setattr(SimulatedOrcaQuest, "next_frame", stopping)


def scans_of_states(series: Path) -> list[Path]:
    return [path for n in range(1, STATES + 1) for path in sorted(series.glob(f"*_state{n}/scan.h5"))]


def test_each_state_has_a_scan_of_its_own_at_its_time(config: Path, tmp_path: Path) -> None:
    done = beamline("scan", config, "-o", tmp_path, "--json")
    assert done.exit_code == 0, done.output
    (series,) = tmp_path.iterdir()
    assert series.name.endswith("_ageing_states")
    said = json.loads(done.stdout.splitlines()[-1])["scans"]
    assert [scan["state"] for scan in said] == [1, 2, 3]
    assert [Path(scan["path"]) for scan in said] == scans_of_states(series)
    angles, begun, references = list[float](), list[float](), list[np.ndarray]()
    for path in scans_of_states(series):
        assert not [finding for finding in validate(path) if finding.severity == "error"]
        with open_scan(path) as source:
            table = source.table
            assert table.of_kind(FrameKind.FLAT).size == FLATS and table.of_kind(FrameKind.DARK).size == DARKS
            assert table.times is not None
            angles += table.angles[table.views].tolist()
            begun.append(float(table.times[table.views][0]))
            references.append(source.read(np.concatenate([table.darks, table.flats])))
    assert all(np.array_equal(references[0], each) for each in references[1:])
    step = np.pi / VIEWS / STATES
    assert np.diff(np.sort(angles)) == pytest.approx(np.full(VIEWS * STATES - 1, step), abs=2e-5)
    assert np.diff(begun) == pytest.approx(np.full(STATES - 1, EVERY), abs=1.0)


def test_each_state_can_take_its_own_darks_and_flats(config: Path, tmp_path: Path) -> None:
    words = "--set", "scan.states.references=each", "--set", "scan.states.count=2"
    assert beamline("scan", config, "-o", tmp_path, *words).exit_code == 0
    (series,) = tmp_path.iterdir()
    flats = []
    for path in scans_of_states(series):
        with open_scan(path) as source:
            flats.append(source.read(source.table.flats))
    assert not np.array_equal(flats[0], flats[1])


def test_the_plan_counts_all_states_and_the_time_between_them(config: Path, tmp_path: Path) -> None:
    one = json.loads(beamline("check", config, "--json", "--set", "scan.states=null").stdout)
    all_ = json.loads(beamline("check", config, "--json").stdout)
    assert [each["state"] for each in all_["states"]] == [1, 2, 3] and one["states"] == []
    assert sum(each["total_bytes"] for each in all_["states"]) == STATES * one["total_bytes"]
    told = beamline("scan", config, "--dry-run", "-o", tmp_path / "none")
    assert "states    3, with one scan of this plan for each state, one every 0:00:40" in told.stdout, told.stdout
    assert not (tmp_path / "none").exists()
    needs = dry_run(load(config)).needs
    *_, last = (each["duration"] for each in all_["states"])
    assert needs.duration == pytest.approx((STATES - 1) * EVERY + last)
    own = dry_run(load(config, ["scan.states.references=each"])).needs.parts
    assert needs.parts["flat"] == pytest.approx(own["flat"] / STATES), "flats are copied"
    late = beamline("scan", config, "--dry-run", "--set", "scan.states.every_s=1").stdout
    assert "so the next state begins later than planned" in late
    rest = dry_run(load(config), complete=[1, 2])
    assert [need.state for need in rest.states] == [3] and rest.needs.duration == pytest.approx(last)


@pytest.mark.slow
@pytest.mark.parametrize("signals", [(signal.SIGINT,), (signal.SIGINT, signal.SIGINT)], ids=["stop", "abort"])
def test_a_series_that_ended_within_the_second_state_goes_on(
    config: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, signals: tuple[int, ...]
) -> None:
    with monkeypatch.context() as within:
        stopped_at(within, FIRST + VIEWS // 2, *signals)
        ended = beamline("scan", config, "-o", tmp_path)
    assert ended.exit_code in (4, 130), ended.output
    (series,) = tmp_path.iterdir()
    said = " ".join(ended.stderr.split())
    assert f"ended at state 2. `beamline scan --resume {series}` continues it." in said
    first, second = scans_of_states(series)
    before = first.read_bytes(), second.read_bytes()
    assert beamline("recover", series).exit_code == 0
    done = beamline("scan", "--resume", series, "--json")
    assert done.exit_code == 0, done.output
    assert (first.read_bytes(), second.read_bytes()) == before
    paths = [Path(scan["path"]) for scan in json.loads(done.stdout.splitlines()[-1])["scans"]]
    assert len(paths) == STATES and paths[1].name == "joined.h5"
    for path in paths:
        with open_scan(path) as source:
            assert source.table.views.size == VIEWS, path
            assert np.array_equal(source.read(source.table.flats[:1]), _first_flat(first))


def _first_flat(path: Path) -> np.ndarray:
    with open_scan(path) as source:
        return np.asarray(source.read(source.table.flats[:1]))


RUN = """
import sys
from beamline.cli.main import main
if __name__ == "__main__":
    main(sys.argv[1:])
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="kill -9")
def test_a_series_that_was_killed_between_two_states_goes_on(config: Path, tmp_path: Path) -> None:
    words = "--set", "scan.states.every_s=null", "--set", "scan.states.count=2"
    log = (tmp_path / "log").open("w")
    process = subprocess.Popen([sys.executable, "-c", RUN, "scan", str(config), "-o", str(tmp_path / "runs"), *words],
                               stdout=log, stderr=log, stdin=subprocess.DEVNULL)  # fmt: skip
    try:
        run = _waits(tmp_path / "runs", 2)
        series = run.parent
    finally:
        process.kill()
        process.wait()
        log.close()
    done = beamline("scan", "--resume", series, "--json")
    assert done.exit_code == 0, done.output
    paths = [Path(scan["path"]) for scan in json.loads(done.stdout.splitlines()[-1])["scans"]]
    assert [path.parent.name.rpartition("_state")[2][:1] for path in paths] == ["1", "2"]
    for path in paths:
        with open_scan(path) as source:
            assert source.table.views.size == VIEWS


def _waits(runs: Path, state: int) -> Path:
    """The run of a state that waits for its trigger."""
    found = list[Path]()

    def waits() -> bool:
        found[:] = [run for run in running(runs) if f"_state{state}" in run.name and state_of(run) is State.PAUSED]
        return bool(found)

    wait_until(waits, 120)
    return found[0]


@pytest.mark.slow
def test_a_state_waits_for_its_trigger(config: Path, tmp_path: Path) -> None:
    words = "--set", "scan.states.every_s=null", "--set", "scan.states.count=2"
    done = list[Result]()
    scan = threading.Thread(target=lambda: done.append(beamline("scan", config, "-o", tmp_path, *words)))
    scan.start()
    try:
        run = _waits(tmp_path, 2)
        with open_scan(run / "scan.h5", follow=True) as source:
            assert len(source.table) == 0
        time.sleep(0.3)
        assert state_of(run) is State.PAUSED
        assert tell(run, Verb.RESUME) is not State.PAUSED
    finally:
        scan.join(60)
    assert done[0].exit_code == 0, done[0].output
    assert "State 2 waits for its trigger" in (run / "user.log").read_text()


@pytest.mark.slow
def test_a_series_is_controlled_by_the_name_of_its_folder(config: Path, tmp_path: Path) -> None:
    words = "--set", "scan.states.every_s=null", "--set", "scan.states.count=2"
    done = list[Result]()
    scan = threading.Thread(target=lambda: done.append(beamline("scan", config, "-o", tmp_path, *words)))
    scan.start()
    try:
        run = _waits(tmp_path, 2)
        told = beamline("abort", run.parent)
        assert told.exit_code == 0, told.output
    finally:
        scan.join(60)
    assert done[0].exit_code == 130 and "before the first frame" in done[0].output
    assert beamline("scan", "--resume", run.parent).exit_code == 0


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("scan.states.count=1",), "scan.states.count"),
        (("scan.energies=[8.3, 8.4]",), "exclude each other"),
        (("scan.state=4",), "scan.state 4 is larger than the number of states in scan.states"),
        (("scan.states=null", "scan.state=1"), "leave out scan.state"),
        (("scan.darks.at=end",), "needs darks before the projections"),
        (("recon.live=true", "scan.decide=do"), "set scan.states to null"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(config: Path, tmp_path: Path, words: tuple[str, ...], said: str) -> None:
    ended = beamline("scan", config, "-o", tmp_path / "runs", *(part for word in words for part in ("--set", word)))
    assert ended.exit_code == 2, ended.output
    (line,) = ended.stderr.strip().splitlines()
    assert said in line
    assert not (tmp_path / "runs").exists()


def test_flats_of_both_ends_are_of_the_first_state(config: Path) -> None:
    first, *others = each_scan(load(config, ["scan.flats.at=both"]))
    assert first.scan.flats.at == "both" and {other.scan.flats.at for other in others} == {"start"}


def test_the_example_of_a_series_of_states_can_run() -> None:
    planned = dry_run(load(config_folder() / "states.yaml"))
    assert not planned.timeline.violations
    assert len(planned.states) == 4 and planned.state_interval == 20
    assert max(one.duration for one in planned.states) < 20


@pytest.mark.slow
def test_the_volumes_of_a_series_with_a_reference_are_made_after_the_last_state(
    config: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also those of states that were complete before the series was continued; a volume is made once."""
    asked = list[list[str]]()

    def reconstruct(words: list[str], log: Path, sink: Any, stop: Any) -> None:
        asked.append(words)
        Path(words[words.index("-o") + 1]).touch()

    reference = tmp_path / "good.h5"
    reference.touch()
    monkeypatch.setattr("beamline.scan.series.reconstruct", reconstruct)
    monkeypatch.setattr("beamline.scan.live_process.follow_command", lambda *_: lambda *_: [sys.executable, "-c", ""])
    words = "--reference", reference, "--set", "recon.live=true", "--set", "scan.states.count=2"
    with monkeypatch.context() as within:
        stopped_at(within, FIRST + VIEWS // 2, signal.SIGINT)
        assert beamline("scan", config, "-o", tmp_path / "runs", *words).exit_code == 4
    assert not asked
    (series,) = (tmp_path / "runs").iterdir()
    assert beamline("scan", "--resume", series).exit_code == 0
    outputs = [Path(command[command.index("-o") + 1]).parent.name.rpartition("_")[2] for command in asked]
    assert outputs == ["state1", "state2"]
    next(series.glob("*_state2")).joinpath("recon.h5").unlink()
    assert beamline("scan", "--resume", series).exit_code == 0
    assert len(asked) == 3 and "_state2" in asked[2][4]
    assert all("from-reference" in command and "--follow" not in command for command in asked)
