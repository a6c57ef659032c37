"""`lightdepth adapt`: a checkpoint that knows another endoscope or organ, from unlabelled frames of it.

RUN/  config.yaml  log.txt  light.json (the light that was used)  sparse/ (a map made to judge by)  report.html
      model.safetensors  model.md  run.json

Start and adapted network are judged on the end of each sequence, which is never trained on: by true distance or,
without that, at blocks of wall of a map, given or made, that no lesson showed. Where these do not call the adapted
network better, no model is written. Where nothing judges, the network is held near its start, and the verdict says so.
"""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

from safetensors.torch import load_file, save_file

from lightdepth.checkpoint import DEFAULT_CHECKPOINT, load_called, save_model
from lightdepth.command_line.following import Input, Value, command, given
from lightdepth.command_line.options import Group
from lightdepth.command_line.outcome import end
from lightdepth.counting import counted
from lightdepth.datasets import SequenceSource
from lightdepth.detective import PairingConfig
from lightdepth.errors import InputError
from lightdepth.models import DeclineModel, NetworkModel, working_size
from lightdepth.reporting.kept import kept
from lightdepth.reporting.record import versions
from lightdepth.reporting.run import Run, plain, recorded, run_folder
from lightdepth.sfm.config import SfmConfig

from ..adapting.card import AdaptedCard, target_loss
from ..adapting.config import AdaptConfig
from ..adapting.judging import Judgement, Outcome, judged, looked_at, verdict
from ..adapting.module import Adaptation, merge_low_rank
from ..adapting.report import FILES, Pictures, page
from ..adapting.target import Target, adaptation, frame_data, read_target, replayed_frames
from ..adapting.wall_judge import compared, wall_judge
from ..callbacks import Diagnosis, DiagnosisConfig, TrainingProgress
from ..datamodule import FrameDataModule
from ..running import report_every, trainer_of_one, while_training


def adapt(
    source: Group[SequenceSource],
    output: Path,
    checkpoint: str = DEFAULT_CHECKPOINT,
    more: tuple[Path, ...] = (),
    map: Path | None = None,
    fit_light: bool = True,
    sfm: SfmConfig = SfmConfig(),
    config: Group[AdaptConfig] = AdaptConfig(),
    pairing: Group[PairingConfig] = PairingConfig(),
    keep_worse: bool = False,
    overwrite: bool = False,
    resume: bool = False,
) -> None:
    """Adapt a checkpoint to another endoscope or organ, from frames without truth.

    Args:
        output: Run folder to make, with the adapted model, if it was found better, and a report (report.html).
        checkpoint: Trained model to start from: a path (.safetensors or .ckpt), or the name of a bundled one
            (lightdepth-both, lightdepth-large, lightdepth-self or lightdepth-synthetic).
        more: Folders of other sequences of the same endoscope to learn from as well, such as '[A, B]'; they are read
            with the camera, light and mask of DATA. They do not judge.
        map: Sparse map of the frames (a SLAM export or a COLMAP model); its points tell the light where none was given,
            teach the network, and judge the result. Left out, pycolmap makes one where there is no true distance, or
            where --points or --overlap is given; with --judge none it makes no map.
        fit_light: true: where no light was given, it is fitted on the map, and used if hidden blocks of wall agree with
            it. false: the light of the frames, or an assumed one, is taken as it is.
        sfm: how frames are mapped when there is neither truth nor map
        keep_worse: true: the model is written even where its judge does not find it better. false: then no model is
            written. Where nothing judges, it is written in either case, but with false only if its predictions stayed
            as steady as before (in mirrored, darker images).
        overwrite: Replace a run made before. Without it, a folder that is already there is refused.
        resume: Go on with the run that was stopped there, as it was begun; a map, a light, the judgement of the start
            and a training that is done are not made again.
    """
    if map is None and config.taught and config.judge == "none":
        raise InputError(
            "--points, --overlap",
            f"{config.points}, {config.overlap} without --map and with --judge none",
            "give --map FILE to learn from, or 0 for both",
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
        sfm=sfm,
        keep_worse=keep_worse,
    )
    start = load_called(checkpoint, details=False)
    if not isinstance(start, NetworkModel):
        raise InputError("--checkpoint", f"{checkpoint} has no weights to adapt", "expected a trained checkpoint")
    with while_training(), run_folder(output, "adapt", arguments, overwrite, resume) as run:
        run.hash_inputs(**source.files, map=map, checkpoint=Path(checkpoint))
        target = read_target(run, source, map, fit_light, config, start, sfm, pairing, more)
        size = config.size or working_size(target.frames.first().camera, start.rows)
        data = frame_data(run, target, more, config, size, start)
        for doubt in data.doubts:
            run.warn(doubt)
        run.record["colour"] = {path: colours.record() for path, colours in data.colours.items()}
        loss = target_loss(start.card, target.light.reflectance > 0, config.replay > 0)
        wall = None
        if target.sparse_map is not None:
            taught = config.taught_by(True) + config.overlap > 0
            wall = wall_judge(target.frames, target.held, target.sparse_map, taught, config.seed)
        closed = looked_at(DeclineModel(details=False), target.held, wall)
        if closed.truth is None and closed.wall is not None and compared(closed.wall, closed.wall) is None:
            target = replace(target, unjudged="the map has too few points to judge")
        module = adaptation(run, target, start, loss, wall, closed.truth is not None, config, size)

        pictures = Pictures(target)
        pictures.add(start)
        before = kept(run, "start", Judgement, lambda: judged(module, data, start, target.held, wall))
        _fit(module, data, config.steps, run)
        merge_low_rank(module.network)
        adapted = NetworkModel(module.network, size[1], output.name, details=False)
        after = judged(module, data, adapted, target.held, wall)
        outcome = Outcome(before, after, closed, verdict(before, after, target.unjudged), keep_worse)
        pictures.add(adapted)

        if outcome.written:
            card = _card(start, module, data, config, outcome)
            save_model(module.network, run.folder / "model.safetensors", card.record())
            (run.folder / "model.md").write_text(card.text(output.name), encoding="utf-8", errors="backslashreplace")
        light = run.record.get("light_fit")
        made = page(target, start, module, outcome, data.counts["val"], light["summary"] if light else None)
        for tiles, caption in pictures.rows():
            made.tiles(tiles, caption, 180)
        made.files(run.folder, FILES)
        made.write(run.folder / "report.html")
        _record(run, start, target, module, data, config, outcome)
    own: dict[str, Value] = {"--checkpoint": output / "model.safetensors", "-o": "runs/own"}
    read_as = {"--map": Input("MAP", map), **given(pairing), **source.typed()}
    then = command("densify", Input("DATA", source.data), options={**read_as, **own})
    end(output, then=then, page=output / "report.html")


