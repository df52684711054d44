"""Web application of the page: its files, the stream of events, image tiles, and commands for authorised users.

Any other page that is open in the browser can send requests to this server. Therefore each request must name one of our
hosts and carry the viewing token (a cookie). Actions are POST requests from our own origin, with the control token in a
header. No data from a client reach the file system.
"""

from __future__ import annotations

import asyncio
import secrets
import time
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import suppress
from dataclasses import astuple, dataclass, field
from functools import partial
from importlib.resources import files
from threading import Event
from typing import TYPE_CHECKING, Any

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, RedirectResponse, Response, StreamingResponse
from starlette.routing import BaseRoute, Mount, Route
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Receive, Scope, Send

from beamline.core.errors import BeamlineError, user_message
from beamline.core.events import json_of
from beamline.core.files import bytes_below
from beamline.features.page.viewer import reader_of, scan_routes, viewer_routes
from beamline.page.recording import Recording
from beamline.page.run_files import PICTURE, Reader
from beamline.page.tiles import number_of, region_of, tile_of
from beamline.page.volume import ShownVolume
from beamline.plan.passes import Choice
from beamline.scan.control import POLL, Verb, ask

if TYPE_CHECKING:
    from beamline.page.shown_scan import ShownScan

COOKIE = "splatline_look_"
"""Name of the cookie, before the port: a browser sends a cookie to all ports of a host."""
ACT_HEADER = "x-act-token"
_PERIOD = 0.5  # s between two checks of the file for the feed
_STATIC = files("beamline.features.page") / "static"
_KEPT = 64  # number of answers kept for the next client
_NO_VERB = "an unknown command"
_ONLY_WATCHES = (
    "This address can only watch the scan. To control the scan, open the address that `beamline scan --page` "
    "or `beamline watch --control` prints for this purpose. Nothing was sent to the scan."
)
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
    """Host names and tokens of a page: who may watch, and who may control the scan."""

    hosts: Sequence[str]  # names under which a browser may call this server, each with the port, as in `localhost:8642`
    look: str = field(default_factory=partial(secrets.token_hex, 16))  # the token for viewing
    act: str | None = None  # the token for commands to the scan; None: nobody may control the scan from the page
    ended: Event = field(default_factory=Event)  # set when the server ends


KNOWN = "splatline.known"
"""Key in the scope of a request that has the viewing token. The connection of the request reads this key, too."""


class Guard:
    """Sets the headers of every response, and answers with an error to requests for another host or without the viewing
    token."""

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self._app, self._access = app, access
        self._cookie = COOKIE + access.hosts[0].rpartition(":")[2]

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        async def send_with_headers(message: Any) -> None:
            if message["type"] == "http.response.start":
                own_headers = [(name, value) for name, value in message["headers"] if name.lower() not in _HEADERS]
                message = {**message, "headers": [*own_headers, *_HEADERS.items()]}
            await send(message)

        request = Request(scope)
        if request.headers.get("host") not in self._access.hosts:  # another host name that resolves to this computer
            await Response("Not a name of this server.\n", 421, media_type="text/plain")(scope, receive, send)
        elif _same(request.cookies.get(self._cookie, ""), self._access.look):
            scope[KNOWN] = True
            await self._app(scope, receive, send_with_headers)
        elif request.url.path == "/" and _same(request.query_params.get("token", ""), self._access.look):
            answer: Response = RedirectResponse("/", 303)
            answer.set_cookie(self._cookie, self._access.look, httponly=True, samesite="strict")
            await answer(scope, receive, send_with_headers)
        else:
            text = "Use the complete address that was printed when the page started: the token in it is missing here.\n"
            await Response(text, 403, media_type="text/plain")(scope, receive, send_with_headers)


def _same(received: str, expected: str) -> bool:
    return secrets.compare_digest(received.encode(), expected.encode())


