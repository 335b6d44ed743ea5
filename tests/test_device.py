"""Launches over the cores of a machine."""

import os
import time
import warnings

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
