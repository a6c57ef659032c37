"""One scene of the benchmark: what every row makes of it, as `lightdepth evaluate` judges it.

A cell is one scene with one share of wrong points. Its rows are the sparse map, its inliers (those of the last row),
and a dense map for each model and recipe. Models see each keyframe once; the rows share what they said.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, fields, replace
from functools import partial
from typing import Annotated

import numpy as np

from densify.bench.cases import CASES, WRONG_SHARE, Case
from densify.bench.curves import Band, FrontPoint, bands, front
from densify.bench.scenes import Rendered, Scene, Size, render, render_moving
from densify.config import DensifyConfig, Recipe
from densify.dense_map import DenseMap
from densify.evaluation.errors import compare_depth, rms
from densify.evaluation.judge import judge_maps
from densify.evaluation.judged_map import JudgedMap
from densify.evaluation.records import SurfaceFigures
from densify.evaluation.trajectory import align_trajectory, keyframe_trajectory
from densify.pipeline import densify
from densify.similarity import Similarity
from lightdepth.checkpoint import DEFAULT_CHECKPOINT, Device, load_called
from lightdepth.errors import InputError
from lightdepth.frame import Frame
from lightdepth.models import DepthModel
from lightdepth.prediction import DepthPrediction
from lightdepth.ranges import BELOW_ONE, SEED, at_least, checked
from lightdepth.sparse_map import Submap

SPARSE, INLIERS = "sparse map", "sparse inliers"
WAYS = ("one scale", "full")
"""In which each case is made dense: without bending, and as densify does it."""
SHARES: dict[Size, tuple[float, ...]] = {"small": (0.1, 0.45), "full": (0.0, 0.1, 0.3, 0.45)}
IMAGE_SIZE: dict[Size, tuple[int, int]] = {"small": (160, 128), "full": (320, 256)}


@dataclass(frozen=True)
@checked
class BenchConfig:
    """What the benchmark measures."""

    size: Size = "small"
    """How much is measured: small, or full, with more and longer sequences and a screening."""
    first_seed: Annotated[int, SEED] = 400
    """Number that seeds the first scene; the others count on from it. Another one draws other colons."""
    wrong_shares: Annotated[tuple[float, ...], BELOW_ONE] = SHARES["small"]
    """Shares of wrong map points, each a SLAM export of its own; the screening has one of its
    own, screening_share. More shares take longer."""
    screening_share: Annotated[float, BELOW_ONE] = 0.3
    """Share of wrong map points of the screening, which is ten times as long as the other scenes and so is judged at
    one share only. A larger one makes it harder."""
    checkpoints: tuple[str, ...] = ("decline", DEFAULT_CHECKPOINT)
    """Models to compare: paths, names of bundled ones, decline (the closed form) or constant."""
    recipes: tuple[Recipe, ...] = ("paper", "full")
    """Ways to make dense maps that are compared: paper, full, or both."""
    cases: tuple[Case, ...] = ()
    """Map errors that come together (densify.bench.cases), each a cell of its own in the short sequences, made dense by
    the last model with one scale a keyframe and in full. More cases take longer."""
    image_size: Annotated[tuple[int, int], at_least(32, up_to=10_000)] = IMAGE_SIZE["small"]
    """Width and height of the keyframes, pixels. A larger one takes longer."""
    densify: DensifyConfig = field(default_factory=DensifyConfig)
    """How dense maps are made, for all dense rows but for their recipe."""

    def __post_init__(self) -> None:
        for name in ("wrong_shares", "checkpoints", "recipes", "cases"):
            given = getattr(self, name)
            if (not given and name != "cases") or len(set(given)) < len(given):
                raise InputError(name, f"{list(given)}", "expected at least one, and none twice")

    def shares(self, scene: Scene) -> tuple[float, ...]:
        return self.wrong_shares if scene.maps == 1 else (self.screening_share,)

    def cases_of(self, scene: Scene) -> tuple[Case, ...]:
        return self.cases if scene.maps == 1 else ()

    def rows_of(self, scene: Scene) -> int:
        """How many dense maps are made of a scene."""
        of_shares = len(self.shares(scene)) * len(self.checkpoints) * len(self.recipes)
        return of_shares + len(self.cases_of(scene)) * len(WAYS)


@dataclass(frozen=True, eq=False)
class Predicted:
    """A rendered scene with what each model says of its keyframes, by model and frame; and the same, said by the last
    model alone, of the cases in which its wall moves."""

    rendered: Rendered
    predictions: Mapping[str, Mapping[str, DepthPrediction]]
    moving: Mapping[Case, Predicted] = field(default_factory=dict)

    @classmethod
    def of(cls, rendered: Rendered, models: Sequence[DepthModel]) -> Predicted:
        return cls(rendered, {m.name: {f.name: m(f) for f in rendered.frames} for m in models})


def predicted(
    scene: Scene, image_size: tuple[int, int], models: Sequence[DepthModel], cases: Sequence[Case] = ()
) -> Predicted:
    """A scene, and those of `cases` that need images of their own."""
    still = Predicted.of(render(scene, image_size), models)
    moves = {case: CASES[case].breathing for case in cases if CASES[case].breathing.amplitude > 0}
    moving = {case: Predicted.of(render_moving(still.rendered, how), models[-1:]) for case, how in moves.items()}
    return replace(still, moving=moving)


@dataclass(frozen=True)
class ModelSources:
    """Which depth models are compared, and what they run on."""

    checkpoints: tuple[str, ...] = ("decline", DEFAULT_CHECKPOINT)
    """Depth models to compare, each a row: path of a checkpoint, bundled name, decline (a formula for how light fades
    with distance, no network) or constant (everything equally far)."""
    device: Device = "auto"
    """What networks run on: auto, a CUDA GPU where there is one, else the processor; cpu, the processor; cuda; or mps,
    the GPU of an Apple computer."""


def load_models(checkpoints: Sequence[str], device: Device = "auto") -> list[DepthModel]:
    """The models that the rows are named after. Raises InputError where two have one name."""
    models = [load_called(checkpoint, details=False, option="checkpoints", device=device) for checkpoint in checkpoints]
    names = [model.name for model in models]
    twice = next((name for i, name in enumerate(names) if name in names[:i]), None)
    if twice is not None:
        raise InputError(
            "--checkpoint", f"two are called {twice}", "rename one of the files: rows are named after them"
        )
    return models


@dataclass(frozen=True)
class SlamFigures:
    """What the simulated SLAM made of a scene."""

    keyframes: int
    """number of keyframes in its submaps"""
    submaps: int
    """number of its submaps"""
    submaps_aligned: int
    """number of submaps whose trajectory could be aligned to the true one"""
    rms_ate_mm: float | None
    """error of the aligned keyframes' centres; None where no submap could be aligned"""
    rms_rpe_mm: float | None
    """error of the steps from one aligned keyframe to the next; None where no submap could be aligned"""


