"""A served page, with requests as a browser or an attacker would send them."""

from __future__ import annotations

import http.client
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path

from beamline.features.page.app import page, viewer
from beamline.features.page.serve import Addresses, PageServer, RunBrowser, open_port, start
from beamline.page.run_files import Reader, watched
from beamline.page.volume import HELD, ShownVolume


class Served:
    """The server of a run or file, in a thread."""

    def __init__(self, addresses: Addresses, log: list[str]) -> None:
        self.addresses, self.log = addresses, log
        self.host = addresses.look.split("/")[2]
        self.token = addresses.look.partition("token=")[2]
        self.cookie = f"splatline_look_{self.host.rpartition(':')[2]}"

    def ask(
        self, path: str, method: str = "GET", *, token: str | None = None, headers: Mapping[str, str] | None = None
    ) -> tuple[int, Mapping[str, str], bytes]:
        """Status, headers and body of the answer."""
        cookie = {"Cookie": f"{self.cookie}={self.token if token is None else token}"}
        connection = http.client.HTTPConnection(self.host, timeout=20)
        connection.request(method, path, headers={**cookie, **(headers or {})})
        answer = connection.getresponse()
        body = answer.read()
        connection.close()
        return answer.status, {name.lower(): value for name, value in answer.getheaders()}, body


@contextmanager
def viewed(*paths: Path, held: int = HELD) -> Iterator[Served]:
    """The viewer of volumes."""
    with ExitStack() as opened:
        volumes = [opened.enter_context(closing(ShownVolume(path, held=held))) for path in paths]
        yield opened.enter_context(_running(start(lambda access: viewer(volumes, access), open_port("127.0.0.1", 0))))


@contextmanager
def listed(folder: Path, own: Sequence[Path] | None = None) -> Iterator[Served]:
    """The page of a folder of runs; own: beside the program that records these."""
    with ExitStack() as opened:
        runs = opened.enter_context(closing(RunBrowser(folder, () if own is None else own)))
        server = start(runs.app, open_port("127.0.0.1", 0), control=own is not None)
        yield opened.enter_context(_running(server))


@contextmanager
def served(path: Path, *, control: bool = False) -> Iterator[Served]:
    """The page of a run or scan file."""
    log: list[str] = []
    reader = Reader(watched(path))
    try:
        server = start(lambda access: page(reader, access, log.append), open_port("127.0.0.1", 0), control=control)
        with _running(server, log) as found:
            yield found
    finally:
        reader.close()


@contextmanager
def _running(server: PageServer, log: list[str] | None = None) -> Iterator[Served]:
    thread = threading.Thread(target=server.run)
    thread.start()
    try:
        yield Served(server.addresses, [] if log is None else log)
    finally:
        server.stop()
        thread.join()
