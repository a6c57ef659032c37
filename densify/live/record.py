"""What a played sequence leaves in its run folder: surfaces as they are finished, timings, and the record of both."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

from densify.coverage import Coverage, CoverageConfig
from densify.coverage import coverage as coverage_of
from densify.judging.ahead import Ahead
from densify.judging.verdict import doubted, headline, worst
from densify.judging.withheld import Withheld
from densify.live.page import FILES, live_page
from densify.live.play import Finished, Played, time_spent, timings_picture, write_timings
from densify.scene import TRIANGLES, seen_kinds, surface_of
from lightdepth.counting import counted
from lightdepth.depth_gate import sentence
from lightdepth.errors import InputError
from lightdepth.reporting.run import Run, plain
from lightdepth.reporting.scene import Picture, Scene, Surface


@dataclass(frozen=True)
class _MapRecord:
    """One submap's surface."""

    map: int
    """number of the submap"""
    keyframes: int
    """number of its keyframes that were looked at"""
    aligned: int
    """number of those that the surface is made of"""
    vertices: int
    """number of its vertices"""
    voxel: float
    """edge of a voxel, map units"""
    coverage: Coverage | None
    """how well it was seen; None for an empty one"""
    by_images: Withheld | None
    """the surface against distances by parallax; None where the images said nothing"""

    def record(self) -> dict[str, object]:
        """For run.json."""
        counts = {"map": self.map, "keyframes": self.keyframes, "aligned": self.aligned, "vertices": self.vertices}
        seen = {} if self.coverage is None else {"coverage": self.coverage.record()}
        return {**counts, "voxel": self.voxel, **seen}

    def judged(self, played: Sequence[Played]) -> Ahead:
        """What new points of the map and the images say of it."""
        errors = [p.ahead for p in played if p.map == self.map]
        found = Ahead.of(errors, self.keyframes, self.aligned, self.by_images)
        return replace(found, seen_well=None if self.coverage is None else self.coverage.well_share)


class PlayedRun:
    """The run folder of a played sequence; `mm_per_unit` where lengths are to be written in mm, `judged` where there is
    a verdict, which begins with the sentences `doubts` on what was played."""

    def __init__(
        self,
        run: Run,
        coverage: CoverageConfig,
        mm_per_unit: float | None,
        judged: bool = True,
        doubts: tuple[str, ...] = (),
    ) -> None:
        self._run, self._coverage, self._mm_per_unit, self._judged = run, coverage, mm_per_unit, judged
        self._doubts = doubts
        self._records: list[_MapRecord] = []
        self._surfaces: list[Surface] = []  # thinned: only one submap is held whole

    def add(self, done: Finished) -> None:
        """Writes the surface of a submap whose last keyframe is done; an empty one is a failed part of the run."""
        dense = done.dense
        scale, counts = self._mm_per_unit, (len(dense.alignments), len(dense.aligned), len(dense.vertices))
        seen = coverage_of(dense, self._coverage).scaled(scale or 1.0) if len(dense.triangles) else None
        self._records.append(_MapRecord(dense.submap.id, *counts, dense.voxel, seen, done.by_images))
        name = f"map_{dense.submap.id:03d}"
        if not len(dense.triangles):
            self._run.fail(name, next((a.reason for a in dense.alignments if a.reason), "nothing was fused"))
            return
        self._surfaces.append(surface_of(f"map {dense.submap.id}", dense).thinned(TRIANGLES))
        replace(dense, unit="mm" if scale else dense.unit).write(
            self._run.folder / name, ("ply",), scale, seen_kinds(dense)
        )

    def finish(
        self,
        played: Sequence[Played],
        model: str,
        rate: float | None,
        budget_ms: float,
        images: Mapping[str, Picture] = MappingProxyType({}),
    ) -> None:
        """Writes timings, page and record; `images` are those of keyframes by name, for the page. Raises InputError
        where no keyframe of any map could be aligned."""
        run = self._run
        for p in played:
            if p.unread:
                run.fail(f"map_{p.map:03d}, keyframe {p.keyframe}", p.reason)
        if not any(record.vertices for record in self._records):
            reasons = [f"{p.keyframe}: {p.reason}" for p in played if p.reason]
            raise InputError(
                "the maps",
                "no keyframe of any could be aligned",
                f"the first reasons: {'; '.join(reasons[:3]) or 'nothing was fused'}",
            )
        write_timings(played, run.folder / "timings.csv")
        picture = timings_picture(played, budget_ms / 1000)
        (run.folder / "timings.png").write_bytes(picture)
        spent = time_spent(played, budget_ms / 1000)
        unit = "mm" if self._mm_per_unit else "map units"
        judged = {record.map: record.judged(played) for record in self._records if self._judged}
        verdicts = {number: found.verdict for number, found in judged.items()}
        verdict, said = worst(list(verdicts.values())), headline(verdicts, self._doubts)
        if verdict is not None:
            verdict = doubted(verdict, self._doubts)
            run.log(f"verdict: {said}")
        maps = [
            {**record.record(), "verdict": found and plain(found.verdict), "ahead": found and found.record()}
            for record in self._records
            for found in [judged.get(record.map)]
        ]
        run.record.update(plain({"unit": unit, "checkpoint": model, "verdict": verdict, "maps": maps}))
        run.record["timings"] = plain(spent.record())
        run.record["doubted"] = doubts = {p.keyframe: p.doubt for p in played if p.doubt}
        if doubts:
            run.log(sentence(doubts, len(played)))
        timings = spent.timings
        assert timings is not None, "a surface has keyframes that were read"
        time_said = (
            f"{timings.share_in_budget:.0%} of {spent.read} keyframes within {budget_ms:g} ms; median ms: "
            + ", ".join(f"{step} {figures.median_ms:.1f}" for step, figures in timings.steps.items())
            + f"; without the network {timings.without_network.median_ms:.1f}"
        )
        run.log(time_said)
        notes = [
            f"{counted(len(played), 'keyframe')} of {counted(len(self._records), 'submap')} came one by one, as in a "
            f"procedure; depth by {model}. Lengths are in {unit}.",
            f"{time_said[0].upper()}{time_said[1:]}.",
        ]
        if rate is not None:
            run.log(f"at {rate:g} keyframes per second, {timings.share_in_time:.0%} were on the surface in that time")
        page = live_page(said, judged, played, notes, picture, Scene.of(self._surfaces, images))
        page.files(run.folder, FILES)
        page.write(run.folder / "report.html")
