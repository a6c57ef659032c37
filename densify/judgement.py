"""The judge of a submap: it hides blocks of wall, asks the images, lessens bends that make things worse, and speaks.

It goes along with the pipeline: it sees every keyframe as it is predicted, judges the bends once they are all aligned,
and the surface once it is there. The surface rests on every point of the map; what is hidden is hidden from alignments
that are made for the judge alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from densify.agreement import unbent
from densify.aligned import AlignedKeyframe, bent_finer
from densify.alignment import bent
from densify.bending import Bend
from densify.config import DensifyConfig
from densify.dense_map import DenseMap
from densify.judging.brake import Kept, Tried, kept, kept_of_finer
from densify.judging.columns import Columns, FourWays, Method, hidden_errors, hidden_ratios
from densify.judging.doubts import Doubts, sigma_at
from densify.judging.images import Images, Seen
from densify.judging.verdict import Judgement
from densify.judging.withheld import Withheld
from densify.predictions import SeenKeyframe
from lightdepth.blocks import submap_folds
from lightdepth.hidden_uncertainty import HiddenErrors
from lightdepth.sparse_map import Submap
from lightdepth.triangulation import PointNoise


class Judge:
    """The judge of one submap; switched off, it hides, keeps and undoes nothing. Raises InputError where it is switched
    on and no keyframe observes a point."""

    def __init__(self, submap: Submap, config: DensifyConfig) -> None:
        self._submap, self._config = submap, config
        self._method = Method(config.alignment, config.agreement, config.bending)
        self._images = Images(config.judge.parallax)
        on, none = config.judge.on, np.zeros(0, int)
        self._fold = submap_folds(submap, config.judge.folds, config.judge.seed) if on else none
        self._ratios: dict[str, np.ndarray] = {}
        self._sigma: dict[str, np.ndarray] = {}
        self._told: dict[str, Seen] = {}
        self._kept: dict[str, Kept] = {}

    def see(self, k: AlignedKeyframe, seen: SeenKeyframe) -> None:
        """Keeps what the images of a keyframe will be asked for, and the uncertainty predicted of its points."""
        if self._config.judge.on and seen.frame is not None and seen.prediction is not None:
            self._images.see(k.keyframe, seen.frame, seen.prediction)
            sigma = None if k.observed is None else sigma_at(seen.prediction, k.observed.pixels)
            if sigma is not None:
                self._sigma[k.keyframe.name] = sigma

    @property
    def told(self) -> Mapping[str, Seen]:
        """What the images tell of each keyframe's distances, by name; nothing before `braked`."""
        return self._told

    def refined(self, keyframes: Sequence[AlignedKeyframe], shared: np.ndarray) -> list[AlignedKeyframe]:
        """The same keyframes, with as much of what a finer grid adds to their bends as the images speak for. Blocks of
        wall are hidden from alignments without it. `shared` (n, n) counts the points that two keyframes share."""
        bending = self._config.bending
        bends = self._config.agreement.on and bending.on and bending.finer > 0
        if not (bends and self._config.judge.on and self._look()):
            return list(keyframes)
        finer = bent_finer(keyframes, shared, self._config)
        errors = [np.zeros((0, 2))]
        for k in keyframes:
            if k.keyframe.name in finer and k.bend is not None:
                errors.append(self._by_images(k.keyframe.name, k.bend, finer[k.keyframe.name]))
        share = kept_of_finer(np.concatenate(errors))
        if share == 0:
            return list(keyframes)
        return [self._mixed(k, finer[k.keyframe.name], share) if k.keyframe.name in finer else k for k in keyframes]

    def _mixed(self, k: AlignedKeyframe, finer: Bend, share: float) -> AlignedKeyframe:
        assert k.bend is not None and k.alone is not None and k.view is not None
        coarse = k.bend.with_finer()
        mixed = replace(coarse, weights=coarse.weights + share * (finer.weights - coarse.weights))
        alignment = bent(k.alone, mixed, k.view.observed, self._config.alignment)
        return replace(k, bend=mixed, alignment=alignment) if alignment.bend is not None else k

    def braked(self, keyframes: Sequence[AlignedKeyframe]) -> list[AlignedKeyframe]:
        """The same keyframes, each with as much of its bend as makes things better, and the reason for less."""
        self._ask(keyframes)
        tried = {k.keyframe.name: self._tried(k) for k in keyframes if k.alone is not None and k.alignment.bend}
        self._kept = kept(tried) if self._config.judge.on else {}
        return [self._lessened(k) if k.keyframe.name in self._kept else k for k in keyframes]

    def _shares(self, keyframes: Sequence[AlignedKeyframe]) -> list[float]:
        """What is kept of their bends, of those keyframes that the surface is made of."""
        names = (k.keyframe.name for k in keyframes if k.alignment.ok)
        return [self._kept[name].share for name in names if name in self._kept]

    def _ask(self, keyframes: Sequence[AlignedKeyframe]) -> None:
        """Hides blocks of wall, and measures between the images; once."""
        if self._ratios or not self._config.judge.on:
            return
        self._look()
        for k in keyframes:
            if k.view is not None and len(k.view.observed):
                fold = self._fold[self._submap.rows_of(k.view.observed.point_ids)[0]]
                self._ratios[k.keyframe.name] = hidden_ratios(k.view, fold, self._method)

    def _look(self) -> dict[str, Seen]:
        """Measures between the images; once."""
        if not self._told:
            self._told = self._images.measure(self._submap)
        return self._told

    def judgement(self, dense: DenseMap, keyframes: Sequence[AlignedKeyframe]) -> Judgement | None:
        """What is known of the surface; None where the judge is switched off."""
        if not self._config.judge.on:
            return None
        self._ask(keyframes)
        rng = np.random.default_rng([self._config.judge.seed, self._submap.id])
        drawn, images, delivered = [], [], []
        for k in keyframes:
            if k.view is None or not len(k.view.observed):
                continue
            fold = -rng.integers(0, self._config.judge.folds, len(k.view.observed))
            drawn.append(hidden_errors(k.view, fold, self._method))
            if k.keyframe.name in self._ratios:
                delivered.append(np.abs(np.exp(self._log_delivered(k)) - 1))
            told = self._told.get(k.keyframe.name)
            if told is not None and len(told.judging) and len(k.view.observed) >= self._config.alignment.min_points:
                images.append(FourWays.of(k.view, self._method).errors(told.judging))
        points = [(k.keyframe, self._told[k.keyframe.name].judging) for k in keyframes if k.keyframe.name in self._told]
        sizes = [_size(k.alignment.bend) for k in keyframes if k.alignment.bend]
        blocks = [np.abs(ratios - 1) for ratios in self._ratios.values()]
        shares = self._shares(keyframes)
        return Judgement(
            blocks=Columns.of(blocks),
            drawn=Columns.of(drawn),
            images=Columns.of(images),
            hidden=Withheld.of_errors(np.concatenate([np.zeros(0), *delivered])),
            hidden_constant=Withheld.of_errors(np.concatenate([np.zeros(0), *(errors[:, 3] for errors in blocks)])),
            surface=Withheld.of(dense, points),
            keyframes=len(keyframes),
            aligned=sum(k.alignment.ok for k in keyframes),
            undone=sum(share == 0 for share in shares),
            lessened=sum(0 < share < 1 for share in shares),
            bends=float(np.median(sizes)) if sizes else 0.0,
            doubts=self._doubts(keyframes),
            asked=self._config.judge.parallax.on,
        )

    def _doubts(self, keyframes: Sequence[AlignedKeyframe]) -> Doubts | None:
        """The hidden points with what uncertainty was predicted of them; None where none was."""
        noise = PointNoise(self._submap) if self._sigma else None
        predicted: list[HiddenErrors] = []
        delivered: list[HiddenErrors] = []
        for k in keyframes:
            name, view = k.keyframe.name, k.view
            if noise is None or view is None or name not in self._ratios or name not in self._sigma:
                continue
            told = self._ratios[name], self._sigma[name], noise.along(k.keyframe, view.observed.point_ids)
            fold = self._fold[self._submap.rows_of(view.observed.point_ids)[0]]
            use = np.isfinite(told[0][:, 0]) & (told[1] > 0)
            ratio, sigma, spread = (each[use] for each in told)
            where = fold[use], view.observed.pixels[use] / k.keyframe.camera.width
            for error, into in ((np.log(ratio[:, 0]), predicted), (self._log_delivered(k)[use], delivered)):
                into.append(HiddenErrors(error, sigma, spread, *where))
        # A map whose points err together would be called the model's error.
        undone, aligned = self._shares(keyframes).count(0), sum(k.alignment.ok for k in keyframes)
        against = f"{undone} of {aligned} bends to the map's points had to be undone" if 2 * undone > aligned else ""
        return Doubts(tuple(predicted), tuple(delivered), against) if predicted else None

    def _log_delivered(self, k: AlignedKeyframe) -> np.ndarray:
        """Errors (n,) in log distance at hidden points, with the share of its bend that a keyframe was delivered
        with."""
        kept = self._kept.get(k.keyframe.name)
        share = 0.0 if k.alignment.bend is None else 1.0 if kept is None else kept.share
        one, bend = np.log(self._ratios[k.keyframe.name][:, :2]).T
        result: np.ndarray = one + share * (bend - one)
        return result

    def _tried(self, k: AlignedKeyframe) -> Tried:
        bend, alone = k.alignment.bend, k.alone
        assert bend is not None and alone is not None and k.view is not None
        level = unbent(replace(k.view, scale=alone.scale), self._config.bending)
        by_images = self._by_images(k.keyframe.name, level, bend)
        blocks = np.abs(self._ratios.get(k.keyframe.name, np.zeros((0, 4))) - 1)
        return Tried(by_images, blocks[:, :2], _size(bend))

    def _by_images(self, name: str, *bends: Bend) -> np.ndarray:
        """Errors (n, b) of a keyframe's bends in log distance, by the distances that decide."""
        told = self._told.get(name)
        if told is None or not len(told.deciding):
            return np.zeros((0, len(bends)))
        o = told.deciding
        log_predicted = np.stack([b.at(o.pixels, o.predicted) for b in bends], 1) + np.log(o.predicted)[:, None]
        result: np.ndarray = log_predicted - np.log(o.mapped)[:, None]
        return result

    def _lessened(self, k: AlignedKeyframe) -> AlignedKeyframe:
        """With the share of its bend that it keeps, or one scale where points distrust even that."""
        kept, alone, whole = self._kept[k.keyframe.name], k.alone, k.alignment.bend
        if kept.share == 1:
            return k
        assert alone is not None and whole is not None and k.view is not None
        if kept.share > 0:
            part = replace(whole, weights=kept.share * whole.weights)
            part.weights[0] += (1 - kept.share) * np.log(alone.scale)
            alignment = bent(alone, part, k.view.observed, self._config.alignment)
            if alignment.bend is not None:
                return replace(k, alignment=replace(alignment, unbent_because=kept.reason), bend=part)
            kept = self._kept[k.keyframe.name] = Kept(0.0, f"{kept.reason}, and its points confirm no such part of it")
        alignment = replace(alone, unbent_because=kept.reason)
        level = unbent(replace(k.view, scale=alone.scale), self._config.bending)
        return replace(k, alignment=alignment, bend=level)


def _size(bend: Bend) -> float:
    """The larger of slope and bumps (root mean square), in deviations of their prior."""
    own = bend.weights[1:] * np.sqrt(bend.config.precision[1:])
    slopes = 1 if bend.config.on and bend.config.slope_deviation else 0
    bumps = float(np.sqrt((own[slopes:] ** 2).mean())) if len(own) > slopes else 0.0
    return max(float(np.abs(own[:slopes]).max(initial=0.0)), bumps)
