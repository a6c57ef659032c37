"""Millimetres from the light alone, on synthetic colons whose geometry and poses are known exactly.

    pytest tests/benchmarks/bench_millimetres.py -o python_files='bench_*.py' -o addopts= -s

Colons of seeds that nothing else uses; twelve frames of 160x128 along 24 mm, a pinhole and a fisheye in turn, the light
8 to 16 % of the median distance beside the lens; the wall throws back little (up to .1) or much (.2 to .6). Of each:
the scale found (right: 1), its stated deviation, and the reflectance. LIGHTDEPTH_MILLIMETRES=FILE writes the table.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from lightdepth.camera import CameraModel, KannalaBrandt, Pinhole
from lightdepth.light.millimetres import Look, Millimetres, millimetres
from lightdepth.photometry import PhotometricCalibration
from lightdepth.tube import render_sequence

LENSES = (
    Pinhole(160, 128, 86.0, 86.0, 80.0, 64.0),
    KannalaBrandt(160, 128, 70.0, 70.0, 80.0, 64.0, 0.02, -0.01, 0.0, 0.0),
)
FIRST, COUNT = int(os.environ.get("LIGHTDEPTH_FIRST_SEED", "7600")), 12


def looks_at(
    seed: int, lens: CameraModel, share: float, reflectance: float, frames: int = 12
) -> tuple[list[Look], PhotometricCalibration]:
    """Looks with true distances at a colon, with the light beside the lens by a share of some 33 mm."""
    turn = np.random.default_rng(seed).uniform(0, 2 * np.pi)
    place = (33 * share * float(np.cos(turn)), 33 * share * float(np.sin(turn)), 0.0)
    light = PhotometricCalibration(2.2, 1.5, place, reflectance=reflectance, source="given")
    rendered = render_sequence(seed, frames, lens, 24.0, None, light)
    looks = []
    for f in rendered.frames:
        assert f.true_distance is not None and f.true_world_from_cam is not None
        looks.append(Look(f.camera, np.linalg.inv(f.true_world_from_cam), f.image, f.valid, f.true_distance))
    return looks, light


def rows(much: bool) -> Iterator[tuple[int, float, float, Millimetres, float]]:
    """Seed, offset as a share of the median distance, reflectance, what was found, seconds."""
    for k in range(COUNT):
        seed = FIRST + 20 * much + k
        rng = np.random.default_rng(seed)
        share, reflectance = (
            float(rng.uniform(0.08, 0.15)),
            float(rng.uniform(0.2, 0.6) if much else rng.uniform(0, 0.1)),
        )
        looks, light = looks_at(seed, LENSES[k % 2], share, reflectance)
        typical = float(np.median(np.concatenate([look.distance[look.distance > 0] for look in looks])))
        begun = time.perf_counter()
        yield seed, 33 * share / typical, reflectance, millimetres(looks, light), time.perf_counter() - begun


def test_the_scale_of_colons() -> None:
    lines = []
    for much in (False, True):
        lines += [
            f"\n{'rho .2 to .6' if much else 'rho up to .1'}\n",
            "| seed | offset | rho | scale | stated deviation | rho found | refused | s |",
        ]
        lines.append("|---|---|---|---|---|---|---|---|")
        held, within, told = 0, 0, 0
        for seed, offset, reflectance, found, seconds in rows(much):
            off = abs(np.log(found.mm_per_unit))
            within += not found.refused and off < np.log(1.15 if much else 1.05)
            told += not found.refused
            held += not found.refused and off < 1.645 * found.deviation
            refused = found.refused.split(":")[0]
            lines.append(
                f"| {seed} | {offset:.1%} | {reflectance:.2f} | {found.mm_per_unit:.3f} | {found.deviation:.3f} "
                f"| {found.reflectance:.2f} | {refused} | {seconds:.1f} |"
            )
            print(lines[-1], flush=True)
        lines.append(
            f"\nwithin {15 if much else 5} %: {within} of {COUNT}; told {told}; of these {held} within 1.645 deviations"
        )
        print(lines[-1], flush=True)
    if "LIGHTDEPTH_MILLIMETRES" in os.environ:
        Path(os.environ["LIGHTDEPTH_MILLIMETRES"]).write_text("\n".join(lines) + "\n", encoding="utf-8")
