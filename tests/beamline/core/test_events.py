"""Every sink hears everything in order, and one that breaks or dawdles is nobody else's trouble."""

import threading

from beamline.core.events import Event, KernelsCompiled, StateEntered
from beamline.core.sinks import Announcer
from simulators.devices.clock import VirtualClock


def test_all_sinks_hear_all_events_in_order_with_their_time() -> None:
    clock = VirtualClock(start=100.0)
    first: list[Event] = []
    second: list[Event] = []
    with Announcer([first.append, second.append], clock) as sink:
        for i in range(50):
            sink(KernelsCompiled("kernels", i, 0.0))
            clock.sleep(1.0)
    assert [(e.event, e.time, e.data["n"]) for e in first] == [("progress", 100.0 + i, i) for i in range(50)]
    assert first == second


def test_a_sink_that_hangs_does_not_hold_up_who_speaks() -> None:
    go_on = threading.Event()
    heard: list[int] = []

    def slow(event: Event) -> None:
        go_on.wait(30)
        heard.append(event.data["n"])

    with Announcer([slow], VirtualClock()) as sink:
        for i in range(1000):
            sink(KernelsCompiled("kernels", i, 0.0))
        assert heard == []  # everything was said before the sink did anything
        go_on.set()
    assert heard == list(range(1000))


def test_threads_may_speak_at_once() -> None:
    heard: list[Event] = []
    with Announcer([heard.append], VirtualClock()) as sink:
        threads = [
            threading.Thread(target=lambda t=t: [sink(KernelsCompiled(f"{t}", n, 0.0)) for n in range(100)])
            for t in range(4)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert len(heard) == 400
    for t in range(4):
        assert [e.data["n"] for e in heard if e.data["stage"] == f"{t}"] == list(range(100))


def test_two_sinks_that_break_at_once_are_each_given_up_once() -> None:
    """As both logs of a run do on a full disk: the word that one is given up is what breaks the other."""
    heard: list[Event] = []

    class Full:
        def __init__(self) -> None:
            self.calls = 0

        def __call__(self, event: Event) -> None:
            self.calls += 1
            raise OSError(28, "No space left on device")

    logs = [Full(), Full()]
    with Announcer([*logs, heard.append], VirtualClock()) as sink:
        sink(StateEntered("idle", "a"))
        sink(StateEntered("idle", "b"))
    assert [log.calls for log in logs] == [1, 1]
    assert [e.data["message"] for e in heard if e.event == "state"] == ["a", "b"]
    warnings = [e.data["message"] for e in heard if e.event == "warning"]
    assert len(warnings) == 2
    assert all("gets no further events" in text and "No space left" in text for text in warnings)