def _fit(module: Adaptation, data: FrameDataModule, steps: int, run: Run) -> None:
    """Trains the network; where that was done before the run was stopped, it gets the weights that it had then."""
    if run.done("training"):
        module.network.load_state_dict(load_file(run.state / "trained.safetensors"))
        return
    told = [
        Diagnosis(DiagnosisConfig(), data.names),
        TrainingProgress(run.log, report_every(steps), data.seconds_waited),
    ]
    trainer = trainer_of_one(steps, told)
    trainer.fit(module, datamodule=data)
    if run.resumable:
        run.state.mkdir(exist_ok=True)
        save_file(module.network.state_dict(), run.state / "trained.safetensors")
        run.finish_part("training", [run.state / "trained.safetensors"])


def _card(
    start: NetworkModel, module: Adaptation, data: FrameDataModule, config: AdaptConfig, outcome: Outcome
) -> AdaptedCard:
    learned = data.counts["train"] - replayed_frames(data)
    said = f"{counted(len(data.sequences), 'sequence')}, {counted(learned, 'frame')}, {data.size[0]}x{data.size[1]}"
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
    start: NetworkModel,
    target: Target,
    module: Adaptation,
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
            "loss": asdict(module.loss_config),
            "anchor": module.anchor,
            "learning_weights": module.learning,
            "criterion": found.criterion,
            "verdict": str(found),
            "word": found.word,
            "before": outcome.before.record(),
            "after": outcome.after.record(),
            "closed_form": outcome.closed_form.record(),
            "better": found.better,
            "written": outcome.written,
            "units": {"rmse_mm": "mm", "medae_mm": "mm", "map": "of log distance"},
        }
    )
    run.log(f"{found}. {outcome.kept(start.name)}.")
    if not outcome.written:
        reason = f"not written, nothing better than {start.name} was found"
        run.fail("model.safetensors", reason, now=False)  # the verdict was told
