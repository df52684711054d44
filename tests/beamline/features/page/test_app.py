"""Who may see a page and send commands from it; content of its answers."""

import http.client
import json
import socket
import struct
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest

from beamline.core.stop import PauseRequest, StopRequest
from beamline.features.page.serve import CONNECTIONS, open_port
from beamline.monitor.check import Level
from beamline.page.recording import Recording
from beamline.scan.control import commands_taken
from beamline.storage.run_record import RunRecord, write_record
from beamline.storage.volumes.base import bare_record
from beamline.storage.volumes.files import write_volume
from tests.beamline.features.page.served import Served, served
from tests.beamline.features.run_folder import asking, write_run
from tests.beamline.scans import TwoCylinders, frames_of, write_flagged

SCAN = TwoCylinders()


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    (folder / "events.jsonl").write_text('{"event": "run_started", "time": 1.0, "n_frames": 49, "sample": "<b>x"}\n')
    write_flagged(folder / "scan.h5", frames_of(SCAN), {7: Level.WARN})
    return folder


@pytest.fixture(scope="module")
def page(run: Path) -> Iterator[Served]:
    with served(run) as page:
        yield page


def tile(body: bytes) -> tuple[dict[str, object], np.ndarray]:
    (length,) = struct.unpack("<I", body[:4])
    head = json.loads(body[4 : 4 + length])
    numbers = np.frombuffer(body[4 + length :], "<u2").reshape(head["shape"])
    return head, head["offset"] + head["scale"] * numbers


def act(page: Served, verb: str, **headers: str) -> int:
    return page.ask(
        f"/api/verb/{verb}", "POST", headers={name.replace("_", "-"): value for name, value in headers.items()}
    )[0]


def test_nothing_is_answered_without_the_token(page: Served) -> None:
    for path in ("/", "/static/main.js", "/api/facts", "/api/frame/0", "/api/feed"):
        assert page.ask(path, token="")[0] == page.ask(path, token="0" * 32)[0] == 403
    assert page.ask("/?token=" + "0" * 32, token="")[0] == 403


def test_the_printed_address_gives_a_cookie_that_no_script_and_no_other_site_uses(page: Served) -> None:
    status, headers, _ = page.ask("/?token=" + page.token, token="")
    assert (status, headers["location"]) == (303, "/")
    assert {"httponly", "samesite=strict"} <= set(headers["set-cookie"].lower().split("; "))


def test_a_second_page_on_this_machine_leaves_the_first_one_its_cookie(page: Served, run: Path) -> None:
    with served(run) as other:
        names = {
            each.ask(f"/?token={each.token}", token="")[1]["set-cookie"].partition("=")[0] for each in (page, other)
        }
    assert len(names) == 2


def test_another_name_that_leads_here_is_refused(page: Served) -> None:
    assert page.ask("/api/facts", headers={"Host": "evil.example"})[0] == 421


def test_every_answer_forbids_foreign_content(page: Served) -> None:
    for path in ("/", "/static/main.js", "/api/facts", "/api/frame/99999"):
        headers = page.ask(path)[1]
        assert headers["content-security-policy"].startswith("default-src 'self'")
        assert headers["x-content-type-options"] == "nosniff"
        assert "access-control-allow-origin" not in headers


def test_files_outside_of_the_page_are_not_served(page: Served) -> None:
    for path in ("/static/../app.py", "/static/%2e%2e/app.py", "/static//etc/passwd", "/scan.h5"):
        assert page.ask(path)[0] == 404


def test_acting_takes_its_own_token_and_our_own_origin(run: Path) -> None:
    with served(run, control=True) as page:
        token, ours = str(page.addresses.act).partition("#act=")[2], f"http://{page.host}"
        assert act(page, "stop") == 403
        assert act(page, "stop", X_Act_Token=token) == 403
        assert act(page, "stop", X_Act_Token=token, Origin="http://evil.example") == 403
        assert act(page, "stop", X_Act_Token=page.token, Origin=ours) == 403
        assert act(page, "fire", X_Act_Token=token, Origin=ours) == 404
        assert act(page, "stop%0Aroot%1b%5b2J%0astop,%20asked%20for") == 403
        assert act(page, "stop", X_Act_Token=token, Origin=ours) == 404  # no scan runs there
        assert page.ask("/api/verb/stop", headers={"X-Act-Token": token, "Origin": ours})[0] == 405
    assert page.log.pop(4).startswith("not executed: an unknown command, requested by 127.0.0.1")
    assert [line.split(",")[0] for line in page.log] == ["not executed: stop"] * 4 + ["stop"]


