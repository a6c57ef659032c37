"""What `densify`, `demo` and `evaluate --checkpoint` make of frames and a sparse map, and how a run folder holds it."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path

from densify.additions import additions, said
from densify.aligned import AlignedKeyframe
from densify.config import DensifyConfig
from densify.dense_map import DenseMap
from densify.gating import LEFT_OUT
from densify.joining import MergeConfig, Merged, joined_name, merge
from densify.judging.doubts import DoubtsCalibrated, calibrated_together
from densify.judging.verdict import Verdict, doubted, headline, proposal, worst
from densify.page import Gallery
from densify.pipeline import SubmapResult, densify_or_empty
from densify.predictions import SeenKeyframe
from densify.resuming import kept_result
from densify.scale_file import MmPerUnit, Scales, factor
from densify.scaling import SeenMap, scales_of
from densify.scene import seen_kinds
from lightdepth.counting import counted, full_stop
from lightdepth.datasets import FrameSequence
from lightdepth.depth_gate import sentence
from lightdepth.errors import InputError
from lightdepth.hidden_uncertainty import FILE
from lightdepth.models import DepthModel
from lightdepth.photometry import PhotometricCalibration
from lightdepth.reporting.kept import kept
from lightdepth.reporting.progress import Progress
from lightdepth.reporting.run import Run, plain
from lightdepth.sparse_map import SparseMap, Submap


@dataclass
class Densified:
    """The densify step as verbs use it: results, and pictures taken on the way."""

    model: str
    results: Sequence[SubmapResult]
    gallery: Gallery
    merged: Merged | None = None
    doubts: tuple[str, ...] = ()
    """sentences on what the surfaces were made of, with which no verdict is green"""
    config: DensifyConfig = field(default_factory=DensifyConfig)
    """the settings that the surfaces were made with"""
    scales: Scales | None = None
    """what the light told of the maps' units; None where it was not asked"""

    @classmethod
    def make(
        cls,
        frames: FrameSequence,
        sparse_map: SparseMap,
        model: DepthModel,
        config: DensifyConfig,
        merging: MergeConfig | None = None,
        run: Run | None = None,
    ) -> Densified:
        """With a run that can be resumed, each submap is a finished part of it, and so are the joined ones."""
        gallery = Gallery(sparse_map)
        count = sum(len(s.keyframes) for s in sparse_map.submaps)
        if run is not None:
            run.log(f"surfaces: {counted(count, 'keyframe')} to be aligned together, then fused one by one")
        with Progress("Densifying", count) as bar:

            def show(submap: Submap, aligned: AlignedKeyframe, seen: SeenKeyframe) -> None:
                gallery(submap, aligned, seen)
                bar.advance()

            def made(submap: Submap) -> SubmapResult:
                return densify_or_empty(submap, frames, model, config, show)

            results = [
                made(s) if run is None else kept_result(run, s, gallery, partial(made, s)) for s in sparse_map.submaps
            ]
        merged = None
        if merging is not None and len(results) > 1:
            with Progress("Joining submaps", count) as bar:
                join = partial(merge, results, frames, model, config, merging, lambda *_: bar.advance())
                merged = join() if run is None else kept(run, "joined", Merged, join)
        return cls(model.name, results, gallery, merged, config=config)

    def ask_light(
        self, run: Run, frames: FrameSequence, light: PhotometricCalibration, wall_mm: float
    ) -> Mapping[int, float] | None:
        """Millimetres per unit of each map, as the light beside the lens tells; None where it tells not all, so that
        all stay in map units. Both are said, and in scale.json."""
        maps = [SeenMap.of(r.dense) for r in self.results if len(r.dense.triangles)]
        self.scales = found = scales_of(maps, frames, light, wall_mm)
        for one in found.maps:
            (run.log if one.mm_per_unit is not None else run.warn)(str(one))
        found.write_file(run.folder, "mm" if found.all_told else "map units", light)
        return found.told if found.all_told else None

    @property
    def of_millimetres(self) -> str:
        """What the verdict says of millimetres that the light was asked for; empty where it was not."""
        if self.scales is None:
            return ""
        if not self.scales.all_told:
            return "the surfaces are in map units, as the light does not tell every map's millimetres"
        reach = max(one.reach for one in self.scales.maps) - 1
        return (
            f"the colour says nothing about the millimetres, which the light gave: nine of ten are within {reach:.0%}"
        )

    @property
    def without_millimetres(self) -> str:
        """That the light was asked for millimetres in vain, the first reason, and its cure; empty where it was not."""
        if self.scales is None or self.scales.all_told:
            return ""
        refused = [one for one in self.scales.maps if one.mm_per_unit is None]
        others = f" (and of {counted(len(refused) - 1, 'other')})" if len(refused) > 1 else ""
        why = "".join(f"; of map {one.map}{others}: {one.refused}; {one.cure}" for one in refused[:1])
        return f"the surfaces are in map units: the light does not tell every map's millimetres{why}"

    @property
    def verdict(self) -> Verdict | None:
        """On all of them: the worst; None where nothing was judged."""
        found = worst([r.verdict for r in self.results if r.verdict is not None])
        if found is None:
            return None
        found = doubted(found, self.doubts)
        return replace(found, sentence="; ".join(filter(None, [found.sentence, self.of_millimetres])))

    @property
    def headline(self) -> str:
        """The verdict in words; empty where nothing was judged."""
        found = headline({r.dense.submap.id: r.verdict for r in self.results if r.verdict is not None}, self.doubts)
        return "; ".join(filter(None, [found, self.of_millimetres])) if found else ""

    @cached_property
    def uncertainty(self) -> DoubtsCalibrated | None:
        """The calibration of the predicted uncertainty on hidden blocks of all maps; None where there is none to
        calibrate, or nothing was judged."""
        return calibrated_together([r.judgement.doubts for r in self.results if r.judgement is not None])

    @property
    def of_uncertainty(self) -> str:
        """Whether the predicted uncertainty was calibrated, in one sentence."""
        if not any(r.judgement for r in self.results):
            return "not calibrated: nothing was judged"
        return str(self.uncertainty or f"not calibrated: {self.model} predicts none")

    @property
    def doubted(self) -> str:
        """Whose depth the gate doubts, and what became of it, in a sentence; empty where nobody's."""
        doubts = {name: why for result in self.results for name, why in result.doubts.items()}
        if not doubts:
            return ""
        alignments = [a for result in self.results for a in result.dense.alignments]
        out = sum(a.reason.startswith(LEFT_OUT) for a in alignments)
        return f"{sentence(doubts, len(alignments))} ({out} left out of the surface for that)"

    def proposals(self) -> dict[int, str]:
        """What could make a map better, by its id, where the images speak against it."""
        told = {r.dense.submap.id: proposal(r.judgement) for r in self.results if r.judgement is not None}
        return {map_id: said for map_id, said in told.items() if said}

    def notes(self, of: str, frames: FrameSequence, light_fit: Mapping[str, object] | None) -> list[str]:
        """Sentences for the page: what the surfaces were made of (`of`), under which light, and what is weak."""
        light = frames.first().light
        under = f"gamma {light.gamma:.3g}, mu {light.mu:.3g} ({light.source})"
        notes = [full_stop(f"Verdict: {self.headline}")] if self.headline else []
        notes += [f"{of}; depth by {self.model}; light of the frames: {under}."]
        notes += [f"Light {light_fit['summary']}."] if light_fit is not None else []
        notes += [full_stop(f"Millimetres, {one}") for one in (self.scales.maps if self.scales is not None else ())]
        notes.append(f"Uncertainty: {self.of_uncertainty}.")
        notes += [f"Light: {self.doubted}."] if self.doubted else []
        told = [(r.dense.submap.id, r.dense.unsure_share) for r in self.results]
        notes += [f"Map {i}: {unsure(share, self.config)}." for i, share in told if share is not None]
        if self.config.recipe == "paper":
            notes.append(f"{said(additions(self.config))}.")
        submaps = [result.dense.submap for result in self.results]
        weak = [str(s.id) for s in submaps if s.weak_visibility]
        if weak:
            notes.append(
                f"Map {', '.join(weak)} came without observations: which points a keyframe saw was guessed by "
                "projection, so scales and inliers are less certain."
            )
        return notes

    def write(self, run: Run, formats: tuple[str, ...], mm_per_unit: MmPerUnit) -> None:
        """Every surface's folder, its figures in run.json and a line for the user. Raises InputError when none was
        made."""
        made = [r for r in self.results if len(r.dense.triangles)]
        if not made:
            reasons = [f"{a.keyframe}: {a.reason}" for r in self.results for a in r.dense.alignments if not a.ok]
            raise InputError(
                "the maps",
                "no keyframe of any could be aligned",
                f"the first reasons: {'; '.join(reasons[:3]) or 'nothing was fused'}",
            )
        if self.verdict is not None:
            run.log(f"verdict: {self.headline}")
            run.record["verdict"] = plain(self.verdict)
        self._write_uncertainty(run)
        note_recipe(run, self.config)
        records = []
        for result in self.results:
            dense, judgement = result.dense, result.judgement
            scale = factor(mm_per_unit, dense.submap.id)
            name = f"map_{dense.submap.id:03d}"
            records.append(
                {
                    "map": dense.submap.id,
                    "keyframes": len(dense.alignments),
                    "aligned": len(dense.aligned),
                    "vertices": len(dense.vertices),
                    "voxel": dense.voxel,
                    "origin": [value * scale for value in dense.submap.origin],
                    "seen_share": result.seen_share,
                    "unsure_share": dense.unsure_share,
                    "coverage": result.coverage and result.coverage.scaled(scale).record(),
                    "verdict": result.verdict and plain(result.verdict),
                    "judge": judgement and judgement.record(),
                    "doubted": result.doubts,
                    "seconds": result.seconds,
                }
            )
            for keyframe, reason in result.unread.items():
                run.fail(f"{name}, keyframe {keyframe}", reason)
            if not len(dense.triangles):
                run.fail(name, next((a.reason for a in dense.alignments if a.reason), "nothing was fused"))
                continue
            _write_map(dense, run.folder / name, formats, mm_per_unit, scale)
            text = f"{name}: {len(dense.aligned)} of {len(dense.alignments)} keyframes aligned, "
            text += f"{len(dense.vertices)} vertices"
            if judgement is not None:
                text += "; " + judgement.summary
                if len(self.results) > 1:
                    run.log(f"{name}: {result.verdict}")
            if result.coverage is not None:
                holes = len(result.coverage.holes)
                text += f"; {result.coverage.well_share:.0%} of the wall seen well, {counted(holes, 'hole')}"
            if dense.unsure_share is not None:
                text += f"; {unsure(dense.unsure_share, self.config)}"
            run.log(f"{text}; {result.seen_share:.0%} of its keyframes' pixels show the surface")
        if self.merged is not None:
            self._write_joined(run, self.merged, formats, mm_per_unit)
        self.gallery.thumbnails.write(run.folder)
        if self.doubted:
            run.log(self.doubted)
        self._say_if_few(run)
        run.record.update(
            {"unit": "mm" if mm_per_unit else "map units", "checkpoint": self.model, "maps": plain(records)}
        )

    def _write_uncertainty(self, run: Run) -> None:
        """Says whether the uncertainty was calibrated; where it was, `predict --uncertainty` takes what is written."""
        found = self.uncertainty
        run.log(f"uncertainty: {self.of_uncertainty}")
        run.record["uncertainty"] = {"sentence": self.of_uncertainty, **({} if found is None else found.record())}
        if found is not None and found.predicted.ok:
            told = {"checkpoint": self.model, "factor": found.predicted.factor, **found.record()}
            (run.folder / FILE).write_text(json.dumps(plain(told), indent=2) + "\n", encoding="utf-8")

    def _say_if_few(self, run: Run) -> None:
        """Surfaces of a map of which most keyframes could not be aligned are written, but part of the work failed."""
        alignments = [a for result in self.results for a in result.dense.alignments]
        aligned = sum(a.ok for a in alignments)
        if 2 * aligned < len(alignments):
            first = next(a for a in alignments if not a.ok)
            run.fail(
                "the alignment",
                f"{aligned} of {len(alignments)} keyframes could be aligned, fewer than half: the surfaces show little "
                f"of the map; do frames, camera and poses belong to it? (keyframe {first.keyframe}: "
                f"{first.reason})",
            )

    def _write_joined(self, run: Run, merged: Merged, formats: tuple[str, ...], mm_per_unit: MmPerUnit) -> None:
        run.record["merge"] = plain(merged.record(partial(factor, mm_per_unit)))
        for result, group in zip(merged.results, merged.groups, strict=True):
            dense, name = result.dense, joined_name(result)
            if not len(dense.triangles):
                run.fail(name, next((a.reason for a in dense.alignments if a.reason), "nothing was fused"))
                continue
            scale = factor(mm_per_unit, next(iter(group)))
            _write_map(dense, run.folder / name, formats, mm_per_unit, scale)
            maps = ", ".join(map(str, sorted(group)))
            text = f"{name}: maps {maps} in one, in the unit of map {next(iter(group))}, "
            run.log(f"{text}{len(dense.aligned)} of {len(dense.alignments)} keyframes aligned")
        for map_id, reason in merged.meeting.alone().items():
            run.log(f"map {map_id} joins no other: {reason}")


def _write_map(dense: DenseMap, folder: Path, formats: tuple[str, ...], unit: MmPerUnit, scale: float) -> None:
    replace(dense, unit="mm" if unit else dense.unit).write(folder, formats, scale, seen_kinds(dense))


def unsure(share: float, config: DensifyConfig) -> str:
    """What was left out of a surface because it is expected to be wrong, in words."""
    return f"{share:.0%} of the pixels are left out, each expected to be over {config.fusion.max_error:g} % off"


def note_recipe(run: Run, config: DensifyConfig) -> None:
    """Says what the recipe adds to the paper, where it is the paper's, in log and run.json."""
    if config.recipe == "paper":
        added = additions(config)
        run.log(said(added))
        run.record["recipe"] = {"name": "paper", "adds": [{**plain(one), "sentence": str(one)} for one in added]}
