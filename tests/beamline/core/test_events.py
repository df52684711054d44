"""Every sink receives all events in order; a sink that fails or is slow does not affect the others."""

import threading

from beamline.core.events import Event, KernelsCompiled
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
