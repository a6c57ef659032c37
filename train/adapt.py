"""`lightdepth adapt`: a checkpoint that knows another endoscope or organ, from unlabelled frames of it.

RUN/  config.yaml  log.txt  light.json (the light that was used)  report.html  model.safetensors  model.md  run.json

Start and adapted network are judged on the end of each sequence, which is never trained on, by the most trustworthy of
three: true distance; those of the map's points that no training sees; the loss, which needs neither. Where the adapted
network is the worse one, no model is written.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import torch

from lightdepth.calibration import write_camera, write_light
from lightdepth.checkpoint import DEFAULT_CHECKPOINT, load_model, save_model
from lightdepth.datasets import FrameSequence, open_sequence
from lightdepth.errors import InputError
from lightdepth.figures import colored_distance, png, side_by_side, thumbnail
from lightdepth.frame import Frame
from lightdepth.light_fit import LightView, fit_assumed_light, map_views, with_light, withheld_error
from lightdepth.maps import read_map
from lightdepth.maps.checks import check_shared_frames
from lightdepth.photometry import PhotometricCalibration
from lightdepth.predict import DeclineModel, DepthModel, NetworkModel, working_size
from lightdepth.prediction import DepthPrediction
from lightdepth.report import Report, number
from lightdepth.run import Run, plain, run_folder, versions
from lightdepth.sparse_map import SparseMap

from .adaptation import Adaptation, What, merge, source_colons, target_loss
from .callbacks import Diagnosis, DiagnosisConfig, Progress
from .datamodule import FrameDataModule, held_out_count
from .map_teacher import MapTeacher
from .running import card_text, quiet, report_every

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
    data: Path,
    output: Path,
    checkpoint: str = DEFAULT_CHECKPOINT,
    more: tuple[Path, ...] = (),
    map: Path | None = None,
    format: str | None = None,
    camera: Path | None = None,
    light: str | None = None,
    mask: Path | None = None,
    fit_light: bool = True,
    steps: int = 300,
    learning_rate: float = 5e-4,
    batch_size: int = 4,
    size: tuple[int, int] | None = None,
    what: What = "all",
    rank: int = 4,
    anchor: float = 0.0,
    replay: int = 0,
    points: float = 0.0,
    overlap: float = 0.0,
    held_out: float = 0.2,
    keep_worse: bool = False,
    seed: int = 0,
    overwrite: bool = False,
) -> None:
    """Adapt a checkpoint to another endoscope or organ, from frames without truth.

    Args:
        data: folder of frames, or a video
        output: run folder to make
        checkpoint: a path or the name of a bundled one, to start from
        more: other sequences of the same endoscope to learn from, such as '[A, B]'
        map: sparse map of data; its points find the light where nobody gave it, and judge the result
        format: folder, video, c3vd, simcol, hamlyn, scared, endoslam, endomapper; found by looking if left out
        camera: calibration file; left out, the folder's, else the map's
        light: light.json, photometric XML, or gamma=2.2,mu=0
        mask: image, white where tissue shows
        fit_light: where nobody gave the light, fit it on the map and use it if withheld keyframes agree
        steps: of training
        learning_rate: the highest of its one cycle
        batch_size: frames in a step
        size: width and height that it learns at, pixels; left out, the rows of the checkpoint
        what: of the network learns: all, decoder, norms (scale and shift of the normalisations) or low_rank
        rank: of what low_rank adds to every convolution
        anchor: weight that holds the shape of each distance map to what the checkpoint said before
        replay: synthetic colons of the kind that the checkpoint learned from, which fill half of each batch
        points: weight of the map's points as teachers; those that a held-out frame saw only judge
        overlap: weight of where two keyframes of the map see the same tissue
        held_out: share of each sequence, at its end, that judges and is never trained on
        keep_worse: write the model even when it got worse
        seed: of order, augmentation, replayed colons and low-rank additions
        overwrite: replace a run made before
    """
    arguments = {k: v for k, v in locals().items() if k != "overwrite"}
    if min(steps, batch_size) < 1 or not learning_rate > 0 or replay < 0:
        raise InputError(
            f"--steps {steps}, --batch-size {batch_size}, --learning-rate {learning_rate}, --replay {replay}; "
            "expected positive numbers, and 0 or more colons"
        )
    if not (points >= 0 and overlap >= 0) or (map is None and points + overlap > 0):
        raise InputError(
            f"--points {points}, --overlap {overlap}{'' if map else ' without --map'}; expected weights of 0 or more, "
            "and a map that teaches where they are above 0"
        )
    start = load_model(checkpoint, details=False)
    if not isinstance(start, NetworkModel):
        raise InputError(f"--checkpoint {checkpoint}: has no weights to adapt; expected a trained checkpoint")
    quiet()
    with run_folder(output, "adapt", arguments, overwrite) as run:
        sparse_map = read_map(map) if map is not None else None
        map_camera = sparse_map.submaps[0].keyframes[0].camera if sparse_map is not None else None
        frames = open_sequence(data, format, camera, light, mask, map_camera)
        for name, path in (("data", data), ("map", map), ("camera", camera), ("mask", mask)):
            run.hash_input(name, path)
        used_light: str | None = light
        training, held = _parted(frames, held_out)
        if sparse_map is not None:
            check_shared_frames(sparse_map, frames)
            write_camera(frames[0].camera, run.folder / "camera.json")
            camera = run.folder / "camera.json"  # the map's, where the folder has none: for all sequences
            if light is None and fit_light:
                fitted = fit_assumed_light(run, training, sparse_map, start)
                if fitted is not None:
                    frames, training, held = (with_light(part, fitted) for part in (frames, training, held))
                    used_light = str(run.folder / "light.json")
        write_light(frames[0].light, run.folder / "light.json")
        run.log(f"light of {data}: {_said(frames[0].light)}")
        size = size or working_size(frames[0].camera, start.rows)
        sequences = [str(path) for path in (data, *more)]
        module_data = FrameDataModule(
            sequences,
            format=format,
            camera=None if camera is None else str(camera),
            light=used_light,
            mask=None if mask is None else str(mask),
            held_out=held_out,
            tube=source_colons(start.card, replay),
            halves=replay > 0,
            size=size,
            batch_size=batch_size,
            seed=seed,
        )
        module_data.setup()
        counts = module_data.counts
        replayed = replay * module_data.tube.frames
        run.log(
            f"{counts['train'] - replayed} frames to learn from, {counts['val']} held out, {size[0]}x{size[1]}"
            + (f"; {replayed} frames of {replay} synthetic colons in half of each batch" if replay else "")
        )
        loss = target_loss(start.card, frames[0].light.reflectance > 0, replay > 0)
        views = [] if sparse_map is None else _views(run, frames, held, sparse_map)
        teacher = None
        if sparse_map is not None and points + overlap > 0:
            teacher = _teacher(run, training, held, sparse_map, views, size, seed)
        generator = torch.Generator().manual_seed(seed)
        weights = {"points": points, "overlap": overlap}
        module = Adaptation(
            start, loss, learning_rate, size[1], anchor, replay > 0, what, rank, generator, teacher, weights
        )

        shown = [held[i] for i in sorted({round(k * (len(held) - 1) / (_SHOWN - 1)) for k in range(_SHOWN)})]
        pictures = [[DeclineModel(details=False)(frame), start(frame)] for frame in shown]
        before = _judged(module, module_data, start, views)
        closed = _map_error(views, DeclineModel(details=False))
        _fit(module, module_data, steps, run)
        merge(module.network)
        adapted = NetworkModel(module.network, size[1], output.name, details=False)
        after = _judged(module, module_data, adapted, views)
        found = verdict(before, after)
        for frame, row in zip(shown, pictures, strict=True):
            row.append(adapted(frame))

        written = found.better or keep_worse
        if written:
            card = _card(start, module, counts, steps, seed, asdict(module_data.tube), after.errors, found)
            card["trained_on"] += (
                f" {len(sequences)} sequence(s), {counts['train'] - replayed} frames, {size[0]}x{size[1]}"
            )
            save_model(module.network, run.folder / "model.safetensors", card)
            (run.folder / "model.md").write_text(card_text(card, output.name))
        page = _page(data, start, module, run, frames[0].light, (before, after), closed, found, written, counts["val"])
        page.wide_figures([_picture(frame, row) for frame, row in zip(shown, pictures, strict=True)])
        page.write(run.folder / "report.html")
        run.record.update(
            {
                "seed": seed,
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
    if not 0 < share < 1:
        raise InputError(f"--held-out {share}; expected a share above 0 and below 1")
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
