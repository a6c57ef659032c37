"""`lightdepth adapt`: a checkpoint that knows another endoscope or organ, from unlabelled frames of it.

RUN/  config.yaml  log.txt  light.json (the light that was used)  report.html  model.safetensors  model.md  run.json

Start and adapted network are judged on the end of each sequence, which is never trained on, by the most trustworthy of
three: true distance; those of the map's points that no training sees; the loss, which needs neither. Where the adapted
network is the worse one, no model is written.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import torch

from lightdepth.calibration import write_camera, write_light
from lightdepth.checkpoint import DEFAULT_CHECKPOINT, load_model, save_model
from lightdepth.datasets import FrameSequence, SequenceSource
from lightdepth.datasets.pairing import check_shared_frames
from lightdepth.errors import InputError
from lightdepth.frame import Frame
from lightdepth.light.fit_on_map import LightView, fit_assumed_light, map_views, with_light, withheld_error
from lightdepth.maps import read_map
from lightdepth.models import DeclineModel, DepthModel, NetworkModel, working_size
from lightdepth.options import Group
from lightdepth.photometry import PhotometricCalibration
from lightdepth.prediction import DepthPrediction
from lightdepth.reporting.figures import colored_distance, png, side_by_side, thumbnail
from lightdepth.reporting.report import Report, number
from lightdepth.reporting.run import Run, plain, recorded, run_folder, versions
from lightdepth.sparse_map import SparseMap

from ..adapting.config import AdaptConfig
from ..adapting.map_teacher import MapTeacher
from ..adapting.module import Adaptation, merge, source_colons, target_loss
from ..callbacks import Diagnosis, DiagnosisConfig, Progress
from ..datamodule import FrameData, FrameDataModule, held_out_count
from ..running import card_text, quiet, report_every

_LEAST_VIEWS = 3  # held-out keyframes below which the map's other keyframes judge too
_SHOWN = 4
_NAMES = {
    "truth": "AbsRel of the held-out frames with truth",
    "map": "median error at the map's points",
    "label_free": "held-out self-supervised loss",
}
_KEYS = {"truth": "abs_rel_median", "label_free": "loss"}


@dataclass(frozen=True)
class Judgement:
    """How good a model is on held-out frames: `errors` as validation gives them, and at the points of a usable map."""

    errors: dict[str, float]
    at_points: float | None

    def by(self, criterion: str) -> float | None:
        """The criterion's value, or None where it cannot be had."""
        return self.at_points if criterion == "map" else self.errors.get(_KEYS[criterion])


@dataclass(frozen=True)
class Verdict:
    """Start and adapted network by the most trustworthy criterion there is."""

    criterion: str
    before: float
    after: float

    @property
    def better(self) -> bool:
        return self.after <= self.before  # false where it is not a number

    def __str__(self) -> str:
        word = "better or equal" if self.better else "worse"
        change = 100 * (self.after / self.before - 1) if self.before else math.nan
        return f"{_NAMES[self.criterion]} {number(self.before)} -> {number(self.after)} ({change:+.1f} %): {word}"


def verdict(before: Judgement, after: Judgement) -> Verdict:
    """By truth where there is any, else by the map's points, else by the loss."""
    for criterion in _NAMES:
        first, second = before.by(criterion), after.by(criterion)
        if first is not None:
            return Verdict(criterion, first, math.nan if second is None else second)
    raise AssertionError("the loss is always there")


