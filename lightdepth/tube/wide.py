"""Colons and hollows beyond the realistic: what is drawn for networks that must hold under a renderer they never met.

Against `realistic` and `cavity`: light between walls computed in four ways and to the last bounce, reflectance as far
as the caller goes, exposure from dark to hard clipped, and wider ranges of shape, paint, gloss and lamp.
"""

from __future__ import annotations

from dataclasses import replace

from lightdepth.tube.exchange import ExchangeConfig
from lightdepth.tube.scene import TubeConfig, cavity, realistic

# Enclosed light, of which none is lost, is what a network that was taught by points alone errs by most.
_EXCHANGE = ExchangeConfig(
    forms=("points", "through", "enclosed", "enclosed", "cast"), bounces=(3, 40), coarser=(0.9, 1.5)
)


def wide_colon() -> TubeConfig:
    """Colons from narrow to wide, with folds from none to deep, some of a triangular lumen."""
    shape = replace(
        realistic().shape,
        radius=(9.0, 28.0),
        fold_spacing=(8.0, 36.0),
        fold_depth=(0.05, 0.5),
        fold_width=(1.2, 4.5),
        bump=(0.01, 0.1),
        crescent=(0.0, 1.0),
        waviness=(0.0, 2.5),
        taeniae=(0.0, 0.25),
    )
    return _widened(replace(realistic(), shape=shape))


def wide_hollow() -> TubeConfig:
    """`cavity` in the same light."""
    return _widened(cavity())


def _widened(config: TubeConfig) -> TubeConfig:
    sensor = replace(
        config.sensor,
        light_offset=3.0,
        specular=(0.0, 0.7),
        bright_share=(0.002, 0.45),
        shoulder=(0.65, 1.0),
        exposure=(0.05, 0.6),
        cosine_exponent=(0.7, 1.2),
        contrast=(-0.2, 0.3),
    )
    texture = replace(config.texture, saturation=(0.3, 0.85), value=(0.0, 0.35), vessel_value=(0.0, 0.5))
    return replace(config, sensor=sensor, texture=texture, exchange=_EXCHANGE)
