"""A process forked after kernels have run computes the same on one thread; a fork waits for a compilation."""

import multiprocessing
import os
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import pytest
import torch
from numba.core.compiler_lock import global_compiler_lock

import recon
from recon.base.arrays import F32
from recon.base.method import Method
from tests.recon.few_views import VIEWS

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")

_METHODS = (recon.Fbp(), recon.Sirt(iterations=2))


@contextmanager
def forks() -> Iterator[None]:
    with warnings.catch_warnings():  # Python 3.12 warns of a fork beside threads
        warnings.simplefilter("ignore", DeprecationWarning)
        yield


def from_a_fork(function: Callable[..., F32], *args: object) -> F32:
    with forks(), multiprocessing.get_context("fork").Pool(1) as pool:
        found: F32 = pool.apply_async(function, args).get(timeout=60)
    return found


def volume(method: Method, views: F32) -> F32:
    return recon.reconstruct(views, VIEWS, method).volume.data


def exponential(values: F32) -> F32:
    return torch.from_numpy(values).exp().numpy()


def from_a_fork_again(method: Method, views: F32) -> F32:
    multiprocessing.current_process().daemon = False  # or it may have no children
    return from_a_fork(volume, method, views)


@pytest.mark.parametrize("method", _METHODS, ids=lambda method: method.name)
@pytest.mark.parametrize("how", [volume, from_a_fork_again])
def test_a_fork_computes_the_same(method: Method, how: Callable[..., F32], noisy: F32) -> None:
    np.testing.assert_array_equal(from_a_fork(how, method, noisy), volume(method, noisy))


def test_torch_does_not_wait_for_threads_in_a_fork(noisy: F32) -> None:
    volume(recon.Fbp(), noisy)
    values = np.linspace(0, 1, 1 << 18, dtype=np.float32)  # more than one thread's share
    np.testing.assert_array_equal(from_a_fork(exponential, values), exponential(values))


def test_a_fork_waits_for_a_compilation_in_another_thread(noisy: F32) -> None:
    volume(recon.Fbp(), noisy)
    compiling, goes_on = threading.Event(), threading.Event()

    def compile_long() -> None:
        with global_compiler_lock:
            compiling.set()
            goes_on.wait(60)

    thread = threading.Thread(target=compile_long)
    thread.start()
    compiling.wait()
    threading.Timer(0.1, goes_on.set).start()
    with forks():
        child = os.fork()
    if child == 0:
        os._exit(0 if goes_on.is_set() and global_compiler_lock._lock.acquire(timeout=5) else 1)
    assert os.waitpid(child, 0)[1] == 0
    thread.join()
