"""The page of a folder of runs, and its list on the terminal."""

from __future__ import annotations

import json
import os
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from beamline.page.followed_run import FollowedRun
from beamline.page.run_files import EventLog
from beamline.scan.resume import recover_run
from beamline.scan.runs import describe
from beamline.storage.interrupted import next_step
from beamline.storage.run_record import RunRecord, write_record
from tests.beamline.cli.small_scan import beamline
from tests.beamline.fakes import FakeInstrument
from tests.beamline.features.page.served import Served, listed, served
from tests.beamline.features.page.test_app import page_feed, tile
from tests.beamline.features.run_folder import write_run
from tests.beamline.ran import Ran, ended_run
from tests.beamline.scans import TwoCylinders

SCAN = TwoCylinders()
EVIL = "<img src=x>"


def made(folder: Path, day: int, sample: str) -> Path:
    """A run of a day, which was stopped before it had all its frames."""
    run = write_run(folder / f"202601{day:02d}T120000Z_s")
    write_record(run, RunRecord("stopped", True, sample, 49, planned=60))
    return run


def rows(page: Served) -> list[dict[str, Any]]:
    return list(json.loads(page.ask("/api/runs")[2])["rows"])


def test_the_table_is_that_of_the_terminal_newest_first(tmp_path: Path) -> None:
    made(tmp_path, 1, "first")
    with listed(tmp_path) as page:
        (before,) = rows(page)
        made(tmp_path, 2, EVIL)
        newer, older = rows(page)
    assert older == before  # its number stays, so that a link does
    assert before["cells"][1:4] == ["first", "49 of 60", "stopped"]
    assert newer["cells"][1] == EVIL
    assert newer["number"] != older["number"]


@pytest.mark.parametrize(("end", "recovered"), [("killed", False), ("killed", True), ("aborted", False)])
def test_a_run_that_ended_early_has_the_state_the_frames_and_the_next_step_that_commands_tell(
    tmp_path: Path, end: str, recovered: bool
) -> None:
    run = ended_run(tmp_path, end, at=9)
    if recovered:
        recover_run(run)
    told, advice = describe(run), next_step(run / "scan.h5")
    with served(run) as page, page_feed(page) as feed:
        state = json.loads(next(line for line in feed if line.startswith(b'data: {"frames"'))[6:])
    assert (state["status"], state["frames"], state["next"]) == (told.state, told.frames, advice)
    assert "--resume" in advice and (told.state == "died") == ("beamline recover" in advice)
    with listed(tmp_path) as page:
        assert [row["next"] for row in rows(page)] == [told.next_step]
    with closing(FollowedRun(tmp_path)) as followed:
        values = followed.look().values
    assert (values.state, values.message == advice) == (told.state, end == "killed")


def test_each_run_has_its_page(tmp_path: Path) -> None:
    folders = [made(tmp_path, day, f"sample {day}") for day in (1, 2, 3)]
    with listed(tmp_path) as page:
        for row, run in zip(rows(page), reversed(folders), strict=True):
            root = f"/run/{row['number']}"
            assert b"main.js" in page.ask(f"{root}/")[2]
            assert json.loads(page.ask(f"{root}/api/facts")[2])["run"] == run.name
            assert tile(page.ask(f"{root}/api/frame/10?corrected=0")[2])[1].shape == SCAN.shape


def test_a_page_of_a_run_has_the_same_rules(tmp_path: Path) -> None:
    made(tmp_path, 1, "s")
    with listed(tmp_path) as page:
        (row,) = rows(page)
        root = f"/run/{row['number']}"
        for path in ("/", "/api/runs", f"{root}/", f"{root}/api/frame/0", f"{root}/api/feed"):
            assert page.ask(path, token="")[0] == 403
            assert page.ask(path, headers={"Host": "evil.example"})[0] == 421
        headers = page.ask(f"{root}/api/facts")[1]
        assert headers["content-security-policy"].startswith("default-src 'self'")
        assert page.ask(f"{root}/api/verb/stop", "POST", headers={"Origin": f"http://{page.host}"})[0] == 403
        for path in ("/run/7/api/facts", "/run/../api/facts/", "/run/x/", f"/run/%2e%2e/{tmp_path.name}/"):
            assert page.ask(path)[0] == 404