def adapt(
    source: Group[SequenceSource],
    output: Path,
    checkpoint: str = DEFAULT_CHECKPOINT,
    more: tuple[Path, ...] = (),
    map: Path | None = None,
    fit_light: bool = True,
    config: Group[AdaptConfig] = AdaptConfig(),
    keep_worse: bool = False,
    overwrite: bool = False,
) -> None:
    """Adapt a checkpoint to another endoscope or organ, from frames without truth.

    Args:
        output: Run folder to make, with the adapted model and a report.
        checkpoint: Model to start from: a path, or the name of a bundled one.
        more: Other sequences of the same endoscope to learn from, such as '[A, B]'.
        map: Sparse map of the frames; its points find the light where nobody gave it, and judge the result.
        fit_light: Where nobody gave the light, fit it on the map and use it if withheld keyframes agree.
        keep_worse: Write the model even when it got worse.
        overwrite: Replace a run made before.
    """
    if map is None and config.taught:
        raise InputError(
            f"--points {config.points}, --overlap {config.overlap} without --map; expected a map that teaches where "
            "they are above 0"
        )
    arguments = recorded(
        source,
        config,
        output=output,
        checkpoint=checkpoint,
        more=more,
        map=map,
        fit_light=fit_light,
        keep_worse=keep_worse,
    )
    start = load_model(checkpoint, details=False)
    if not isinstance(start, NetworkModel):
        raise InputError(f"--checkpoint {checkpoint}: has no weights to adapt; expected a trained checkpoint")
    quiet()
    with run_folder(output, "adapt", arguments, overwrite) as run:
        sparse_map = read_map(map) if map is not None else None
        map_camera = sparse_map.submaps[0].keyframes[0].camera if sparse_map is not None else None
        frames = source.open(map_camera)
        run.hash_inputs(**source.files, map=map)
        training, held = _parted(frames, config.held_out)
        if sparse_map is not None:
            check_shared_frames(sparse_map, frames)
            write_camera(frames[0].camera, run.folder / "camera.json")
            # The map's camera, where the folder has none: for all sequences.
            source = replace(source, camera=run.folder / "camera.json")
            if source.light is None and fit_light:
                fitted = fit_assumed_light(run, training, sparse_map, start)
                if fitted is not None:
                    frames, training, held = (with_light(part, fitted) for part in (frames, training, held))
                    source = replace(source, light=str(run.folder / "light.json"))
        write_light(frames[0].light, run.folder / "light.json")
        run.log(f"light of {source.data}: {_said(frames[0].light)}")
        size = config.size or working_size(frames[0].camera, start.rows)
        sequences = [str(path) for path in (source.data, *more)]
        module_data = FrameDataModule(
            FrameData(
                sequences,
                format=source.format,
                camera=None if source.camera is None else str(source.camera),
                light=source.light,
                mask=None if source.mask is None else str(source.mask),
                held_out=config.held_out,
                tube=source_colons(start.card, config.replay),
                halves=config.replay > 0,
                size=size,
                batch_size=config.batch_size,
                seed=config.seed,
            )
        )
        module_data.setup()
        counts = module_data.counts
        replayed = config.replay * module_data.tube.frames
        run.log(
            f"{counts['train'] - replayed} frames to learn from, {counts['val']} held out, {size[0]}x{size[1]}"
            + (
                f"; {replayed} frames of {config.replay} synthetic colons in half of each batch"
                if config.replay
                else ""
            )
        )
        loss = target_loss(start.card, frames[0].light.reflectance > 0, config.replay > 0)
        views = [] if sparse_map is None else _views(run, frames, held, sparse_map)
        teacher = None
        if sparse_map is not None and config.taught:
            teacher = _teacher(run, training, held, sparse_map, views, size, config.seed)
        generator = torch.Generator().manual_seed(config.seed)
        weights = {"points": config.points, "overlap": config.overlap}
        module = Adaptation(
            start,
            loss,
            config.learning_rate,
            size[1],
            config.anchor,
            config.replay > 0,
            config.what,
            config.rank,
            generator,
            teacher,
            weights,
        )

        shown = [held[i] for i in sorted({round(k * (len(held) - 1) / (_SHOWN - 1)) for k in range(_SHOWN)})]
        pictures = [[DeclineModel(details=False)(frame), start(frame)] for frame in shown]
        before = _judged(module, module_data, start, views)
        closed = _map_error(views, DeclineModel(details=False))
        _fit(module, module_data, config.steps, run)
        merge(module.network)
        adapted = NetworkModel(module.network, size[1], output.name, details=False)
        after = _judged(module, module_data, adapted, views)
        found = verdict(before, after)
        for frame, row in zip(shown, pictures, strict=True):
            row.append(adapted(frame))

        written = found.better or keep_worse
        if written:
            card = _card(
                start, module, counts, config.steps, config.seed, asdict(module_data.tube), after.errors, found
            )
            card["trained_on"] += (
                f" {len(sequences)} sequence(s), {counts['train'] - replayed} frames, {size[0]}x{size[1]}"
            )
            save_model(module.network, run.folder / "model.safetensors", card)
            (run.folder / "model.md").write_text(card_text(card, output.name))
        page = _page(
            source.data, start, module, run, frames[0].light, (before, after), closed, found, written, counts["val"]
        )
        page.wide_figures([_picture(frame, row) for frame, row in zip(shown, pictures, strict=True)])
        page.write(run.folder / "report.html")
        run.record.update(
            {
                "seed": config.seed,
                "frames": counts,
                "light": plain(frames[0].light),
                "loss": asdict(loss),
                "learning_weights": module.learning,
                "criterion": found.criterion,
                "before": {"map": before.at_points, **before.errors},
                "after": {"map": after.at_points, **after.errors},
                "closed_form_map": closed,
                "better": found.better,
                "written": written,
                "units": {"rmse_mm": "mm", "medae_mm": "mm", "map": "share of the distance"},
            }
        )
        run.log(str(found))
        if not written:
            run.fail("model.safetensors", f"not written, the adapted network got worse: {found}")
        elif not found.better:
            run.log("written all the same, as --keep-worse asks")