def page(reader: Reader, access: Access, log: Callable[[str], None]) -> Starlette:
    """The application. `log` gets a line for each command sent, with the client's address."""
    return guarded("index.html", page_routes(reader, access, log), access)


def viewer(volumes: Sequence[ShownVolume], access: Access, scan: ShownScan | None = None) -> Starlette:
    """The application for one volume, for two volumes to compare, or for the projections of a scan."""
    do = reader_of(volumes)
    return guarded("view.html", viewer_routes(do) + ([] if scan is None else scan_routes(do, scan)), access)


def page_routes(reader: Reader, access: Access, log: Callable[[str], None]) -> list[BaseRoute]:
    """Routes of the page of a run. The routes below `view/` show its newest volume, alone and in the viewer."""
    server = _Server(reader, access, log)
    return [
        Mount("/view", begins_with("view.html", viewer_routes(reader.on_volumes))),
        Route("/api/facts", server.facts),
        Route("/api/feed", server.feed),
        Route("/api/columns", server.columns),
        Route("/api/flags", server.flags),
        Route("/api/frame/{frame:number}", server.frame),
        Route("/api/sinogram", server.sinogram),
        Route("/api/trace", server.trace),
        Route("/api/model.png", server.model),
        Route("/api/verb/{verb}", server.verb, methods=["POST"]),
    ]


def guarded(start: str, routes: Sequence[BaseRoute], access: Access) -> Starlette:
    """An application with these routes, whose start page is a page of `static`. All requests pass the guard."""
    static = Mount("/static", StaticFiles(directory=str(_STATIC)))
    return begins_with(start, [static, *routes], [Middleware(Guard, access=access)])


def begins_with(start: str, routes: Sequence[BaseRoute], middleware: Sequence[Middleware] = ()) -> Starlette:
    """An application with these routes, whose start page is a page of `static`."""
    text = "".join((_STATIC / name).read_text("utf-8") for name in ("head.html", start))
    first = Route("/", lambda request: HTMLResponse(text))
    return Starlette(routes=[first, *routes], middleware=middleware, exception_handlers={BeamlineError: _refused})


def _refused(request: Request, error: Exception) -> Response:
    """A user error as a sentence, with status 404."""
    return JSONResponse({"message": user_message(error)}, 404)