@dataclass(frozen=True)
class KeyframeFigures:
    """Errors of the depth of aligned keyframes, in the scale of the map: of one keyframe, or their mean."""

    depth_abs_rel: float
    """mean of |p - q| / q, p predicted and q true depth"""
    depth_rmse_mm: float
    """root of the mean of (p - q)²"""
    scale_error: float
    """|median p / q - 1|"""

    @classmethod
    def mean(cls, found: Sequence[KeyframeFigures]) -> KeyframeFigures:
        return cls(*(float(np.mean([getattr(f, field.name) for f in found])) for field in fields(cls)))


@dataclass(frozen=True)
class Counts:
    """Keyframes of a dense map."""

    keyframes: int
    """number of keyframes"""
    keyframes_aligned: int
    """number of those whose alignment is trusted"""


@dataclass(frozen=True)
class RowFigures:
    """What one way to make a surface came to: figures, or why there are none. Flat in the file."""

    error: str = ""
    """why there are no figures; empty where there are"""
    surface: SurfaceFigures | None = None
    """errors of the surface's points"""
    submaps_judged: int = 0
    """number of submaps that have a surface to compare"""
    depth: KeyframeFigures | None = None
    """errors of the keyframes' depth, for dense maps"""
    counts: Counts | None = None
    """how many keyframes took part, for dense maps"""
    bands: Sequence[Band] = ()
    """the keyframes' depth by true depth, for dense maps"""
    front: Sequence[FrontPoint] = ()
    """error against coverage of the surface, where its vertices are told apart (recipe full)"""

    def record(self) -> dict[str, object]:
        """As bench.json has it."""
        parts = (self.depth, self.counts)
        flat = {key: value for part in parts if part is not None for key, value in asdict(part).items()}
        if self.surface is None:
            return {"error": self.error, **flat}
        flat |= {"bands": [asdict(band) for band in self.bands]} if self.bands else {}
        flat |= {"front": [asdict(point) for point in self.front]} if self.front else {}
        return {**asdict(self.surface), "submaps_judged": self.submaps_judged, **flat}


