"""Depth errors of networks, and of the closed form, on colons that no row is trained on."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import torch

from lightdepth.decline import log_closed_form
from lightdepth.frame import FrameBatch, to_batch
from lightdepth.geometry import depth_from_distance
from lightdepth.losses import LossConfig, self_supervised_loss
from lightdepth.metrics import DepthErrors
from lightdepth.module import MIN_RAY_Z
from lightdepth.network import DepthNetwork
from lightdepth.reporting.progress import Progress
from lightdepth.tube.variant import REFLECTANCE, variant_frames

from ..colons import TubeData, tube_scene, with_reflectance
from ..loader import collate
from .rows import JudgedColons

FARTHEST_MM = 100.0
WRONG_BY = 0.3
_CANDIDATES = tuple(k / 10 for k in range(8))


class Judge:
    """Depth errors, median-aligned per frame, on sets of colons: z < 100 mm, ray_z > .15, inside the mask."""

    def __init__(self, judged: Sequence[JudgedColons], tube: TubeData, size: tuple[int, int]) -> None:
        with Progress("Rendering colons to judge on", sum(colons.count for colons in judged)) as bar:
            self.sets = {colons.name: list(_rendered(colons, tube, size, bar)) for colons in judged}
        found = {name: [_closed_form(colon) for colon in colons] for name, colons in self.sets.items()}
        self.closed_form = {name: _errors(found[name], colons) for name, colons in self.sets.items()}

    @torch.no_grad()
    def __call__(self, network: DepthNetwork, loss: LossConfig, told: str) -> dict[str, dict[str, float]]:
        """Errors by set. `told` is what the light's calibration says of the wall's reflectance: see Row."""
        found = {}
        for name, colons in self.sets.items():
            distances = []
            for colon in colons:
                seen = colon
                if told == "wrong":
                    seen = with_reflectance(colon, colon.light.reflectance + WRONG_BY)
                elif told == "estimated":
                    seen = _estimated(network, colon, loss)
                distances.append(network(seen.image, seen.mask, seen.rays, seen.light)[0])
            found[name] = _errors(distances, colons)
        return found


def _rendered(colons: JudgedColons, tube: TubeData, size: tuple[int, int], bar: Progress) -> Iterator[FrameBatch]:
    """A batch a colon."""
    from lightdepth.tube import lens

    for i, seed in enumerate(colons.seeds):
        if colons.make == "variant":
            camera = lens(tube.lenses[i % len(tube.lenses)], *size)
            frames = variant_frames(seed, colons.frames, camera, colons.strength, tube.travel)
            yield collate([to_batch(frame, size) for frame in frames])
        else:
            light = REFLECTANCE[colons.strength]
            same = replace(tube, frames=colons.frames, family=colons.make, scene=None, reflectance=light)
            yield collate(tube_scene(same, seed, i, size))
        bar.advance()


def _closed_form(colon: FrameBatch) -> torch.Tensor:
    return log_closed_form(colon.image, colon.mask, colon.rays, colon.light).exp()


def _errors(distances: Sequence[torch.Tensor], colons: Sequence[FrameBatch]) -> dict[str, float]:
    metric = DepthErrors("median")
    for distance, colon in zip(distances, colons, strict=True):
        ray_z = colon.rays[:, 2:3]
        truth = depth_from_distance(colon.true_distance, ray_z)
        valid = colon.true_valid & (ray_z > MIN_RAY_Z) & (truth < FARTHEST_MM)
        metric.update(depth_from_distance(distance, ray_z), truth, valid)
    return {name.removesuffix("_median"): float(value) for name, value in metric.compute().items()}


def _estimated(network: DepthNetwork, colon: FrameBatch, loss: LossConfig) -> FrameBatch:
    """The colon with the reflectance under which the network's answer has the least loss; no truth is looked at."""
    told = [with_reflectance(colon, torch.full_like(colon.light.reflectance, rho)) for rho in _CANDIDATES]
    losses = []
    for batch in told:
        distance, albedo_hs = network(batch.image, batch.mask, batch.rays, batch.light)
        losses.append(float(self_supervised_loss(distance, albedo_hs, batch, loss)[0]))
    return told[losses.index(min(losses))]
