"""Millimetres from the light alone, on synthetic colons whose geometry and poses are known exactly.

    pytest tests/benchmarks/bench_millimetres.py -o python_files='bench_*.py' -o addopts= -s

Colons of seeds that nothing was tuned on, of two renderers that share no line: lightdepth.tube (a pinhole and a
fisheye in turn, one lamp 8 to 15 % of 33 mm beside the lens) and lightdepth.judge_colons (five lenses, four gammas,
one lamp or two at one side of the lens, a wet film, vignetting, paths traced). Twelve frames each, of 320x256 pixels of
the tube and of some 160x128 of the other; the wall throws back little (up to .1) or much (.2 to .6). Of each: the scale
found (right: 1), its 90 % interval, and reflectance.
LIGHTDEPTH_MILLIMETRES=FILE writes the tables.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from lightdepth.camera import CameraModel, KannalaBrandt, Pinhole
from lightdepth.frame import Frame
from lightdepth.judge_colons import JudgeColon, judge_frames
from lightdepth.judge_colons.endoscope import Exposure, LensKind
from lightdepth.judge_colons.lamps import Lamp
from lightdepth.light.looks import typical_distance
from lightdepth.light.millimetres import Look, Millimetres, millimetres
from lightdepth.photometry import MeasuredLamps, PhotometricCalibration
from lightdepth.tube import render_sequence

ENLARGED = int(os.environ.get("LIGHTDEPTH_ENLARGED", "2"))  # times 160x128, of the tube
BASES = (
    Pinhole(160, 128, 86.0, 86.0, 80.0, 64.0),
    KannalaBrandt(160, 128, 70.0, 70.0, 80.0, 64.0, 0.02, -0.01, 0.0, 0.0),
)
LENSES = tuple(base.resized(160 * ENLARGED, 128 * ENLARGED) for base in BASES)
KINDS: tuple[LensKind, ...] = ("plain", "fisheye", "barrel", "narrow", "circle")
EXPOSURES: tuple[Exposure, ...] = ("even", "even", "dark")
FIRST, COUNT = int(os.environ.get("LIGHTDEPTH_FIRST_SEED", "7692")), int(os.environ.get("LIGHTDEPTH_COUNT", "12"))
OTHER_FIRST = int(os.environ.get("LIGHTDEPTH_FIRST_OTHER_SEED", "77150"))
OTHER_COUNT = int(os.environ.get("LIGHTDEPTH_OTHER_COUNT", "8"))
Colon = tuple[list[Look], PhotometricCalibration, float]


def drawn(seed: int, much: bool) -> tuple[float, float]:
    """The light's offset as a share of some 33 mm, and the wall's reflectance."""
    rng = np.random.default_rng(seed)
    return float(rng.uniform(0.08, 0.15)), float(rng.uniform(0.2, 0.6) if much else rng.uniform(0, 0.1))


def frames_at(
    seed: int, lens: CameraModel, share: float, reflectance: float, frames: int = 12
) -> tuple[list[Frame], PhotometricCalibration]:
    """Frames of a tube, with the light beside the lens by a share of some 33 mm."""
    turn = np.random.default_rng(seed).uniform(0, 2 * np.pi)
    place = (33 * share * float(np.cos(turn)), 33 * share * float(np.sin(turn)), 0.0)
    light = PhotometricCalibration(2.2, 1.5, place, reflectance=reflectance, source="given")
    return list(render_sequence(seed, frames, lens, 24.0, None, light).frames), light


@cache
def tube(seed: int, much: bool) -> Colon:
    share, reflectance = drawn(seed, much)
    frames, light = frames_at(seed, LENSES[seed % 2], share, reflectance)
    looks = []
    for f in frames:
        assert f.true_distance is not None and f.true_world_from_cam is not None
        looks.append(Look(f.camera, np.linalg.inv(f.true_world_from_cam), f.image, f.valid, f.true_distance))
    return looks, light, reflectance


def measured(seed: int, much: bool) -> Colon:
    """As `tube`, of a light that was measured on a board: so the response and the lamp's place are sure."""
    looks, light, reflectance = tube(seed, much)
    return looks, replace(light, lamps=MeasuredLamps((light.position_mm,), (1.0,), (0.0, 0.0, 0.0))), reflectance


