"""Launches over the cores of a machine."""

import os
import time
import warnings
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import warp as wp

from warp_psf.device import find_device, launch


@wp.kernel(enable_backward=False, module="unique")
def _count(first: int, out: wp.array2d(dtype=wp.int32)):
    world, item = wp.tid()
    item += first
    out[world, item] = out[world, item] + world * 1000 + item


@pytest.mark.parametrize("items", [0, 1, 63, 64, 1000])
def test_every_item_is_visited_once(items):
    device = find_device("cpu")
    out = wp.zeros((2, max(items, 1)), dtype=wp.int32, device=device)
    launch(_count, (2, items), [], [out], device)
    expected = np.arange(2)[:, None] * 1000 + np.arange(max(items, 1))
    np.testing.assert_array_equal(out.numpy(), expected if items else 0 * expected)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork")
def test_a_forked_process_launches_on_threads_of_its_own():
    device = find_device("cpu")
    out = wp.zeros((1, 1000), dtype=wp.int32, device=device)
    launch(_count, (1, 1000), [], [out], device)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # that a process with threads forks is the point
        child = os.fork()
    if child == 0:
        launch(_count, (1, 1000), [], [out], device)
        os._exit(0)
    for _ in range(200):
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            break
        time.sleep(0.05)
    else:
        os.kill(child, 9)
        os.waitpid(child, 0)
        pytest.fail("the forked process waits for its parent's threads")
    assert status == 0


def test_a_renderer_leaves_gradients_of_other_kernels_alone():
    find_device("cpu")
    assert wp.config.enable_backward


def test_threads_may_launch_a_kernel_that_none_has_loaded():
    device = find_device("cpu")

    def make_kernel(number: int):
        @wp.kernel(enable_backward=False, module="unique")
        def add(first: int, out: wp.array2d(dtype=wp.int32)):
            world, item = wp.tid()
            item += first
            out[world, item] = out[world, item] + wp.static(number)

        return add

    for number in range(1, 9):
        kernel = make_kernel(number)
        outs = [wp.zeros((1, 4000), dtype=wp.int32, device=device) for _ in range(4)]
        with ThreadPoolExecutor(4) as pool:
            list(pool.map(lambda out, kernel=kernel: launch(kernel, (1, 4000), [], [out], device), outs))
        for out in outs:
            np.testing.assert_array_equal(out.numpy(), number)
