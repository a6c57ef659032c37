"""A recorded sequence played against the clock: what a live surface would have cost, keyframe by keyframe.

Keyframes come in the order of the recording, submap after submap. A keyframe's time is all that happens between its
arrival and the renewed surface: reading the image, inference, alignment, integration, marching cubes.
"""

from __future__ import annotations

import csv
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from densify.config import MethodConfig
from densify.dense_map import DenseMap
from densify.judging.ahead import NOTHING, Ahead
from densify.judging.withheld import Withheld
from densify.live.densifier import STEPS, Densifier, StepTime
from densify.predictions import Predictor
from lightdepth.datasets import FrameSequence
from lightdepth.depth_gate import DepthGate
from lightdepth.errors import InputError
from lightdepth.foreign_text import for_table
from lightdepth.reporting.figures import chart, chart_png
from lightdepth.sparse_map import Keyframe, SparseMap, Submap

ALL_STEPS = ("read", *STEPS)
_COLORS = ("#8c8c8c", "#2a6f97", "#8a6fb0", "#e09f3e", "#9e2a2b", "#5a8f5a")


@dataclass(frozen=True, eq=False)
class Played:
    """One keyframe. `times` by step; `arrival` and `done` in seconds since the first; `renewed` blocks were looked at
    again, `patches` hold the surface. `reason` says why it took no part, `unread` that its image was not there; `doubt`
    why its depth is doubted (lightdepth.depth_gate), which changes nothing of the surface; `ahead` are errors (n, 5)
    of the depth before it at its new points (densify.judging.ahead)."""

    map: int
    keyframe: str
    times: Mapping[str, StepTime]
    arrival: float
    done: float
    renewed: int
    patches: int
    kept_bytes: int
    reason: str = ""
    unread: bool = False
    doubt: str = ""
    ahead: np.ndarray = field(default_factory=lambda: NOTHING)

    @property
    def total(self) -> StepTime:
        return sum(self.times.values(), StepTime())


@dataclass(frozen=True)
class Finished:
    """A submap's surface when its last keyframe is done, and how far it is from distances by parallax between its
    images; None where they were not asked or said nothing."""

    dense: DenseMap
    by_images: Withheld | None = None

    @classmethod
    def of(cls, densifier: Densifier) -> Finished:
        seen = densifier.seen()
        dense = densifier.dense_map(seen)
        told = [(k, seen[k.name].every) for k in dense.submap.keyframes if k.name in seen]
        return cls(dense, Withheld.of(dense, told))


def play(
    frames: FrameSequence,
    sparse_map: SparseMap,
    model: Predictor,
    config: MethodConfig,
    on_map: Callable[[Finished], None],
    rate: float | None = None,
    on_keyframe: Callable[[Played], None] | None = None,
) -> list[Played]:
    """All keyframes, one by one; `on_map` is given each submap's surface when its last keyframe is done.

    With `rate` [keyframes per second] the n-th keyframe is not there before n / rate seconds, and waits while an
    earlier one is worked on; without, each comes when the last is done. The clock stands still while a finished surface
    is judged by its images and written. Only one submap is held at a time.
    """
    if rate is not None and not rate > 0:
        raise InputError("rate", f"{rate}", "expected keyframes per second, above 0")
    submaps = sorted(sparse_map.submaps, key=lambda s: min(k.number for k in s.keyframes))
    Densifier(model, config).warm_up(submaps[0].keyframes[0].camera)
    played: list[Played] = []
    start = time.perf_counter()
    for submap in submaps:
        densifier = Densifier(model, config, submap.id)
        for keyframe in sorted(submap.keyframes, key=lambda k: k.number):
            arrival = time.perf_counter() - start
            if rate is not None:
                time.sleep(max(0.0, len(played) / rate - arrival))
                arrival = len(played) / rate
            played.append(_play_one(densifier, submap, keyframe, frames, arrival, start))
            if on_keyframe is not None:
                on_keyframe(played[-1])
        if densifier.alignments:
            began = time.perf_counter()
            done = Finished.of(densifier)
            submap_there = replace(done.dense.submap, origin=submap.origin)
            on_map(replace(done, dense=replace(done.dense, submap=submap_there)))
            start += time.perf_counter() - began  # nothing waits for it: the next submap need not
    return played


def _play_one(
    densifier: Densifier, submap: Submap, keyframe: Keyframe, frames: FrameSequence, arrival: float, start: float
) -> Played:
    wall, cpu = time.perf_counter(), time.process_time()
    frame, reason, asked = None, "", len(densifier.ahead)
    try:
        frame = frames.of_keyframe(keyframe)
    except InputError as error:
        reason = str(error)
    densifier.times = {"read": StepTime(time.perf_counter() - wall, time.process_time() - cpu)}
    if frame is not None:
        rows, there = submap.rows_of(keyframe.point_ids)
        observed = replace(keyframe, pixels=keyframe.pixels[there], point_ids=keyframe.point_ids[there])
        try:
            reason = densifier.add_keyframe(frame, observed, submap.points[rows[there]]).reason
        except InputError as error:
            reason = str(error)
    mesh = densifier.mesh()
    done = time.perf_counter() - start
    return Played(
        map=submap.id,
        keyframe=keyframe.name,
        times=dict(densifier.times),
        arrival=arrival,
        done=done,
        renewed=len(mesh.renewed),
        patches=len(mesh.patches),
        kept_bytes=densifier.kept_bytes,
        reason=reason,
        unread=frame is None,
        doubt="" if frame is None else DepthGate().doubt(frame),
        ahead=np.concatenate([NOTHING, *densifier.ahead[asked:]]),
    )