def test_who_records_runs_may_act_on_these_alone(tmp_path: Path) -> None:
    """And the table leads to the newest of them, whatever runs others record in the folder."""
    first, foreign = made(tmp_path, 1, "first"), made(tmp_path, 9, "of another process")
    own: list[Path] = []
    with listed(tmp_path, own) as page:

        def newest() -> int | None:
            number: int | None = json.loads(page.ask("/api/runs")[2])["newest"]
            return number

        def told(run: Path) -> tuple[bool, int]:
            """Whether its page says that it may act, and the status of an answer to a stop."""
            numbers = {row["cells"][-1]: row["number"] for row in rows(page)}
            root = f"/run/{numbers[run.name]}"
            act = (page.addresses.act or "").partition("#act=")[2]
            headers = {"Origin": f"http://{page.host}", "X-Act-Token": act}
            answer = page.ask(f"{root}/api/verb/stop", "POST", headers=headers)
            return json.loads(page.ask(f"{root}/api/facts")[2])["may_act"], answer[0]

        assert newest() is None and told(first) == told(foreign) == (False, 403)
        own.append(first)
        assert told(first) == (True, 404)  # it does not run any more
        assert told(foreign) == (False, 403)
        numbers = {row["cells"][-1]: row["number"] for row in rows(page)}
        assert newest() == numbers[first.name]
        own.append(made(tmp_path, 5, "second"))
        rows(page)
        assert newest() == 2


SECRET = b"-----BEGIN PRIVATE KEY-----"


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="links and pipes take rights on Windows")
def test_a_page_gives_out_what_lies_in_the_folders_of_runs_and_nothing_else(tmp_path: Path) -> None:
    secret = made(tmp_path, 9, "private")
    (secret / "recon.live.png").write_bytes(SECRET)
    folder = tmp_path / "runs"
    folder.mkdir()
    picture, piped, log = (made(folder, day, f"run {day}") for day in (1, 2, 4))
    (picture / "recon.live.png").symlink_to(secret / "recon.live.png")
    os.mkfifo(piped / "recon.live.png")
    os.mkfifo(piped / "recon.h5")
    (log / "events.jsonl").unlink()
    (log / "events.jsonl").symlink_to(secret / "events.jsonl")
    with listed(folder) as page:
        found = rows(page)
        assert [row["cells"][1] for row in found] == ["run 2", "run 1"]
        for row in found:
            root = f"/run/{row['number']}"
            assert page.ask(f"{root}/api/model.png")[0] == 404
            answers = [page.ask(f"{root}{path}") for path in ("/api/facts", "/api/frame/1", "/view/api/volumes")]
            assert all(b"private" not in body and SECRET not in body for _, _, body in answers)
            assert answers[0][0] == 200
        (picture / "recon.live.png").unlink()
        (picture / "recon.live.png").write_bytes(b"PNG")
        assert page.ask(f"/run/{found[-1]['number']}/api/model.png")[2] == b"PNG"
        for path in (
            "/run/{}/",
            "/run/0/api/frame/{}",
            "/run/0/view/api/slice/{}/0/0",
            "/run/0/view/api/profile/0/0/{}",
        ):
            assert page.ask(path.format("9" * 5000))[0] == 404
        assert page.ask(f"/run/0/api/columns?first={'9' * 5000}", headers={"Last-Event-ID": "9" * 5000})[0] == 200


def test_a_log_is_read_without_its_bad_lines(tmp_path: Path) -> None:
    good = [
        '{"event": "state", "time": 1.0, "state": "darks", "message": "first"}',
        '{"event": "warning", "time": 2.0}',
    ]
    bad = ['{"event": "frame", "time": "x"}', "[" * 100_000, "no JSON", '{"event": "state",\r"time": 1.0}']
    (tmp_path / "events.jsonl").write_bytes("\n".join([good[0], *bad, good[1], good[0][:20]]).encode())
    log = EventLog(tmp_path)
    log.refresh()
    assert (log.lines, log.skipped) == (good, len(bad))
    with (tmp_path / "events.jsonl").open("ab") as file:
        file.write(good[0][20:].encode() + b"\n")
    log.refresh()
    assert log.lines[2:] == [good[0]]


def test_a_line_a_run_newest_first(tmp_path: Path) -> None:
    Ran(tmp_path, FakeInstrument(), "sample.name=cathode-3")
    (tmp_path / "2020-01-02T03-04-05_\x1b[31mred").mkdir()
    (tmp_path / "2020-01-02T03-04-05_\x1b[31mred" / "events.jsonl").touch()
    result = beamline("runs", str(tmp_path))
    head, first, second = result.stdout.splitlines()
    assert result.exit_code == 0
    assert head.split()[:3] == ["time", "(UTC)", "sample"]
    assert first.split()[2:5] == ["cathode-3", "19", "done"] and first.endswith("_cathode-3")
    assert second.startswith("2020-01-02 03:04:05  \\x1b[31mred") and "\x1b" not in result.stdout
    (line,) = beamline("runs", str(tmp_path), "--json").stdout.splitlines()
    done = json.loads(line)
    assert done["event"] == "done"
    assert [(run["sample"], run["frames"], run["state"]) for run in done["runs"]] == [
        ("cathode-3", 19, "done"), ("\x1b[31mred", None, "not known"),
    ]  # fmt: skip


def test_no_run_is_no_error_and_no_folder_is_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    result = beamline("runs")
    assert result.exit_code == 2 and "the folder runs does not exist" in result.stderr
    (tmp_path / "runs").mkdir()
    result = beamline("runs")
    assert (result.exit_code, result.stdout) == (0, "") and "no runs in runs" in result.stderr