@cache
def other(seed: int, much: bool) -> Colon:
    """A colon of the judge's machinery, of another seed than the judge's twelve, with its light beside the lens by a
    share of some 26 mm."""
    rng = np.random.default_rng(seed)
    rho = float(rng.uniform(0.2, 0.6) if much else rng.uniform(0.02, 0.1))
    off, turn = 26 * float(rng.uniform(0.08, 0.15)), float(rng.uniform(0, 2 * np.pi))
    gamma, exposure = float(rng.choice([1.0, 1.8, 2.2, 2.4])), EXPOSURES[int(rng.integers(3))]
    tilt = rng.normal(size=2) * 0.05
    x, y, z = (np.array([*tilt, 1.0]) / np.linalg.norm([*tilt, 1.0])).tolist()
    sides = (np.radians(50), -np.radians(50)) if seed % 2 else (0.0,)
    power, lamps = 0.0, []
    for side in sides:
        far, at, depth = off / float(np.cos(side)), turn + side, float(rng.uniform(-1, 0.3))
        power = power or float(rng.uniform(0.4, 2.6))
        place = (far * float(np.cos(at)), far * float(np.sin(at)), depth)
        lamps.append(Lamp(place, (x, y, z), 1 / len(sides), power))
    lens = KINDS[seed // 2 % 5]
    size = (144, 120) if lens == "circle" else (160, 128)
    frames = judge_frames(JudgeColon(str(seed), seed, rho, exposure, lens, gamma, size), quality=6, lamps=lamps)
    looks = []
    for f in (found.frame for found in frames):
        assert f.true_distance is not None and f.true_world_from_cam is not None
        met = f.true_distance > 0
        looks.append(Look(f.camera, np.linalg.inv(f.true_world_from_cam), f.image, met, f.true_distance))
    return looks, frames[0].frame.light, rho


def without_the_lens(seed: int, much: bool) -> Colon:
    """As `other`, of a light file that does not say how much of mu is the lens's."""
    looks, light, rho = other(seed, much)
    return looks, replace(light, lamps=None), rho


WORLDS = (
    ("tube", tube, FIRST, COUNT),
    ("tube, its light measured on a board", measured, FIRST, COUNT),
    ("other renderer, the lens's share of mu known", other, OTHER_FIRST, OTHER_COUNT),
    ("other renderer, it is not known", without_the_lens, OTHER_FIRST, OTHER_COUNT),
)


def rows(
    make: Callable[[int, bool], Colon], seeds: range, much: bool
) -> Iterator[tuple[int, float, float, Millimetres, float]]:
    """Seed, offset as a share of the median distance, reflectance, what was found, seconds."""
    for seed in seeds:
        looks, light, reflectance = make(seed, much)
        offset = float(np.hypot(*light.position_mm[:2])) / typical_distance(looks)
        begun = time.perf_counter()
        yield seed, offset, reflectance, millimetres(looks, light), time.perf_counter() - begun


def test_the_scale_of_colons() -> None:
    lines = []
    for name, make, first, count in WORLDS:
        for much in (False, True):
            lines += [
                f"\n{name}, rho {'.2 to .6' if much else 'up to .1'}\n",
                "| seed | offset | rho | scale | interval | rho found | refused | s |",
                "|---|---|---|---|---|---|---|---|",
            ]
            held, within, told = 0, 0, 0
            seeds = range(first + 12 * much, first + 12 * much + count)
            for seed, offset, reflectance, found, seconds in rows(make, seeds, much):
                low, high = found.interval
                within += not found.refused and abs(np.log(found.mm_per_unit)) < np.log(1.15 if much else 1.05)
                told += not found.refused
                held += not found.refused and low <= 1 <= high
                lines.append(
                    f"| {seed} | {offset:.1%} | {reflectance:.2f} | {found.mm_per_unit:.3f} | {low:.2f} to {high:.2f} "
                    f"| {found.reflectance:.2f} | {found.refused.split(':')[0]} | {seconds:.1f} |"
                )
                print(lines[-1], flush=True)
            bar = 15 if much else 5
            lines.append(f"\nwithin {bar} %: {within} of {count}; told {told}; of these {held} in the interval")
            print(lines[-1], flush=True)
    if "LIGHTDEPTH_MILLIMETRES" in os.environ:
        Path(os.environ["LIGHTDEPTH_MILLIMETRES"]).write_text("\n".join(lines) + "\n", encoding="utf-8")
