"""A page that is served, and requests to it as a browser, or an attacker, would send them."""

from __future__ import annotations

import http.client
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from beamline.page.run_files import Reader, watched
from beamline.page.serve import Addresses, open_port, start


class Served:
    """The server of a run or file, in a thread."""

    def __init__(self, addresses: Addresses, log: list[str]) -> None:
        self.addresses, self.log = addresses, log
        self.host = addresses.look.split("/")[2]
        self.token = addresses.look.partition("token=")[2]

    def ask(
        self, path: str, method: str = "GET", *, token: str | None = None, headers: Mapping[str, str] | None = None
    ) -> tuple[int, Mapping[str, str], bytes]:
        """Status, headers and body of the answer."""
        cookie = {"Cookie": f"splatline_look={self.token if token is None else token}"}
        connection = http.client.HTTPConnection(self.host, timeout=20)
        connection.request(method, path, headers={**cookie, **(headers or {})})
        answer = connection.getresponse()
        body = answer.read()
        connection.close()
        return answer.status, {name.lower(): value for name, value in answer.getheaders()}, body


@contextmanager
def served(path: Path, *, control: bool = False) -> Iterator[Served]:
    log: list[str] = []
    reader = Reader(watched(path))
    server = start(reader, open_port("127.0.0.1", 0), control=control, log=log.append)
    thread = threading.Thread(target=server.run)
    thread.start()
    try:
        yield Served(server.addresses, log)
    finally:
        server.stop()
        thread.join()
        reader.close()