def _parted(frames: FrameSequence, share: float) -> tuple[FrameSequence, FrameSequence]:
    """The frames to learn from, and those at the end that judge, as FrameDataModule parts them."""
    first = len(frames) - held_out_count(len(frames), share)
    if first < 1:
        raise InputError(f"{frames.source}: {len(frames)} frame; expected at least two, one of them to judge by")
    return frames[:first], frames[first:]


def _views(run: Run, frames: FrameSequence, held: FrameSequence, sparse_map: SparseMap) -> list[LightView]:
    """Keyframes whose points judge: held-out ones, or of the whole sequence where these are few."""
    views = map_views(held, sparse_map, frames[0].camera)
    if len(views) >= _LEAST_VIEWS:
        return views
    run.log(f"{len(views)} keyframes of the map are held-out frames: all of its keyframes judge")
    return map_views(frames, sparse_map, frames[0].camera)


def _teacher(
    run: Run,
    training: FrameSequence,
    held: FrameSequence,
    sparse_map: SparseMap,
    views: Sequence[LightView],
    size: tuple[int, int],
    seed: int,
) -> MapTeacher:
    """The map as a teacher that keeps quiet about what judges."""
    judges = {view.keyframe.number for view in views}
    if not judges <= set(held.numbers):
        raise InputError(
            f"{sparse_map.source}: too few of its keyframes are held-out frames to judge what the others teach; "
            f"{_LEAST_VIEWS} are needed: raise --held-out, or leave --points and --overlap at 0"
        )
    teacher = MapTeacher(training, sparse_map, size, held.numbers, seed)
    known = sum(len(k.distances) for k in teacher.keyframes)
    paired = sum(bool(k.partners) for k in teacher.keyframes)
    run.log(f"the map teaches: {len(teacher.keyframes)} keyframes, {known} observed points, {paired} with partners")
    return teacher


def _map_error(views: Sequence[LightView], model: DepthModel) -> float | None:
    if not views:
        return None
    error = withheld_error(views, model, views[0].frame.light)
    return error if math.isfinite(error) else None


def _judged(module: Adaptation, data: FrameDataModule, model: NetworkModel, views: Sequence[LightView]) -> Judgement:
    trainer = pl.Trainer(**_TRAINER)
    found = trainer.validate(module, datamodule=data, verbose=False)[0]
    errors = {name.removeprefix("val/"): float(value) for name, value in found.items()}
    model.network.eval()
    return Judgement(errors, _map_error(views, model))


_TRAINER: dict[str, Any] = {
    "devices": 1,
    "logger": False,
    "enable_checkpointing": False,
    "enable_progress_bar": False,
    "enable_model_summary": False,
}


def _fit(module: Adaptation, data: FrameDataModule, steps: int, run: Run) -> None:
    callbacks = [Diagnosis(DiagnosisConfig(), data.names), Progress(run.log, report_every(steps))]
    options: dict[str, Any] = {
        "max_steps": steps,
        "gradient_clip_val": 1.0,
        "limit_val_batches": 0,
        "log_every_n_steps": 1,
    }
    pl.Trainer(**_TRAINER, **options, callbacks=callbacks).fit(module, datamodule=data)


