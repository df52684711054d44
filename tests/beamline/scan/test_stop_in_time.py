"""Stop and abort from everywhere, in every state of a scan, during other commands: within 2 s."""

import asyncio
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext, suppress
from pathlib import Path

import pytest

from beamline.api.instrument import Instrument
from beamline.config.load import Config
from beamline.core.errors import ScanStopped
from beamline.core.stop import StopRequest, stop_signals
from beamline.scan.control import State, StateMachine, Verb, ask, tell
from beamline.scan.run import run_scan
from tests.beamline.fakes import HOME, FakeInstrument
from tests.beamline.features.page.served import served
from tests.beamline.ran import small

WITHIN, EXPOSURE = 2.0, 0.3  # s
LONG = 30.0  # s that a test may wait on a busy machine for what is not measured
RESUMING = "resuming"  # out of a pause: the state after it has just begun
Moment = State | str
MOMENTS: tuple[tuple[Moment, str], ...] = (
    (State.PREPARING, "fly"), (State.DARKS, "fly"), (State.FLATS, "fly"), (State.TAXI, "fly"), (State.ACQUIRING, "fly"),
    (State.PAUSED, "fly"), (RESUMING, "fly"), (State.FINISHING, "fly"), (State.ACQUIRING, "step"), (RESUMING, "step"),
)  # fmt: skip
Send = Callable[[str], object]


class Held:
    """A scan of the fake instrument that stays in a state until it is about to be told something, then goes on in real
    time until it has been told, and from then on at once. Times are real and of its own clock, whichever is later."""

    def __init__(self, patch: pytest.MonkeyPatch, state: Moment, mode: str, runs: Path) -> None:
        self.instrument, self._state, self._mode = FakeInstrument(), state, mode
        self._has_paused = False
        self.reached, self._asked, self._taken = threading.Event(), threading.Event(), threading.Event()
        self._slept, self._since, self._told = self.instrument.clock.sleep, (0.0, 0.0), ""
        self.seconds: dict[str, float] = {}  # from the request, to what was done last
        self.runs = runs
        clock, stage, camera = self.instrument.clock, self.instrument.stage, self.instrument.camera
        patch.setattr(clock, "sleep", self._sleep)
        patch.setattr(StateMachine, "enter", self._entering(StateMachine.enter))
        for name in ("stop", "abort"):
            patch.setattr(StopRequest, name, self._taking(name, getattr(StopRequest, name)))
        move, trigger = stage.start_move, camera.software_trigger
        patch.setattr(stage, "start_move", lambda to, speed: (self._note_view(to), move(to, speed))[1])
        patch.setattr(camera, "software_trigger", lambda: (self._note_view(), trigger())[1])

    @property
    def config(self) -> Config:
        period = "scan.period_s=5" if self._mode == "step" else "scan.period_s=0.5"
        return small(f"scan.mode={self._mode}", f"scan.exposure_s={EXPOSURE}", period)

    @property
    def run(self) -> Path:
        (run,) = self.runs.iterdir()
        return run

    def tell(self, send: Send, verb: str) -> None:
        self._told, self._since = verb, (time.monotonic(), self.instrument.clock.now())
        self._asked.set()
        send(verb)

    def _sleep(self, seconds: float) -> None:
        if self._state is State.ACQUIRING and self._mode == "step" and seconds > EXPOSURE + 0.1:
            self.reached.set()  # between two views
        self._slept(seconds)
        if self.reached.is_set() and not self._taken.is_set():
            self._asked.wait(LONG)
            time.sleep(max(0.0, min(seconds, LONG)))

    def _note(self, what: str) -> None:
        real, own = self._since
        if self._asked.is_set():
            self.seconds[what] = max(time.monotonic() - real, self.instrument.clock.now() - own)

    def _note_view(self, to: float = 0.0) -> None:
        """A view is taken next, or a move begins that is not the way home."""
        if self.instrument.is_open and self.instrument.is_in and self.instrument.stage.to_counts(to) != HOME:
            self._note("last view")

    def _entering(self, usual: Callable[..., None]) -> Callable[..., None]:
        def enter(machine: StateMachine, state: State, message: str = "") -> None:
            usual(machine, state, message)
            if state is State.FINISHING:
                self._note("safe")
            resumes, self._has_paused = self._has_paused, self._has_paused or state is State.PAUSED
            if state is State.ACQUIRING and self._state in (State.PAUSED, RESUMING) and not self._has_paused:
                (self.run / "control" / "pause").touch()
                time.sleep(0.3)
            if state is State.PAUSED and self._state == RESUMING:
                (self.run / "control" / "resume").touch()
            elif resumes and self._state == RESUMING:
                self.reached.set()
            if state is self._state and not (state is State.ACQUIRING and self._mode == "step"):
                self.reached.set()
                if state in (State.PREPARING, State.FINISHING):  # in which the scan looks at no clock
                    deadline = time.monotonic() + LONG
                    while not self._taken.wait(0.01) and time.monotonic() < deadline:
                        pass  # short waits: a signal that comes just before a long one begins is seen at its end only

        return enter

    def _taking(self, name: str, usual: Callable[..., None]) -> Callable[..., None]:
        def take(stop: StopRequest, *reason: str) -> None:
            usual(stop, *reason)
            if name == self._told and not self._taken.is_set():
                self._note("taken")
                self._taken.set()

        return take


Surface = tuple[Callable[[], object], AbstractContextManager[Send]]
"""What runs the scan in the main thread, and, opened once the scan is where it should be, what tells it something."""


def _scan(held: Held) -> Callable[[], object]:
    return lambda: run_scan(held.config, held.runs, instrument=held.instrument.connected())


