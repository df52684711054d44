"""The page's server: files of the page, the feed of events, tiles, and verbs for who may act.

A browser is a hostile place: any page that is open beside this one can send requests to it. So each request names a
host that is ours and carries the token for looking (a cookie). Actions are POST requests of our own origin with the
token for acting in a header. No data of a client reach the file system.
"""

from __future__ import annotations

import asyncio
import json
import secrets
import time
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import suppress
from dataclasses import astuple, dataclass, field
from functools import lru_cache, partial
from importlib.resources import files
from typing import Any

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, RedirectResponse, Response, StreamingResponse
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Receive, Scope, Send

from beamline.core.errors import BeamlineError, user_message
from beamline.page.recording import Recording
from beamline.page.run_files import PICTURE, Reader
from beamline.page.tiles import TileRegion, pack
from beamline.page.volume import ShownVolume
from beamline.scan.control import Verb, tell

COOKIE = "splatline_look"
ACT_HEADER = "x-act-token"
_PERIOD = 0.5  # s between two checks of the file for the feed
_KEPT = 64  # tiles kept for the next client
_HEADERS = {
    b"content-security-policy": b"default-src 'self'; img-src 'self' blob:; object-src 'none'; base-uri 'none'; "
    b"form-action 'none'; frame-ancestors 'none'",
    b"x-content-type-options": b"nosniff",
    b"referrer-policy": b"no-referrer",
    b"cross-origin-opener-policy": b"same-origin",
    b"cross-origin-resource-policy": b"same-origin",
    b"cache-control": b"no-store",
}


@dataclass(frozen=True)
class Access:
    """Who may do what."""

    hosts: Sequence[str]  # what a browser may call this server, each with the port, as in `localhost:8642`
    look: str = field(default_factory=partial(secrets.token_hex, 16))  # the token for looking
    act: str | None = None  # the token for verbs to the scan; None: nobody may act from the page


class Guard:
    """Sets the headers of every answer, and refuses requests to another host, or without the token for looking."""

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self._app, self._access = app, access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        async def send_with_headers(message: Any) -> None:
            if message["type"] == "http.response.start":
                given = [(name, value) for name, value in message["headers"] if name.lower() not in _HEADERS]
                message = {**message, "headers": [*given, *_HEADERS.items()]}
            await send(message)

        request = Request(scope)
        if request.headers.get("host") not in self._access.hosts:  # a foreign name that leads here
            await Response("Not a name of this server.\n", 421, media_type="text/plain")(scope, receive, send)
        elif _same(request.cookies.get(COOKIE, ""), self._access.look):
            await self._app(scope, receive, send_with_headers)
        elif request.url.path == "/" and _same(request.query_params.get("token", ""), self._access.look):
            answer: Response = RedirectResponse("/", 303)
            answer.set_cookie(COOKIE, self._access.look, httponly=True, samesite="strict")
            await answer(scope, receive, send_with_headers)
        else:
            text = "This page needs the token in the address that was printed at its start.\n"
            await Response(text, 403, media_type="text/plain")(scope, receive, send_with_headers)


def _same(given: str, expected: str) -> bool:
    return secrets.compare_digest(given.encode(), expected.encode())


def page(reader: Reader, access: Access, log: Callable[[str], None]) -> Starlette:
    """The application. `log`: takes a line for each verb that was sent, with the client's address."""
    server = _Server(reader, access, log)
    routes = [
        Route("/api/facts", server.facts),
        Route("/api/feed", server.feed),
        Route("/api/columns", server.columns),
        Route("/api/flags", server.flags),
        Route("/api/frame/{frame:int}", server.frame),
        Route("/api/sinogram", server.sinogram),
        Route("/api/trace", server.trace),
        Route("/api/volume", server.volume),
        Route("/api/slice/{axis:int}/{index:int}", server.cut),
        Route("/api/model.png", server.model),
        Route("/api/verb/{verb}", server.verb, methods=["POST"]),
    ]
    return guarded("index.html", routes, access)


def guarded(start: str, routes: Sequence[Route], access: Access) -> Starlette:
    """An application of these answers that begins with a page of `static`, behind the guard."""
    static = files("beamline.page") / "static"
    pages = [
        Route("/", lambda request: FileResponse(str(static / start))),
        Mount("/static", StaticFiles(directory=str(static))),
    ]
    return Starlette(
        routes=[*pages, *routes],
        middleware=[Middleware(Guard, access=access)],
        exception_handlers={BeamlineError: _refused},
    )


def _refused(request: Request, error: Exception) -> Response:
    """What no file gives, as a sentence."""
    return JSONResponse({"message": user_message(error)}, 404)