def _card(
    start: NetworkModel,
    module: Adaptation,
    counts: dict[str, int],
    steps: int,
    seed: int,
    tube: dict[str, Any],
    errors: dict[str, float],
    found: Verdict,
) -> dict[str, Any]:
    return {
        "trained_on": f"{start.card.get('trained_on', start.name)} Adapted without truth to",
        "adapted_from": start.name,
        "rows": module.rows,
        "steps": steps,
        "seed": seed,
        "checkpoint": "last",
        "network": module.network.config.to_dict(),
        "loss": asdict(module.loss_config),
        "tube": start.card.get("tube"),
        "replayed": tube if module.replay else None,
        "frames": counts,
        "errors": errors,
        "verdict": str(found),
        "version": versions().get("lightdepth", "not installed"),
    }


def _page(
    data: Path,
    start: NetworkModel,
    module: Adaptation,
    run: Run,
    seen: PhotometricCalibration,
    judged: tuple[Judgement, Judgement],
    closed_map: float | None,
    found: Verdict,
    written: bool,
    held: int,
) -> Report:
    page = Report(f"{start.name} adapted to {data}")
    kept = "The model was written." if written else "The model got worse, so none was written; --keep-worse writes it."
    page.text(f"{found}. {kept}")
    if found.criterion == "label_free":
        page.text(
            "Neither truth nor a map was there to judge by: the loss says how well the light explains the images, not "
            "how right the distance is. It can fall while distance gets worse; a sparse map (--map) tells."
        )
    light = run.record.get("light_fit")
    page.text(f"Light of the frames: {_said(seen)}." + (f" Light {light['summary']}." if light else ""))
    page.heading(f"Before and after, on {held} frames that were held out")
    headers = ["model"]
    columns: list[list[float | None]] = []
    before, after = judged
    if "abs_rel_median" in before.errors:
        titles = {"abs_rel": "AbsRel", "rmse_mm": "RMSE mm", "medae_mm": "MedAE mm", "delta1": "share within 1.25"}
        for name, title in titles.items():
            headers.append(f"{title} (median-aligned)")
            keys = (f"closed_form/{name}_median", f"{name}_median", f"{name}_median")
            columns.append([e.errors[key] for e, key in zip((before, before, after), keys, strict=True)])
    if before.at_points is not None:
        headers.append("median error at the map's points")
        columns.append([closed_map, before.at_points, after.at_points])
    for name, title in (("loss", "self-supervised loss"), ("inconsistency", "inconsistency")):
        headers.append(title)
        columns.append([None, before.errors[name], after.errors[name]])
    names = ("closed form", f"start: {start.name}", "adapted")
    page.table(headers, [[name, *row] for name, row in zip(names, zip(*columns, strict=True), strict=True)])
    page.text(
        f"{module.learning} weights learned; anchor {module.anchor:g}, "
        f"{'half of each batch replayed' if module.replay else 'no replay'}; the map "
        f"{_taught_said(module)}. Inconsistency: how much distance changes "
        "in a mirror and in less light. Pictures: the image, and distance by closed form, start and adapted network, "
        "then truth where there is any, each with its own range of colours, near in yellow."
    )
    return page


def _taught_said(module: Adaptation) -> str:
    if module.teacher is None:
        return "taught nothing"
    return "taught with weights " + ", ".join(f"{value:g} ({name})" for name, value in module.map_weights.items())


def _picture(frame: Frame, predictions: Sequence[DepthPrediction]) -> tuple[bytes, str]:
    maps = [(p.distance, p.valid) for p in predictions]
    names = "image, closed form, start, adapted"
    if frame.true_distance is not None:
        maps.append((frame.true_distance, frame.valid & (frame.true_distance > 0)))
        names += ", truth"
    pictures = [thumbnail(picture, 240) for picture in (frame.image, *(colored_distance(*m) for m in maps))]
    return png(side_by_side(pictures)), f"{frame.name}: {names}"


def _said(light: PhotometricCalibration) -> str:
    return f"gamma {light.gamma:.3g}, mu {light.mu:.3g}, reflectance {light.reflectance:.3g} ({light.source})"