def test_a_choice_reaches_a_scan_that_asks_and_no_other(tmp_path: Path) -> None:
    write_run(tmp_path)
    with served(tmp_path, control=True) as page:
        assert page.addresses.act is not None
        headers = {"x_act_token": str(page.addresses.act).partition("act=")[2], "origin": f"http://{page.host}"}
        with asking(tmp_path) as answers:
            assert act(page, "again") == 403 and answers == []
            assert act(page, "again", **headers) == 200 and answers == ["again"]
            assert act(page, "enough", **headers) == 404 and answers == ["again"]  # it asks no more


@pytest.mark.parametrize("sent", [b"", b"GET / HTTP/1.1\r\nHost: ", b"GET / HTTP/1.1\r\nHost: x\r\n\r\n"])
def test_connections_without_the_token_lock_nobody_out(
    run: Path, sent: bytes, capfd: pytest.CaptureFixture[str]
) -> None:
    """Three times as many as are kept, which say nothing, stop in the middle of a request, or stay after an answer.

    The owner's connections stay, and need not be made anew.
    """
    with served(run, control=True) as page, ExitStack() as stack:
        host, port = page.host.rsplit(":", 1)
        kept = stack.enter_context(closing(http.client.HTTPConnection(page.host, timeout=20)))
        asked_by(kept, page)
        with page_feed(page) as feed:
            opened = [stack.enter_context(socket.create_connection((host, int(port)))) for _ in range(3 * CONNECTIONS)]
            for connection in opened:
                with suppress(OSError):  # closed for a later one
                    connection.sendall(sent)
            begin = time.monotonic()
            assert page.ask("/api/facts")[0] == 200
            assert act(page, "stop") == 403  # without the token for acting
            asked_by(kept, page)
            assert time.monotonic() - begin < 2
            assert feed.read(1)  # a page that is open stays so
    assert len(capfd.readouterr().err) < 1000


def asked_by(connection: http.client.HTTPConnection, page: Served) -> None:
    connection.request("GET", "/api/facts", headers={"Cookie": f"{page.cookie}={page.token}"})
    assert (answer := connection.getresponse()).status == 200 and answer.read()


@contextmanager
def page_feed(page: Served) -> Iterator[http.client.HTTPResponse]:
    """The feed of events of a page that is open."""
    with closing(http.client.HTTPConnection(page.host, timeout=20)) as connection:
        connection.request("GET", "/api/feed", headers={"Cookie": f"{page.cookie}={page.token}"})
        yield connection.getresponse()


def test_a_page_without_control_has_no_token_for_acting(page: Served) -> None:
    assert page.addresses.act is None
    assert act(page, "stop", X_Act_Token="", Origin=f"http://{page.host}") == 403


def test_a_frame_comes_as_numbers(page: Served) -> None:
    head, values = tile(page.ask("/api/frame/10?corrected=0")[2])
    part, _ = tile(page.ask("/api/frame/10?corrected=0&region=1,3,5,20")[2])
    assert (head["frame"], head["bin"], head["region"]) == (10, 1, [0, 4, 0, 40])
    assert part["region"] == [1, 3, 5, 20]
    np.testing.assert_allclose(values, SCAN.counts()[6], atol=0.51 * float(str(head["scale"])))


@pytest.mark.parametrize("query", ["region=x", "region=1,2", "region=-1,2,3,4", "region=9999999999,1,1,1"])
def test_an_invalid_region_means_the_whole_frame(page: Served, query: str) -> None:
    assert tile(page.ask(f"/api/frame/10?{query}")[2])[0]["region"] == [0, 4, 0, 40]