@dataclass(frozen=True)
class CellFigures:
    """One scene at one share of wrong points, or in one case of errors that come together."""

    scene: str
    """name of the scene"""
    seed: int
    """seed that its colon is made from"""
    wrong_share: float
    """share of the map's points that are wrong"""
    frames: int
    """number of frames of the scene"""
    trajectory: SlamFigures
    """what the SLAM made of it"""
    rows: Mapping[str, RowFigures]
    """the surfaces, by the name of the row"""
    case: str = ""
    """name of the case of errors that come together; empty where each point is wrong on its own"""

    def record(self) -> dict[str, object]:
        """As bench.json has it."""
        shared = {"scene": self.scene, "seed": self.seed, "wrong_share": self.wrong_share, "frames": self.frames}
        shared |= {"case": self.case} if self.case else {}
        rows = {name: row.record() for name, row in self.rows.items()}
        return {**shared, "trajectory": asdict(self.trajectory), "rows": rows}


def run_scene(scene: Predicted, config: BenchConfig, on_row: Callable[[], None] = lambda: None) -> list[CellFigures]:
    """The cells of a scene, one for each share of wrong points and each case. A row that cannot be judged says why."""
    return [make(scene) for make in cells_of(scene.rendered.scene, config, on_row).values()]


def cells_of(
    scene: Scene, config: BenchConfig, on_row: Callable[[], None] = lambda: None
) -> dict[str, Callable[[Predicted], CellFigures]]:
    """What makes the cells of a scene, by names that tell them apart."""
    shares = {f"wrong {s:g}": partial(_cell, share=s, config=config, on_row=on_row) for s in config.shares(scene)}
    cases = {str(case): partial(_case_cell, case=case, config=config, on_row=on_row) for case in config.cases_of(scene)}
    return {**shares, **cases}


def _case_cell(scene: Predicted, case: Case, config: BenchConfig, on_row: Callable[[], None]) -> CellFigures:
    scene = scene.moving.get(case, scene)
    rendered = scene.rendered
    sparse_map = rendered.tracked(WRONG_SHARE, CASES[case].errors)
    sparse = [_model(s, sparse=s.points) for s in sparse_map.submaps]
    model, known = list(scene.predictions.items())[-1]
    rows = {SPARSE: _judged(sparse, rendered, "sparse")}
    for way in WAYS:
        full = config.densify.under("full")
        chosen = full if way == "full" else full.rigid()
        made = [r.dense for r in densify(rendered.frames, sparse_map, partial(_known, known), chosen)]
        rows[f"{model}, {way}"] = _dense_row(made, rendered, known)
        on_row()
    seen, slam = rendered.scene, _trajectory(sparse, rendered)
    return CellFigures(seen.name, seen.seed, WRONG_SHARE, seen.frames, slam, rows, case)


def _cell(scene: Predicted, share: float, config: BenchConfig, on_row: Callable[[], None]) -> CellFigures:
    rendered = scene.rendered
    sparse_map = rendered.slam(share).map
    sparse = [_model(s, sparse=s.points) for s in sparse_map.submaps]
    rows: dict[str, RowFigures] = {}
    inliers: list[JudgedMap] = []
    for model, known in scene.predictions.items():
        for recipe in config.recipes:
            chosen = config.densify.under(recipe)
            made = [r.dense for r in densify(rendered.frames, sparse_map, partial(_known, known), chosen)]
            rows[f"{model}, {recipe}"] = _dense_row(made, rendered, known)
            inliers = [_model(m.submap, sparse_inliers=m.submap.points[m.judged_points()[1]]) for m in made]
            on_row()
    around = {SPARSE: _judged(sparse, rendered, "sparse"), INLIERS: _judged(inliers, rendered, "sparse_inliers")}
    seen, slam = rendered.scene, _trajectory(sparse, rendered)
    return CellFigures(seen.name, seen.seed, share, seen.frames, slam, {**around, **rows})


def _known(predictions: Mapping[str, DepthPrediction], frame: Frame) -> DepthPrediction:
    return predictions[frame.name]


