"""A second core changes nothing but the time."""

from __future__ import annotations

import os
import threading

import numba
import numpy as np
import pytest
from scenes import cylinder

from densify.fusion import second_core
from densify.fusion.rectify import RectifyConfig, surface_view
from densify.fusion.second_core import halves, later
from densify.fusion.volume import FusionConfig, TsdfVolume
from lightdepth.tube import lens


@pytest.fixture(params=[1, 2], ids=["one core", "two cores"])
def cores(request, monkeypatch):
    monkeypatch.setattr(numba.config, "NUMBA_NUM_THREADS", request.param)
    second_core._helper.cache_clear()
    yield request.param
    second_core._helper.cache_clear()


@pytest.mark.parametrize("count", [0, 1, 2, 7])
def test_every_number_is_done_once(cores, count):
    done = np.zeros(count, int)

    def mark(first, end):
        done[first:end] += 1

    halves(mark, count)
    assert (done == 1).all()


def test_the_second_half_is_done_elsewhere_where_there_is_a_second_core(cores):
    threads = {}
    halves(lambda first, end: threads.setdefault(threading.current_thread().name, (first, end)), 10)
    assert len(threads) == cores
    assert sorted(threads.values()) == ([(0, 10)] if cores == 1 else [(0, 5), (5, 10)])


def test_what_is_left_for_later_is_there_and_so_are_errors(cores):
    assert later(sum, [1, 2]).result() == 3
    with pytest.raises(ZeroDivisionError):
        later(lambda: 1 / 0).result()


@pytest.mark.parametrize("at", [0, 5])
def test_an_error_in_either_half_is_raised_after_both_are_done(cores, at):
    finished = []

    def work(first, end):
        if first <= at < end:
            raise ValueError(f"at {at}")
        finished.append((first, end))

    with pytest.raises(ValueError, match=f"at {at}"):
        halves(work, 10)
    assert len(finished) == cores - 1


def test_views_and_sums_are_the_same_bit_for_bit(monkeypatch):
    scene = cylinder(lens("c3vd", 96, 80))
    made = []
    for count in (1, 2):
        monkeypatch.setattr(numba.config, "NUMBA_NUM_THREADS", count)
        second_core._helper.cache_clear()
        view = surface_view(scene.prediction(), scene.frame().image, RectifyConfig(), 40.0)
        volume = TsdfVolume(0.4, FusionConfig())
        volume.integrate(view, np.eye(4))
        made.append([view.planes, view.weights, view.colors, *vars(volume.extract_mesh()).values()])
    second_core._helper.cache_clear()
    assert len(made[0][3]) > 1000
    for one, two in zip(*made, strict=True):
        np.testing.assert_array_equal(one, two)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
def test_a_forked_process_has_a_helper_of_its_own(cores):
    halves(lambda first, end: None, 2)
    child = os.fork()
    if child == 0:
        done = []
        halves(lambda first, end: done.append(end - first), 10)
        os._exit(0 if sum(done) == 10 else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