def test_what_is_not_there_is_a_sentence(page: Served) -> None:
    status, _, body = page.ask("/api/frame/999")
    assert (status, "not in the file" in json.loads(body)["message"]) == (404, True)
    status, _, body = page.ask("/view/api/volumes")
    assert (status, json.loads(body)["message"]) == (404, "There is no volume yet.")


def test_a_stop_does_not_wait_for_other_requests(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All threads that answer requests are busy with a file that does not answer."""
    write_run(tmp_path)
    write_record(tmp_path, RunRecord("stopped", True))  # how it answers
    free, stop = threading.Event(), StopRequest()
    monkeypatch.setattr(Recording, "facts", lambda file: {"free": free.wait(60)})
    with (
        served(tmp_path, control=True) as page, commands_taken(tmp_path, stop, PauseRequest()),
        ThreadPoolExecutor(61) as pool,
    ):  # fmt: skip
        others = [pool.submit(page.ask, "/api/facts") for _ in range(60)]
        assert page.addresses.act is not None
        pool.submit(
            act, page, "stop", x_act_token=str(page.addresses.act).partition("act=")[2], origin=f"http://{page.host}"
        )
        deadline = time.monotonic() + 15
        while not stop.stopping and time.monotonic() < deadline:
            time.sleep(0.01)
        assert stop.stopping and not any(other.done() for other in others)
        free.set()


def test_the_feed_tells_each_event_once_also_after_a_lost_connection(page: Served) -> None:
    def first_lines(page: Served, last: str, n: int) -> list[str]:
        connection = http.client.HTTPConnection(page.host, timeout=20)
        headers = {"Cookie": f"{page.cookie}={page.token}", **({"Last-Event-ID": last} if last else {})}
        connection.request("GET", "/api/feed", headers=headers)
        answer = connection.getresponse()
        lines = [answer.readline().decode().strip() for _ in range(n)]
        connection.close()
        return lines

    assert first_lines(page, "", 2) == ["id: 0", "event: run"]
    assert first_lines(page, "0", 1) == ["event: state"]


def test_a_server_ends_without_a_word_while_a_page_is_open(run: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with served(run) as page:
        connection = http.client.HTTPConnection(page.host, timeout=20)
        connection.request("GET", "/api/feed", headers={"Cookie": f"{page.cookie}={page.token}"})
        answer = connection.getresponse()
        answer.readline()
    assert answer.read().endswith(b"event: end\ndata: {}\n\n")
    connection.close()
    assert capfd.readouterr().err == ""


def test_a_taken_port_gives_way_to_the_next(tmp_path: Path) -> None:
    with open_port("127.0.0.1", 0) as first, open_port("127.0.0.1", first.getsockname()[1]) as second:
        assert first.getsockname()[1] < second.getsockname()[1] <= first.getsockname()[1] + 9


def test_the_volume_of_a_run_is_shown_once_it_is_there(tmp_path: Path) -> None:
    values = np.arange(60, dtype=np.float32).reshape(3, 4, 5)
    write_run(tmp_path)
    write_volume(tmp_path / "recon.h5", bare_record(tmp_path / "scan.h5", values, (0.2, 0.1, 0.1)))
    with served(tmp_path) as page:
        (facts,) = json.loads(page.ask("/view/api/volumes")[2])
        assert (facts["shape"], facts["length_unit"], facts["unit"]) == ([3, 4, 5], "mm", "1/mm")
        assert facts["voxel"] == pytest.approx([0.2, 0.1, 0.1])
        np.testing.assert_allclose(tile(page.ask("/view/api/slice/0/2/4")[2])[1], values[:, :, 4], atol=1e-3)
        assert b"view.js" in page.ask("/view/")[2]
        write_volume(tmp_path / "recon.h5", bare_record(tmp_path / "scan.h5", values[:2]), replace=True)
        assert json.loads(page.ask("/view/api/volumes")[2])[0]["shape"] == [2, 4, 5]