def _model(submap: Submap, triangles: np.ndarray | None = None, **clouds: np.ndarray) -> JudgedMap:
    return JudgedMap(keyframe_trajectory(submap), clouds, triangles)


def _trajectory(models: Sequence[JudgedMap], rendered: Rendered) -> SlamFigures:
    aligned = []
    for model in models:
        with suppress(InputError):
            aligned.append(align_trajectory(model.trajectory, rendered.truth.poses))
    keyframes = {n for m in models for n in m.trajectory.numbers.tolist()}
    error = rms(np.concatenate([a.ate_sim3 for a in aligned])) if aligned else None
    of_steps = rms(np.concatenate([a.rpe for a in aligned])) if aligned else None
    return SlamFigures(len(keyframes), len(models), len(aligned), error, of_steps)


def _judged(models: Sequence[JudgedMap], rendered: Rendered, cloud: str) -> RowFigures:
    try:
        found = judge_maps(models, rendered.truth).judged
    except InputError as error:
        return RowFigures(str(error))
    if cloud not in found.pooled:
        return RowFigures("no map has a surface that can be compared")
    submaps = sum(m.clouds.get(cloud) is not None for m in found.maps)
    return RowFigures(surface=found.pooled[cloud], submaps_judged=submaps)


def _dense_row(made: Sequence[DenseMap], rendered: Rendered, known: Mapping[str, DepthPrediction]) -> RowFigures:
    """The surface's figures, the mean over the aligned keyframes of their depth's, in the scale of the map, and the
    curves of both."""
    placed = _placed(made, rendered)
    depths = [d for m, true_from_map in placed for d in _depths(m, true_from_map.scale, rendered, known)]
    found = _judged([_model(m.submap, m.triangles, dense=m.vertices) for m in made], rendered, "dense")
    counts = Counts(sum(len(m.alignments) for m in made), sum(len(m.aligned) for m in made))
    if found.error or not depths:
        reasons = [a.reason for m in made for a in m.alignments if not a.ok]
        why = f"no keyframe was aligned; the first: {reasons[0]}" if not counts.keyframes_aligned else found.error
        return RowFigures(why, counts=counts)
    assert rendered.truth.surface is not None
    ratio, truth = (np.concatenate(arrays) for arrays in zip(*((d.ratio, d.truth) for d in depths), strict=True))
    mean = KeyframeFigures.mean([d.figures for d in depths])
    curves = bands(ratio, truth), front(placed, rendered.truth.surface)
    return replace(found, depth=mean, counts=counts, bands=curves[0], front=curves[1])


def _placed(made: Sequence[DenseMap], rendered: Rendered) -> list[tuple[DenseMap, Similarity]]:
    """The dense maps that can be brought to mm, each by its own Sim(3)."""
    found = []
    for m in made:
        with suppress(InputError):
            aligned = align_trajectory(keyframe_trajectory(m.submap), rendered.truth.poses)
            found.append((m, aligned.true_from_map))
    return found


@dataclass(frozen=True, eq=False)
class _Depth:
    """A keyframe's depth p against truth q: figures, and of every fourth pixel p / q (n,) and q (n,) [mm]."""

    figures: KeyframeFigures
    ratio: np.ndarray
    truth: np.ndarray


def _depths(made: DenseMap, mm: float, rendered: Rendered, known: Mapping[str, DepthPrediction]) -> list[_Depth]:
    """Of each aligned keyframe of a submap, its depth brought to mm by the submap's Sim(3) alone: AbsRel, RMSE, and
    the error of its scale, |median p / q - 1|."""
    found = []
    for keyframe, alignment in zip(made.submap.keyframes, made.alignments, strict=True):
        frame = rendered.frames.by_number(keyframe.number)
        assert frame is not None
        if alignment.ok:
            depth = compare_depth(alignment.applied(known[frame.name]).scaled(mm), frame)
            errors = depth.errors(["none"])
            truth = depth.truth[depth.valid]
            ratio = depth.predicted[depth.valid] / truth
            scale = abs(float(np.median(ratio)) - 1)
            figures = KeyframeFigures(errors["abs_rel_none"], errors["rmse_mm_none"], scale)
            found.append(_Depth(figures, *(each[::4].astype(np.float32) for each in (ratio, truth))))
    return found
