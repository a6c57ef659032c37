"""Light from wall to wall in synthetic colons, reckoned in several ways."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from colons import SMALL
from raising import refused

from lightdepth.tube import ExchangeConfig, ShapeConfig, Tube, wide_colon, wide_hollow
from lightdepth.tube.path import lens, octagon
from train.colons import TubeData, colon_seeds, tube_config, val_scene

CAMERA = lens("c3vd", 40, 32)
SMOOTH = ShapeConfig(length=90.0, step=1.2, fold_depth=(0.0, 0.0), bump=(0.0, 0.0), bend=(0.0, 0.0))


@cache
def tube(form: str, smooth: bool = False, bounces: int = 6) -> Tube:
    config = replace(SMALL, exchange=ExchangeConfig((form,), (bounces, bounces)), patch=5.0)
    config = replace(config, sensor=replace(config.sensor, reflectance=(0.6, 0.6)))
    return Tube(replace(config, shape=SMOOTH) if smooth else config, np.random.default_rng(2))


def inside(one: Tube) -> torch.Tensor:
    """The sums of the form factors of patches that are far from the open end, (n,)."""
    rows, columns = one._patches.grid
    return one._factors.sum(1).reshape(rows, columns)[rows // 2 : -2].flatten()


def test_cast_rays_lose_no_light_inside_and_the_enclosed_lose_none_at_all():
    assert inside(tube("cast", smooth=True)).min() > 0.95  # a little leaves by the open end
    torch.testing.assert_close(inside(tube("enclosed")), torch.ones_like(inside(tube("enclosed"))))


def test_in_a_smooth_tube_patches_and_rays_agree_on_what_lights_what():
    """Summed over rings: the rays of one patch are too few to tell its neighbours apart."""
    sums = []
    for form in ("points", "cast"):
        one = tube(form, smooth=True)
        rows, columns = one._patches.grid
        sums.append(one._factors.reshape(rows, columns, rows, columns).sum(3).mean(1)[rows // 2])
    apart = (torch.arange(len(sums[0])) - len(sums[0]) // 2).abs()
    near = (apart > 1) & (apart < 5)
    torch.testing.assert_close(sums[0][near], sums[1][near], rtol=0.2, atol=0)


def test_wall_that_hides_nothing_lets_more_light_through():
    through, points = tube("through"), tube("points")
    assert (through._factors >= points._factors).all() and through._factors.sum() > 1.02 * points._factors.sum()


def test_more_bounces_make_more_light():
    few, many = (tube("cast", bounces=n) for n in (1, 20))
    pose = np.eye(4)
    pose[2, 3] = 20.0
    parts = [np.eye(3, dtype=np.float32)[None], pose[None, :3, 3:].astype(np.float32)]
    light = [one._indirect(*map(torch.from_numpy, parts)).values.sum() for one in (few, many)]
    assert light[1] > 1.1 * light[0] > 0


def test_a_colon_without_a_choice_of_exchange_is_the_one_it_was():
    assert tube("points")._exchange == ("points", 6, 1.0)
    given = replace(SMALL, exchange=ExchangeConfig(("points",), (6, 6), (1.0, 1.0)))
    first, second = (Tube(config, np.random.default_rng(5)) for config in (SMALL, given))
    np.testing.assert_array_equal(first.albedo, second.albedo)
    assert first.sensor == second.sensor


def test_an_exchange_without_forms_is_refused():
    with refused(where="exchange", found="none"):
        ExchangeConfig(())


def test_wide_scenes_are_colons_and_hollows_of_every_exchange():
    data = TubeData(family="wide", reflectance=(0.1, 0.9))
    assert [tube_config(data, i).path == wide_hollow().path for i in range(5)] == [False, False, True, False, False]
    assert tube_config(data, 0).sensor.reflectance == (0.1, 0.9)
    assert set(wide_colon().exchange.forms) == {"points", "through", "enclosed", "cast"}


@pytest.mark.parametrize("make", [wide_colon, wide_hollow])
def test_wide_scenes_can_be_looked_at(make):
    config = replace(make(), patch=9.0)
    config = replace(config, shape=replace(config.shape, length=90.0, step=1.4))
    pose = np.eye(4)
    pose[2, 3] = 15.0
    view = Tube(config, np.random.default_rng(1)).view(pose, CAMERA, octagon(CAMERA), np.random.default_rng(0))
    assert np.isfinite(view.image).all() and 0.02 < view.image[octagon(CAMERA)].mean() <= 1


def test_colons_to_validate_on_may_be_of_another_make():
    data = TubeData(scenes=1, val_scenes=2, frames=1, family="plain", val_family="variant", lenses=("pinhole",))
    (seed, _) = colon_seeds(data, 3)[1]
    (batch,) = val_scene(data, seed, 0, (40, 32))
    assert batch.image.shape == (1, 3, 32, 40) and bool(batch.true_valid.any())
    assert float(batch.light.gamma) == pytest.approx(2.2)  # the other make's, for which the plain draw others