@dataclass(frozen=True)
class StepFigures:
    """What a step took over the keyframes of a run, in milliseconds."""

    median_ms: float
    """median on the clock"""
    p95_ms: float
    """95th percentile on the clock"""
    cpu_ms: float
    """median of processor time, of all threads together"""

    @classmethod
    def of(cls, times: Iterable[StepTime]) -> StepFigures:
        wall, cpu = (1000 * np.array(a) for a in zip(*((t.wall, t.cpu) for t in times), strict=True))
        return cls(float(np.median(wall)), float(np.quantile(wall, 0.95)), float(np.median(cpu)))


@dataclass(frozen=True)
class Timings:
    """What the keyframes of a run took."""

    budget_ms: float
    """time that a keyframe may take, milliseconds"""
    share_in_budget: float
    """share of keyframes whose time is at most the budget"""
    share_in_time: float
    """share of keyframes whose surface was there that long after their arrival"""
    steps: Mapping[str, StepFigures]
    """by step"""
    without_network: StepFigures
    """all steps but inference"""
    total: StepFigures
    """all steps"""
    kept_bytes: int
    """memory that the surfaces hold"""


@dataclass(frozen=True)
class TimeSpent:
    """How many keyframes a run had, and what those took that could be read."""

    keyframes: int
    """number of keyframes"""
    read: int
    """number of keyframes whose image was there"""
    timings: Timings | None
    """what these took; None where there are none"""

    def record(self) -> dict[str, object]:
        """For run.json, flat."""
        timings = {} if self.timings is None else asdict(self.timings)
        return {"keyframes": self.keyframes, "read": self.read, **timings}


def time_spent(played: Sequence[Played], budget: float) -> TimeSpent:
    """Figures of a run whose keyframes may take `budget` seconds each."""
    shown = [p for p in played if not p.unread]
    if not shown:
        return TimeSpent(len(played), 0, None)
    without = [sum((t for step, t in p.times.items() if step != "predict"), StepTime()) for p in shown]
    timings = Timings(
        budget_ms=1000 * budget,
        share_in_budget=float(np.mean([p.total.wall <= budget for p in shown])),
        share_in_time=float(np.mean([p.done - p.arrival <= budget for p in shown])),
        steps={step: StepFigures.of([p.times.get(step, StepTime()) for p in shown]) for step in ALL_STEPS},
        without_network=StepFigures.of(without),
        total=StepFigures.of([p.total for p in shown]),
        kept_bytes=sum({p.map: p.kept_bytes for p in shown}.values()),
    )
    return TimeSpent(len(played), len(shown), timings)


def write_timings(played: Sequence[Played], path: Path) -> None:
    """A table with a row for each keyframe; times in milliseconds, `cpu_…` of all threads together; `ahead` is the
    median share by which the depth before it was off at its new points, `ahead_constant` that of a constant distance.
    """
    with path.open("w", newline="", encoding="utf-8", errors="surrogateescape") as file:
        table = csv.writer(file)
        steps = [f"{kind}{step}_ms" for kind in ("", "cpu_") for step in (*ALL_STEPS, "total")]
        table.writerow(
            ["map", "keyframe", "arrival_s", "done_s", *steps, "blocks_renewed", "patches", "kept_kb"]
            + ["new_points", "ahead", "ahead_constant", "reason"]
        )
        for p in played:
            times = [*(p.times.get(step, StepTime()) for step in ALL_STEPS), p.total]
            row = [f"{1000 * value:.2f}" for kind in ("wall", "cpu") for value in (getattr(t, kind) for t in times)]
            when = [f"{p.arrival:.3f}", f"{p.done:.3f}"]
            found = Ahead.of([p.ahead], 1, 1)
            shares = [f"{v:.4f}" if len(p.ahead) else "" for v in (found.number, found.columns.constant)]
            last = [p.renewed, p.patches, p.kept_bytes // 1000, len(p.ahead), *shares, for_table(p.reason)]
            table.writerow([p.map, for_table(p.keyframe), *when, *row, *last])


def timings_picture(played: Sequence[Played], budget: float) -> bytes:
    """PNG: what each keyframe's time went into, on the clock, beside the budget [s] and the processor time. The longest
    ones, of which the first waits for compilers, are cut off: the others would be too low to read."""
    figure, axes = chart((7.2, 3.6))
    place = np.arange(len(played))
    bottom = np.zeros(len(played))
    names = {"predict": "inference", "judge": "judge", "align": "alignment", "integrate": "integration"}
    names["extract"] = "marching cubes"
    for step, color in zip(ALL_STEPS, _COLORS, strict=True):
        height = np.array([1000 * p.times.get(step, StepTime()).wall for p in played])
        label = f"{names.get(step, 'reading')}, median {np.median(height):.1f} ms"
        axes.bar(place, height, 1.0, bottom, color=color, linewidth=0, label=label)
        bottom += height
    cpu = np.array([1000 * p.total.cpu for p in played])
    axes.plot(place, cpu, ".", color="black", markersize=2, label=f"processor, median {np.median(cpu):.0f} ms")
    axes.axhline(1000 * budget, color="black", linewidth=1, linestyle="--", label=f"budget {1000 * budget:g} ms")
    for before, after in zip(place[:-1], place[1:], strict=True):
        if played[before].map != played[after].map:
            axes.axvline(after - 0.5, color="white", linewidth=1)
    axes.set_xlim(-0.5, len(played) - 0.5)
    if bottom.max() > (top := max(1.15 * 1000 * budget, 1.15 * float(np.quantile(bottom, 0.9)))):
        axes.plot([], [], " ", label=f"longest {bottom.max():.0f} ms")
    axes.set_ylim(0, top)
    axes.set_xlabel("keyframe")
    axes.xaxis.get_major_locator().set_params(integer=True)
    axes.set_ylabel("ms")
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=8, frameon=False, reverse=True)
    return chart_png(figure)