def command(held: Held) -> Surface:
    def send(verb: str) -> None:
        for other in (Verb.PAUSE, Verb.RESUME):
            ask(held.run, other)
        tell(held.run, Verb(verb))

    return _scan(held), nullcontext(send)


def page(held: Held) -> Surface:
    @contextmanager
    def opened() -> Iterator[Send]:
        with served(held.run, control=True) as browser:
            assert browser.addresses.act is not None
            token = browser.addresses.act.partition("act=")[2]
            headers = {"X-Act-Token": token, "Origin": f"http://{browser.host}"}
            yield lambda verb: browser.ask(f"/api/verb/{verb}", "POST", headers=headers)

    return _scan(held), opened()


def epics(held: Held) -> Surface:
    @contextmanager
    def opened() -> Iterator[Send]:
        with closing(RunServer(held.runs, "T:", "127.0.0.1", True, lambda line: None)) as server:
            port = server.configuration["EPICS_PVAS_SERVER_PORT"]
            conf = {"EPICS_PVA_NAME_SERVERS": f"127.0.0.1:{port}", "EPICS_PVA_AUTO_ADDR_LIST": "NO"}
            with closing(Context("pva", conf=conf, useenv=False)) as client, ThreadPoolExecutor(5) as puts:
                names = {verb: f"T:{verb.capitalize()}Scan" for verb in Verb}
                for name in names.values():
                    client.get(name)  # connected
                yield lambda verb: [
                    puts.submit(client.put, names[each], True, timeout=0.3)  # which nobody answers
                    for each in (Verb.PAUSE, Verb.RESUME, Verb.PAUSE, Verb.RESUME, Verb(verb))
                ]

    from p4p.client.thread import Context

    from beamline.features.epics.ioc import RunServer

    return _scan(held), opened()


def terminal(held: Held) -> Surface:
    stop, sent, main = StopRequest(), threading.Event(), threading.main_thread().ident or 0

    def go() -> None:
        with stop_signals(stop):
            try:
                run_scan(held.config, held.runs, stop=stop, instrument=held.instrument.connected())
            finally:
                sent.wait(LONG)

    def press(verb: str) -> None:
        signal.pthread_kill(main, signal.SIGINT)
        while not stop.stopping:
            time.sleep(0.001)
        if verb == "abort":
            time.sleep(0.2)  # a hand is no faster
            signal.pthread_kill(main, signal.SIGINT)
        sent.set()

    return go, nullcontext(press)


def api(held: Held) -> Surface:
    stop, instrument = StopRequest(), Instrument(held.config, held.instrument.connected(), say=None)
    return lambda: instrument.scan(stop=stop, live=False, output=held.runs), nullcontext(
        lambda verb: getattr(stop, verb)()
    )


def bluesky(held: Held) -> Surface:
    """Its RunEngine unstages the scan when a plan ends, also while a pause is under way; it has no abort."""
    from beamline.bluesky.devices import TomoScan

    ends = threading.Event()

    async def plan() -> None:
        scan = TomoScan(held.config, held.runs, instrument=held.instrument.connected())
        begun = asyncio.ensure_future(scan.kickoff().task)
        await asyncio.to_thread(ends.wait, LONG)
        pausing = asyncio.ensure_future(scan.pause())
        await asyncio.sleep(0.05)
        pausing.cancel()
        await scan.unstage()
        await asyncio.gather(begun, pausing, return_exceptions=True)

    return lambda: asyncio.run(plan()), nullcontext(lambda verb: ends.set())


NEEDS: dict[Callable[[Held], Surface], str] = {epics: "p4p", bluesky: "ophyd_async"}


def seconds_of(surface: Callable[[Held], Surface], state: Moment, verb: str, mode: str, runs: Path) -> dict[str, float]:
    """From the request to stop or abort a scan in this state: until it is taken, the instrument is safe, and to the
    last view, s."""
    with pytest.MonkeyPatch.context() as patch:
        held = Held(patch, state, mode, runs)
        go, opened = surface(held)

        def fire() -> None:
            held.reached.wait(LONG)
            with opened as send:
                held.tell(send, verb)

        thread = threading.Thread(target=fire)
        thread.start()
        with suppress(ScanStopped):
            go()
        thread.join()
        assert not held.instrument.is_open and not held.instrument.stage.moving()
        return held.seconds


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="Windows sends no Ctrl-C to a thread")
@pytest.mark.parametrize(
    ("surface", "verb", "moments"),
    [(terminal, "stop", MOMENTS[::2]), (terminal, "abort", MOMENTS[1::2])]
    + [
        (surface, verb, MOMENTS[(n + k) % 3 :: 3])  # all, by the surfaces together
        for n, surface in enumerate((command, page, epics, api, bluesky))
        for k, verb in enumerate(("stop", "abort"))
        if (surface, verb) != (bluesky, "abort")
    ],
)
def test_a_scan_is_stopped_and_aborted_in_time_from_everywhere(
    tmp_path: Path, surface: Callable[[Held], Surface], verb: str, moments: Sequence[tuple[Moment, str]]
) -> None:
    pytest.importorskip(NEEDS.get(surface, "json"))
    for n, (state, mode) in enumerate(moments):
        seconds = seconds_of(surface, state, verb, mode, tmp_path / str(n))
        print(f"{surface.__name__:<9}{verb:<6}{state:<10}{mode:<5}", *(f"{k} {v:.2f}" for k, v in seconds.items()))
        assert "taken" in seconds and ("safe" in seconds or verb == "stop" or state is State.FINISHING)
        if verb == "stop":
            seconds.pop("safe", None)  # after the references that are due, and the way home
        assert max(seconds.values()) < WITHIN, (state, verb, mode, seconds)
