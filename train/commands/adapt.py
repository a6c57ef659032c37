"""`lightdepth adapt`: a checkpoint that knows another endoscope or organ, from unlabelled frames of it.

RUN/  config.yaml  log.txt  light.json (the light that was used)  report.html  model.safetensors  model.md  run.json

Start and adapted network are judged on the end of each sequence, which is never trained on, by the most trustworthy of
three: true distance; those of the map's points that no training sees; the loss, which needs neither. Where the adapted
network is the worse one, no model is written.
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import lightning.pytorch as pl

from lightdepth.checkpoint import DEFAULT_CHECKPOINT, load_model, save_model
from lightdepth.command_line.options import Group
from lightdepth.datasets import SequenceSource
from lightdepth.detective import PairingConfig
from lightdepth.errors import InputError
from lightdepth.losses import LossConfig
from lightdepth.models import DeclineModel, NetworkModel, working_size
from lightdepth.reporting.run import Run, plain, recorded, run_folder, versions

from ..adapting.card import AdaptedCard, target_loss
from ..adapting.config import AdaptConfig
from ..adapting.judging import Outcome, judged, judging_views, map_error
from ..adapting.module import Adaptation, merge_low_rank
from ..adapting.report import Pictures, page
from ..adapting.target import Target, adaptation, frame_data, read_target, replayed_frames
from ..callbacks import Diagnosis, DiagnosisConfig, TrainingProgress
from ..datamodule import FrameDataModule
from ..running import quiet, report_every


def adapt(
    source: Group[SequenceSource],
    output: Path,
    checkpoint: str = DEFAULT_CHECKPOINT,
    more: tuple[Path, ...] = (),
    map: Path | None = None,
    fit_light: bool = True,
    config: Group[AdaptConfig] = AdaptConfig(),
    pairing: Group[PairingConfig] = PairingConfig(),
    keep_worse: bool = False,
    overwrite: bool = False,
) -> None:
    """Adapt a checkpoint to another endoscope or organ, from frames without truth.

    Args:
        output: Run folder to make, with the adapted model and a report.
        checkpoint: Model to start from: a path, or the name of a bundled one.
        more: Other sequences of the same endoscope to learn from, such as '[A, B]'.
        map: Sparse map of the frames; its points find the light where nobody gave it, and judge the result.
        fit_light: Where nobody gave the light, fit it on the map and use it if hidden blocks of wall agree.
        keep_worse: Write the model even when it got worse.
        overwrite: Replace a run made before.
    """
    if map is None and config.taught:
        raise InputError(
            "--points, --overlap",
            f"{config.points}, {config.overlap} without --map",
            "expected a map that teaches where they are above 0",
        )
    arguments = recorded(
        source,
        config,
        pairing,
        output=output,
        checkpoint=checkpoint,
        more=more,
        map=map,
        fit_light=fit_light,
        keep_worse=keep_worse,
    )
    start = load_model(checkpoint, details=False)
    if not isinstance(start, NetworkModel):
        raise InputError("--checkpoint", f"{checkpoint} has no weights to adapt", "expected a trained checkpoint")
    quiet()
    with run_folder(output, "adapt", arguments, overwrite) as run:
        target = read_target(run, source, map, fit_light, config.held_out, start, pairing)
        size = config.size or working_size(target.frames[0].camera, start.rows)
        data = frame_data(run, target, more, config, size, start)
        loss = target_loss(start.card, target.light.reflectance > 0, config.replay > 0)
        views = [] if target.sparse_map is None else judging_views(run, target.frames, target.held, target.sparse_map)
        module = adaptation(run, target, start, loss, views, config, size)

        pictures = Pictures(target)
        pictures.add(start)
        before = judged(module, data, start, views)
        closed = map_error(views, DeclineModel(details=False))
        _fit(module, data, config.steps, run)
        merge_low_rank(module.network)
        adapted = NetworkModel(module.network, size[1], output.name, details=False)
        outcome = Outcome(before, judged(module, data, adapted, views), closed, keep_worse)
        pictures.add(adapted)

        if outcome.written:
            card = _card(start, module, data, config, outcome)
            save_model(module.network, run.folder / "model.safetensors", card.record())
            (run.folder / "model.md").write_text(card.text(output.name))
        light = run.record.get("light_fit")
        made = page(target, start, module, outcome, data.counts["val"], light["summary"] if light else None)
        made.wide_figures(pictures.rows())
        made.write(run.folder / "report.html")
        _record(run, target, module, loss, data, config, outcome)


def _fit(module: Adaptation, data: FrameDataModule, steps: int, run: Run) -> None:
    trainer = pl.Trainer(
        devices=1,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        max_steps=steps,
        gradient_clip_val=1.0,
        limit_val_batches=0,
        log_every_n_steps=1,
        callbacks=[Diagnosis(DiagnosisConfig(), data.names), TrainingProgress(run.log, report_every(steps))],
    )
    trainer.fit(module, datamodule=data)


def _card(
    start: NetworkModel, module: Adaptation, data: FrameDataModule, config: AdaptConfig, outcome: Outcome
) -> AdaptedCard:
    learned = data.counts["train"] - replayed_frames(data)
    said = f"{len(data.sequences)} sequence(s), {learned} frames, {data.size[0]}x{data.size[1]}"
    return AdaptedCard(
        trained_on=f"{start.card.get('trained_on', start.name)} Adapted without truth to {said}",
        adapted_from=start.name,
        rows=module.rows,
        steps=config.steps,
        seed=config.seed,
        checkpoint="last",
        network=module.network.config,
        loss=module.loss_config,
        tube=start.card.get("tube"),
        replayed=data.tube if module.replay else None,
        frames=data.counts,
        errors=outcome.after.errors,
        verdict=outcome.verdict,
        version=versions().get("lightdepth", "not installed"),
    )


def _record(
    run: Run,
    target: Target,
    module: Adaptation,
    loss: LossConfig,
    data: FrameDataModule,
    config: AdaptConfig,
    outcome: Outcome,
) -> None:
    """Says in run.json and in the log what came of it."""
    found = outcome.verdict
    run.record.update(
        {
            "seed": config.seed,
            "frames": data.counts,
            "light": plain(target.light),
            "loss": asdict(loss),
            "learning_weights": module.learning,
            "criterion": found.criterion,
            "before": outcome.before.record(),
            "after": outcome.after.record(),
            "closed_form_map": outcome.closed_form_at_points,
            "better": found.better,
            "written": outcome.written,
            "units": {"rmse_mm": "mm", "medae_mm": "mm", "map": "share of the distance"},
        }
    )
    run.log(str(found))
    if not outcome.written:
        run.fail("model.safetensors", f"not written, the adapted network got worse: {found}")
    elif not found.better:
        run.log("written all the same, as --keep-worse asks")