class _Server:
    """Answers requests; Starlette calls what is not a coroutine in a thread of its own."""

    def __init__(self, reader: Reader, access: Access, log: Callable[[str], None]) -> None:
        self._reader, self._access, self._log = reader, access, log
        self._picture = lru_cache(_KEPT)(self._tile_of)  # pixels of a frame never change
        self._state: dict[str, Any] = {}
        self._looked = 0.0
        self._looking = asyncio.Lock()

    def facts(self, request: Request) -> Response:
        facts = self._reader.do(Recording.facts)
        return JSONResponse({**facts, "run": self._reader.what.name, "may_act": self._access.act is not None})

    async def feed(self, request: Request) -> Response:
        """Server-sent events: each event of the run with its number as id, and `state` whenever it changes."""
        last = request.headers.get("last-event-id", "")
        return StreamingResponse(self._feed(int(last) + 1 if last.isdecimal() else 0), media_type="text/event-stream")

    async def _feed(self, first: int) -> AsyncIterator[str]:
        said = ""
        while True:
            state = await self._now()
            lines = self._reader.events.lines
            for number in range(first, len(lines)):
                yield f"id: {number}\nevent: run\ndata: {lines[number]}\n\n"
            first = max(first, len(lines))
            now = json.dumps(state)
            if now != said:
                said = now
                yield f"event: state\ndata: {now}\n\n"
            await asyncio.sleep(_PERIOD)

    async def _now(self) -> dict[str, Any]:
        """The state, looked at once for all clients."""
        async with self._looking:
            if time.monotonic() - self._looked > _PERIOD / 2:
                self._state = await run_in_threadpool(self._reader.state)
                self._looked = time.monotonic()
        return self._state

    def columns(self, request: Request) -> Response:
        return JSONResponse(self._reader.do(lambda recording: recording.columns(_number(request, "first"))))

    def flags(self, request: Request) -> Response:
        return JSONResponse(self._reader.do(Recording.flags))

    def frame(self, request: Request) -> Response:
        frame, corrected = int(request.path_params["frame"]), request.query_params.get("corrected") == "1"
        return self._picture(frame, region_of(request), corrected)

    def _tile_of(self, frame: int, region: TileRegion, corrected: bool) -> Response:
        values, shown, factor = self._reader.do(lambda file: file.picture(frame, region, corrected=corrected))
        return tile_of(values, {"frame": frame, "region": astuple(shown), "bin": factor})

    def sinogram(self, request: Request) -> Response:
        row, first = _number(request, "row"), _number(request, "first")
        lines, views, factor = self._reader.do(lambda file: file.sinogram(row, first))
        return tile_of(lines, {"views": views.tolist(), "bin": factor})

    def trace(self, request: Request) -> Response:
        region, first = region_of(request), _number(request, "first")
        values = self._reader.do(lambda recording: recording.trace(region, first))
        return JSONResponse({"first": first, "values": values})

    def volume(self, request: Request) -> Response:
        return JSONResponse(self._reader.on_volume(ShownVolume.facts))

    def cut(self, request: Request) -> Response:
        axis, index = int(request.path_params["axis"]), int(request.path_params["index"])
        values, _, factor = self._reader.on_volume(lambda volume: volume.cut(axis, index, region_of(request)))
        return tile_of(values, {"axis": axis, "index": index, "bin": factor})

    def model(self, request: Request) -> Response:
        """The live picture: newest view, the volume seen from there, their difference in noise."""
        folder, picture = self._reader.what.folder, b""
        if folder is not None:
            with suppress(OSError):
                picture = (folder / PICTURE).read_bytes()
        return Response(picture, media_type="image/png") if picture else Response(status_code=404)

    def verb(self, request: Request) -> Response:
        folder, act = self._reader.what.folder, self._access.act
        name, client = request.path_params["verb"], request.client.host if request.client else "?"
        ours = f"{request.url.scheme}://{request.headers.get('host', '')}"
        if act is None or request.headers.get("origin") != ours or not _same(request.headers.get(ACT_HEADER, ""), act):
            self._log(f"refused: {name} from {client}, without the token for acting")
            return JSONResponse({"message": "Only who holds the address for acting may do this."}, 403)
        if folder is None or name not in [str(verb) for verb in Verb]:
            return JSONResponse({"message": f"There is nothing here that can be told to {name}."}, 404)
        self._log(f"{name}, asked for from {client}")
        return JSONResponse({"state": str(tell(folder, Verb(name)))})


def tile_of(values: Any, facts: dict[str, Any]) -> Response:
    """A header in JSON, its length before it as u4, and the numbers of `tiles.Packed`."""
    packed = pack(values)
    head = json.dumps({**facts, "shape": packed.numbers.shape, "offset": packed.offset, "scale": packed.scale})
    padded = head.encode() + b" " * (-len(head.encode()) % 4)
    body = len(padded).to_bytes(4, "little") + padded + packed.numbers.tobytes()
    return Response(body, media_type="application/octet-stream")


def _number(request: Request, name: str) -> int:
    given = request.query_params.get(name, "0")
    return int(given) if given.isdecimal() and len(given) < 10 else 0


def region_of(request: Request) -> TileRegion:
    """`region=first_row,last_row,first_col,last_col`; the whole picture where it is not that."""
    edges = request.query_params.get("region", "").split(",")
    if len(edges) == 4 and all(edge.isdecimal() and len(edge) < 10 for edge in edges):
        return TileRegion(*map(int, edges))
    return TileRegion(0, 10**9, 0, 10**9)