class _Server:
    """Answers requests. Starlette calls functions that are not coroutines in separate threads."""

    def __init__(self, reader: Reader, access: Access, log: Callable[[str], None]) -> None:
        self._reader, self._access, self._log = reader, access, log
        self._kept: dict[tuple[object, ...], Response] = {}  # of the reading thread
        self._state: dict[str, Any] = {}
        self._looked = 0.0
        self._looking = asyncio.Lock()

    def facts(self, request: Request) -> Response:
        facts = self._reader.do(Recording.facts)
        watched_run = self._reader.what
        path = str((watched_run.folder or watched_run.scan).resolve())
        return JSONResponse({**facts, "run": watched_run.name, "path": path, "may_act": self._access.act is not None})

    async def feed(self, request: Request) -> Response:
        """Server-sent events: each event of the run with its number as id, `state` whenever the state changes, and
        `end`."""
        last = request.headers.get("last-event-id", request.query_params.get("last", ""))
        first = int(last) + 1 if last.isdecimal() and len(last) < 10 else 0
        return StreamingResponse(self._feed(first), media_type="text/event-stream")

    async def _feed(self, first: int) -> AsyncIterator[str]:
        sent, ended = "", False
        while not ended:
            ended = self._access.ended.is_set()  # after that, the last events are still sent
            state = await self._now(at_once=ended)
            lines = self._reader.events.lines
            for number in range(first, len(lines)):
                yield f"id: {number}\nevent: run\ndata: {lines[number]}\n\n"
            first = max(first, len(lines))
            now = json_of(state)
            if now != sent:
                sent = now
                yield f"event: state\ndata: {now}\n\n"
            if not ended:
                await asyncio.sleep(_PERIOD)
        yield "event: end\ndata: {}\n\n"

    async def _now(self, *, at_once: bool) -> dict[str, Any]:
        """The state, read once for all clients."""
        async with self._looking:
            if at_once or time.monotonic() - self._looked >= _PERIOD:  # so that all clients ask for the same frame
                self._state = await run_in_threadpool(self._reader.state)
                self._looked = time.monotonic()
        return self._state

    def columns(self, request: Request) -> Response:
        first = number_of(request, "first")
        return self._of_now(lambda file: JSONResponse(file.columns(first)), "columns", first)

    def flags(self, request: Request) -> Response:
        return self._of_now(lambda file: JSONResponse(file.flags()), "flags")

    def frame(self, request: Request) -> Response:
        frame, corrected = int(request.path_params["frame"]), request.query_params.get("corrected") == "1"
        region = region_of(request)

        def frame_response(file: Recording) -> Response:
            values, shown, factor = file.picture(frame, region, corrected=corrected)
            return tile_of(values, {"frame": frame, "region": astuple(shown), "bin": factor})

        return self._once(frame_response, lambda file: (frame, region, corrected, file.has_references))

    def sinogram(self, request: Request) -> Response:
        row, first = number_of(request, "row"), number_of(request, "first")

        def sinogram_response(file: Recording) -> Response:
            lines, views, factor = file.sinogram(row, first)
            return tile_of(lines, {"views": views.tolist(), "bin": factor})

        return self._of_now(sinogram_response, "sinogram", row, first)

    def trace(self, request: Request) -> Response:
        region, first = region_of(request), number_of(request, "first")
        return self._of_now(
            lambda file: JSONResponse({"first": first, "values": file.trace(region, first)}), "trace", region, first
        )

    def _of_now(self, make: Callable[[Recording], Response], *key: object) -> Response:
        """An answer that is valid until there are more frames."""
        return self._once(make, lambda file: (file.progress(), *key))

    def _once(self, make: Callable[[Recording], Response], key: Callable[[Recording], tuple[object, ...]]) -> Response:
        """One answer for all clients that make the same request at the same time. The reading thread makes the
        answer."""

        def cached(file: Recording) -> Response:
            identity = key(file)
            if identity not in self._kept:
                self._kept[identity] = make(file)
                if len(self._kept) > _KEPT:
                    del self._kept[next(iter(self._kept))]
            return self._kept[identity]

        return self._reader.do(cached)

    def model(self, request: Request) -> Response:
        """The live picture: the newest projection, the projection of the volume at the same angle, and their difference
        in units of the noise."""
        run, picture = self._reader.what.run, b""
        if run is not None:
            with suppress(OSError):
                picture = bytes_below(run, PICTURE)
        return Response(picture, media_type="image/png") if picture else Response(status_code=404)

    async def verb(self, request: Request) -> Response:
        """Send a command to the run immediately, even if all threads that answer other requests are busy."""
        folder, act = self._reader.what.folder, self._access.act
        client = request.client.host if request.client else "?"
        verb = next((verb for verb in (*Verb, *Choice) if verb == request.path_params["verb"]), None)
        name = _NO_VERB if verb is None else str(verb)  # the text that the client sent is never shown
        ours = f"{request.url.scheme}://{request.headers.get('host', '')}"
        if act is None or request.headers.get("origin") != ours or not _same(request.headers.get(ACT_HEADER, ""), act):
            self._log(
                f"not executed: {name}, requested by {client}, because the token for controlling the scan is missing"
            )
            return JSONResponse({"message": _ONLY_WATCHES}, 403)
        if folder is None or verb is None:
            return JSONResponse({"message": f"{name} is not possible: no scan is running in this folder."}, 404)
        self._log(f"{name}, requested by {client}")
        pending = ask(folder, verb)
        while (state := await run_in_threadpool(pending.state)) is None:
            await asyncio.sleep(POLL)
        return JSONResponse({"state": str(state)})
