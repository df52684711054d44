"""Every stage on real time, by pseudo-terminal and TCP: short moves, a search, a train, a stop, garbage, the plug."""

from __future__ import annotations

import gc
import math
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from drivers.base.errors import DeviceError
from tests.drivers.stages.real_time import FAST, KINDS, PLUGS, SOON, Kind, Real, Serve, serve_sim
from tests.simulators.wires.transports import serve_tcp

every_kind = pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)


@pytest.fixture(scope="module", params=PLUGS)
def serve(request: pytest.FixtureRequest) -> Serve:
    return request.param


@pytest.fixture(scope="module", params=KINDS.values(), ids=KINDS)
def kept(request: pytest.FixtureRequest, serve: Serve) -> Iterator[Real]:
    """One for all tests: to open and close a port costs more than a test does."""
    with ExitStack() as plugged:
        real = Real(request.param, serve, plugged)
        yield real
        real.stage.close()


@pytest.fixture
def real(kept: Real) -> Real:
    """It stands at zero, on a line that is sound."""
    kept.wire.instead.clear()
    kept.stage.stop()
    kept.stage.start_move(0.0, FAST)
    kept.stage.wait(SOON)
    return kept


# as on a virtual clock


def test_moves_arrive_at_their_counts(real: Real) -> None:
    stage = real.stage
    for counts in (real.bench.counts(3), real.bench.counts(-1), 0, 1):
        stage.start_move(stage.to_angle(counts), FAST)
        assert stage.to_counts(stage.wait(SOON)) == counts
        assert not stage.moving()


@every_kind
def test_a_search_and_then_a_train_that_gives_its_pulses_at_its_counts(kind: Kind, serve: Serve) -> None:
    with ExitStack() as plugged:
        real = Real(kind, serve, plugged, unreferenced=True)
        stage, bench = real.stage, real.bench
        stage.start_home()
        assert stage.to_counts(stage.wait(SOON)) == kind.home
        first, step = bench.counts(1.0), bench.counts(0.12)
        assert step * 3000 == stage.limits.counts_per_turn
        stage.arm(bench.train(1.0, 0.12, 60))
        stage.start_move(math.radians(9), FAST)
        assert math.degrees(stage.wait(SOON)) == pytest.approx(9.0)
        assert [stage.to_counts(pulse.angle) for pulse in bench.pulses()] == [first + step * k for k in range(60)]
        stage.close()


def test_a_stop_on_the_way_stands_short(real: Real) -> None:
    stage = real.stage
    stage.start_move(math.radians(90), math.radians(10))
    stage.stop()
    with pytest.raises(DeviceError, match="stopped short"):
        stage.wait(SOON)
    assert 0 <= stage.to_counts(stage.position()) < real.bench.counts(90)


@every_kind
def test_the_transcript_of_a_conversation_is_whole(kind: Kind, tmp_path: Path) -> None:
    with ExitStack() as plugged:
        stage = Real(kind, serve_sim, plugged, {"transcript": tmp_path / "line.txt"}).stage
        stage.position()
        stage.close()
    text = (tmp_path / "line.txt").read_text()
    sent = [line.split(" ", 2)[2] for line in text.splitlines() if " > " in line]
    last = sent[-len(kind.farewell) :]
    assert all(words in line for line, words in zip(last, kind.farewell, strict=True)), last
    assert all(line.startswith(words) for line, words in zip(sent, kind.opening, strict=False)), sent[:2]
    assert any(kind.among in line for line in sent)


# disturbed, over one transport; the fuzz does the same on a virtual clock


@pytest.mark.parametrize("serve", [serve_tcp], scope="module")
def test_after_garbage_the_line_finds_its_step_again(real: Real) -> None:
    stage = real.stage
    stage.start_move(math.radians(1), FAST)
    stage.wait(SOON)
    for garbage in real.kind.garbage:
        real.wire.instead.append(garbage)
        with pytest.raises(DeviceError):
            stage.position()
        assert real.wire.instead == []
        assert stage.to_counts(stage.position()) == real.bench.counts(1)
        assert not stage.moving()


@pytest.mark.parametrize("serve", [serve_tcp], scope="module")
def test_after_garbage_in_the_middle_of_a_move_the_move_is_still_waited_for(real: Real) -> None:
    stage = real.stage
    stage.start_move(math.radians(7), math.radians(20))
    real.wire.instead.extend([b"\x80\x81\r\n", b"??"])
    failed = 0
    while True:
        try:
            where = stage.wait(SOON)
            break
        except DeviceError as error:
            assert "may be turning" in str(error)
            failed += 1
            assert failed <= 3
    assert failed >= 1
    assert stage.to_counts(where) == real.bench.counts(7)


# the plug


def wait_and_unplug(real: Real) -> DeviceError:
    """What a wait in another thread ends with."""
    errors: list[BaseException] = []
    begun = threading.Event()

    def wait() -> None:
        begun.set()
        try:
            real.stage.wait(SOON)
        except BaseException as error:
            errors.append(error)

    thread = threading.Thread(target=wait)
    thread.start()
    begun.wait()
    real.unplug()
    thread.join(SOON)
    assert not thread.is_alive()
    (error,) = errors
    assert type(error) is DeviceError
    return error


# pyserial leaves a socket that was reset to the garbage collector
@pytest.mark.filterwarnings("ignore:Exception ignored in. <socket:pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("serve", PLUGS)
@every_kind
def test_a_plug_pulled_in_the_middle_of_a_move_is_one_error_that_says_so(kind: Kind, serve: Serve) -> None:
    with ExitStack() as plugged:
        real = Real(kind, serve, plugged)
        stage = real.stage
        stage.start_move(math.radians(90), math.radians(1))
        said = str(wait_and_unplug(real))
        assert "the port failed" in said
        assert "may still be doing" in said
        for again in (stage.position, stage.moving, stage.stop, stage.abort):
            with pytest.raises(DeviceError, match=r"may still be doing|no whole reply|still no answer"):
                again()
        stage.close()
    gc.collect()
