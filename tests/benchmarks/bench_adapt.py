"""Adaptation to another lens, light and tissue: how much of the gap to a network at home there do 200 frames close?

Source: pinhole, mu 0-.5, gamma 2.4-2.6, reflectance 0-.2, plain colons. Target: fisheye, mu 3-3.5, gamma 1.8-2.0,
reflectance .5-.7, realistic colons. All 80x64. Start: self-supervised on 240 source frames. At home: self-supervised
on 2000 target frames of 250 other colons, from nothing. Adapted: on 200 target frames of 25 colons, by `lightdepth
adapt`. Judged on 48 frames of 12 target colons that nobody saw, and on as many of
the source. Every colon's light is known, as of a calibrated endoscope. LIGHTDEPTH_BENCH names a folder to keep what was
made in.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from verbs import by_options

from lightdepth.checkpoint import load_model
from lightdepth.datasets import write_folder
from lightdepth.frame import Frame
from lightdepth.geometry import depth_from_distance
from lightdepth.metrics import DepthErrors
from lightdepth.tube import lens, tube_frames
from train.colons import TubeData, tube_config
from train.commands.adapt import adapt as adapt_verb
from train.commands.train import train

adapt = by_options(adapt_verb)

SIZE = (80, 64)
SOURCE = TubeData(lenses=("pinhole",), mu=(0.0, 0.5), gamma=(2.4, 2.6), reflectance=(0.0, 0.2), family="plain")
TARGET = TubeData(lenses=("fisheye",), mu=(3.0, 3.5), gamma=(1.8, 2.0), reflectance=(0.5, 0.7), family="realistic")
STEPS = {"start": 1000, "home": 2000}


def colon_frames(domain: TubeData, seed: int, count: int) -> list[Frame]:
    camera = lens(domain.lenses[0], *SIZE)
    return tube_frames(seed, count, camera, domain.travel, tube_config(domain))


def trained(domain: TubeData, scenes: int, seed: int, run: Path) -> str:
    """A network self-supervised on synthetic colons of one domain."""
    model = run / "model.safetensors"
    if not model.exists():
        values = {"scenes": scenes, "val_scenes": 2, "lenses": list(domain.lenses), "family": domain.family}
        ranges = {name: list(getattr(domain, name)) for name in ("mu", "gamma", "reflectance")}
        tube = [part for k, v in {**values, **ranges}.items() for part in (f"--data.tube.{k}", str(v))]
        fixed = ["--data.size", str(list(SIZE)), "--model.loss.reflectance", "null", "--seed", str(seed)]
        train(["-o", str(run), *tube, *fixed, "--trainer.max_steps", str(STEPS[run.name]), "--fit.monitor", "last"])
    return str(model)


def target_folders(root: Path, seeds: Sequence[int], count: int) -> tuple[Path, ...]:
    """One folder a colon, with its calibration beside the frames."""
    folders = tuple(root / f"colon_{seed}" for seed in seeds)
    for seed, folder in zip(seeds, folders, strict=True):
        if not folder.exists():
            write_folder([replace(f, name=f.name[-6:]) for f in colon_frames(TARGET, seed, count)], folder)
    return folders


def errors(checkpoint: str, frames: Sequence[Frame]) -> dict[str, float]:
    """Mean depth errors over frames, median-aligned."""
    model, metric = load_model(checkpoint, details=False), DepthErrors("median")
    for frame in frames:
        found = model(frame)
        ray_z = frame.camera.rays()[0][..., 2]
        assert frame.true_distance is not None
        arrays = (found.distance, frame.true_distance, ray_z, found.valid & (frame.true_distance > 0) & (ray_z > 0.15))
        distance, truth, z, valid = (torch.from_numpy(array.copy())[None, None] for array in arrays)
        metric.update(depth_from_distance(distance, z), depth_from_distance(truth, z), valid)
    return {name: float(value) for name, value in metric.compute().items()}


def line(name: str, on_target: dict[str, float], on_source: dict[str, float]) -> str:
    numbers = "  ".join(f"{on_target[key]:.4g}" for key in on_target)
    return f"{name:<28} target AbsRel RMSE MedAE delta1  {numbers}   source AbsRel {on_source['abs_rel_median']:.4f}"


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_two_hundred_frames_close_half_of_the_gap_and_cost_a_start_at_home_little(seed, tmp_path):
    kept = Path(os.environ.get("LIGHTDEPTH_BENCH") or tmp_path) / f"seed{seed}"
    first = 70_000 + 1000 * seed
    unseen = [f for i in range(12) for f in colon_frames(TARGET, first + 500 + i, 4)]
    at_source = [f for i in range(12) for f in colon_frames(SOURCE, first + 600 + i, 4)]
    folders = target_folders(kept / "target", range(first, first + 25), 8)
    start = trained(SOURCE, 30, 10 + seed, kept / "start")
    home = trained(TARGET, 250, 20 + seed, kept / "home")
    made = {"closed form": "decline", "start": start, "at home": home}
    settings = {"default": {}, "replay": {"replay": 10}}
    for name, changes in settings.items():
        for origin, checkpoint in (("start", start), ("at home", home)):
            run = kept / f"{origin} {name}".replace(" ", "_")
            if not run.exists():
                adapt(folders[0], run, checkpoint, folders[1:], keep_worse=True, seed=seed, **changes)
            made[f"{origin}, adapted, {name}"] = str(run / "model.safetensors")
    found = {name: (errors(path, unseen), errors(path, at_source)) for name, path in made.items()}
    print(f"\nseed {seed}")
    for name, judged in found.items():
        print(line(name, *judged))
    target = {name: judged[0]["abs_rel_median"] for name, judged in found.items()}
    gap = target["start"] - target["at home"]
    for name in settings:
        closed = (target["start"] - target[f"start, adapted, {name}"]) / gap
        lost = target[f"at home, adapted, {name}"] / target["at home"] - 1
        print(f"{name}: {closed:.0%} of the gap of {gap:.4f} closed; a start at home loses {lost:+.1%}")
    assert (target["start"] - target["start, adapted, default"]) / gap >= 0.5
    assert target["at home, adapted, default"] <= 1.03 * target["at home"]
