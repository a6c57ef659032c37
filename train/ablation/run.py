"""`lightdepth ablate`: what each ingredient of a training recipe is worth, by leaving it out.

OUT/  seed_<K>/<ROW>.json (one training and its errors, written whole)  seed_<K>/<ROW>/ (its model, log and settings)
      ablation.md  ablation.csv  ablation.json  run.json (written last)

Every row is a base preset with some settings changed, trained as `train` does it. The rows of a seed share its colons,
weights' seed and order of frames, so that they differ in what was changed and in nothing else. All are judged on the
same frames of colons that none of them saw. Rows that are already there are kept, so that a run can be continued.
"""

from __future__ import annotations

import contextlib
import copy
import io
import json
import math
import re
import shutil
import sys
import time
from argparse import ArgumentError
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import lightning.pytorch as pl
import torch
import yaml
from jsonargparse import ArgumentParser, Namespace

from lightdepth.checkpoint import load_model
from lightdepth.decline import log_closed_form
from lightdepth.errors import InputError, PartialFailure
from lightdepth.files.writing import write_whole
from lightdepth.frame import FrameBatch, to_batch
from lightdepth.geometry import depth_from_distance
from lightdepth.losses import LossConfig, self_supervised_loss
from lightdepth.metrics import DepthErrors
from lightdepth.models import NetworkModel
from lightdepth.module import MIN_RAY_Z
from lightdepth.network import DepthNetwork
from lightdepth.presets import shipped
from lightdepth.reporting.progress import Progress
from lightdepth.reporting.run import plain, recorded, write_run_json
from lightdepth.tube.variant import REFLECTANCE, variant_frames

from ..cli import as_yaml, training_parser
from ..colons import TubeData, colon_seeds, tube_scene, with_reflectance
from ..datamodule import FrameDataModule, collate
from ..fit import fit
from ..running import quiet
from .table import Result, Table, write_table

FARTHEST_MM = 100.0
WRONG_BY = 0.3
_CANDIDATES = tuple(k / 10 for k in range(8))
_OURS = ("ablation.md", "ablation.csv", "ablation.json", "run.json")


@dataclass(frozen=True)
class Row:
    """One training."""

    name: str
    """Name of the row in the table."""
    change: str = ""
    """What the row does differently, in a few words."""
    part: Literal["dropped", "instead", "reference"] = "dropped"
    """What the row does with its ingredient: it is "dropped", something else is "instead" of it, or the row is a
    "reference"."""
    settings: dict[str, Any] | None = None
    """Dotted options of `train` and their values, such as model.loss.smoothness."""
    preset: Path | None = None
    """Training preset whose model takes the place of the base's, before the settings."""
    told: tuple[Literal["true", "wrong", "estimated"], ...] = ("true",)
    """What a network that has the wall's reflectance as an input is told of it when it is judged: the "true" value, a
    "wrong" one (0.3 more), or one "estimated" per colon without truth (least loss). Each makes one line of the
    table."""
    seeds: tuple[int, ...] | None = None
    """Seeds of the row's own trainings, numbers; left out, those of the ablation. More make the row more certain and
    take longer."""
    curve: bool = False
    """Whether the row's validation loss is drawn."""

    @property
    def file(self) -> str:
        return re.sub(r"[^a-z0-9]+", "_", self.name.lower()).strip("_")


@dataclass(frozen=True)
class JudgedColons:
    """Colons to judge on, with the lenses and the light's ranges of the training colons."""

    name: str
    """Name of these colons in the table."""
    make: Literal["plain", "realistic", "variant"]
    """Kind of colons: plain, realistic, or variant, of another make than any that is trained on
    (lightdepth.tube.variant)."""
    strength: Literal["weak", "strong"]
    """Strength of the light from wall to wall: weak or strong."""
    first: int
    """Number that seeds the first colon; the others count on from it. Another one draws other colons."""
    count: int
    """Number of colons to judge on. More judge more surely and take longer."""
    frames: int = 2
    """Number of frames of each colon. More judge more surely and take longer."""

    def __post_init__(self) -> None:
        if min(self.count, self.frames) < 1 or self.first < 0:
            raise InputError(f"judged colons {self.name!r}: expected count and frames above 0 and first of at least 0")

    @property
    def seeds(self) -> range:
        return range(self.first, self.first + self.count)


@dataclass(frozen=True)
class _Plan:
    """A row of a seed: where it goes, and its settings as parsed."""

    row: Row
    seed: int
    path: Path
    config: Namespace
    stamp: dict[str, Any]


def ablate(
    output: Path,
    base: Path = Path("configs/train/lightdepth.yaml"),
    settings: dict[str, Any] | None = None,
    rows: tuple[Row, ...] = (),
    judged: tuple[JudgedColons, ...] = (),
    seeds: tuple[int, ...] = (0, 1, 2),
    table: Path | None = None,
    overwrite: bool = False,
) -> None:
    """What each ingredient of a training preset is worth: leave them out one by one, train, and compare.

    Args:
        output: Run folder; rows that are already in it, made with the same settings, are kept.
        base: Training preset that all rows start from, a YAML file.
        settings: Dotted options of `train` and their values, changed for all rows.
        rows: Trainings to compare; the first is what the others are compared with (configs/ablation/lightdepth.yaml
            has some).
        judged: Colons to judge on, which no row is trained on.
        seeds: Numbers that draw colons, weights and order, one training of each row for each. More make the
            comparison more certain and take longer.
        table: Markdown file to write a copy of the table to.
        overwrite: Make all rows anew, whatever is there.
    """
    started = time.time()
    arguments = recorded(
        output=output, base=base, settings=settings, rows=rows, judged=judged, seeds=seeds, table=table
    )
    _check(output, rows, judged, seeds)
    parser = training_parser()
    parser.exit_on_error = False
    plans = _plans(parser, output, base, settings or {}, rows, judged, seeds)
    common = parser.instantiate(plans[0].config).data
    _check_apart(common.tube, judged, seeds)
    if overwrite:
        for name in (*_OURS, *(f"seed_{seed}" for seed in {plan.seed for plan in plans})):
            path = output / name
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
    (output / "run.json").unlink(missing_ok=True)
    todo = [plan for plan in plans if _done(plan) is None]
    _say(f"{len(plans)} trainings, {len(plans) - len(todo)} of them already there")
    if todo:
        quiet()
        _train_all(parser, todo, Judge(judged, common.tube, common.size))
    results = [_done(plan) for plan in plans]
    made = Table(
        title=base.stem,
        rows=rows,
        judged=judged,
        results=[Result(**result["result"]) for result in results if result is not None],
        tube=common.tube,
        size=common.size,
        batch_size=common.batch_size,
    )
    write_table(made, output, table)
    failed = [r for r in made.results if r.failed]
    record = {"trainings": len(plans), "failures": [{"what": f"{r.row}, {r.seed}", "reason": r.failed} for r in failed]}
    write_run_json(output, "ablate", arguments, started, record)
    _say(f"table: {table or output / 'ablation.md'}")
    if failed:
        raise PartialFailure(f"{len(failed)} trainings failed, the first: {failed[0].row}: {failed[0].failed}")


def _check(output: Path, rows: Sequence[Row], judged: Sequence[JudgedColons], seeds: Sequence[int]) -> None:
    if output.exists() and not output.is_dir():
        raise InputError(f"{output}: is a file; expected a folder to write the run to")
    for what, given in (("rows", rows), ("judged colons", judged), ("seeds", seeds)):
        if not given:
            raise InputError(f"ablate: no {what}; give --config configs/ablation/lightdepth.yaml or one of your own")
    for what, names in (("rows", [row.file for row in rows]), ("judged colons", [colons.name for colons in judged])):
        twice = sorted({name for name in names if names.count(name) > 1 or not name})
        if twice:
            raise InputError(
                f"ablate: {what} {', '.join(map(repr, twice))} twice or empty; every one needs its own name"
            )
    if rows[0].seeds is not None or len(rows[0].told) != 1:
        raise InputError(f"row {rows[0].name!r}: the first is what all are compared with: no seeds or told of its own")


def _check_apart(tube: TubeData, judged: Sequence[JudgedColons], seeds: Sequence[int]) -> None:
    for seed in seeds:
        for trained in colon_seeds(tube, seed):
            for colons in judged:
                both = range(max(trained.start, colons.first), min(trained.stop, colons.seeds.stop))
                if both:
                    raise InputError(f"judged colons {colons.name!r}: {both[0]} is trained on with seed {seed}")


def _plans(
    parser: ArgumentParser,
    output: Path,
    base: Path,
    common: dict[str, Any],
    rows: Sequence[Row],
    judged: Sequence[JudgedColons],
    seeds: Sequence[int],
) -> list[_Plan]:
    """Every row of every seed, checked before the first of them is trained."""
    plans, defaults = [], parser.get_defaults()
    for row in rows:
        where = f"row {row.name!r}"
        values = _read(shipped(base))
        if row.preset is not None:
            values["model"] = _read(shipped(row.preset)).get("model", {})
        for dotted, value in {**common, **(row.settings or {})}.items():
            if isinstance(defaults.get(dotted), Namespace) and not isinstance(value, dict):
                raise InputError(f"{where}: {dotted} is a group of options; give one of them, as {dotted}.NAME")
            _set(values, dotted, value, where)
        for seed in row.seeds or seeds:
            folder = output / f"seed_{seed}" / row.file
            try:
                config = parser.parse_object({**values, "seed": seed, "output": str(folder)})
                if seed == (row.seeds or seeds)[0]:
                    parser.instantiate(config)
            except ArgumentError as error:
                reason = " ".join(str(error).split())
                raise InputError(f"{where}: {reason}; expected options of `lightdepth train`") from error
            except InputError as error:
                raise InputError(f"{where}: {error}") from error
            stamp = plain({"settings": as_yaml(parser, config), "told": row.told, "judged": judged})
            plans.append(_Plan(row, seed, folder.with_suffix(".json"), config, stamp))
    plans.sort(key=lambda plan: (list(seeds) + [plan.seed]).index(plan.seed))  # a seed's colons are rendered once
    return plans


def _read(path: Path) -> dict[str, Any]:
    try:
        values = yaml.safe_load(path.read_text())
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise InputError(f"{path}: cannot be read as a training preset ({error})") from error
    if not isinstance(values, dict):
        raise InputError(f"{path}: not a training preset; expected a YAML like configs/train/*.yaml")
    return values


def _set(values: dict[str, Any], dotted: str, value: Any, where: str) -> None:
    """values["a"]["b"] = value for "a.b"."""
    *groups, last = dotted.split(".")
    for group in groups:
        values = values.setdefault(group, {})
        if not isinstance(values, dict):
            raise InputError(f"{where}: {dotted}: {group} is an option, not a group of them")
    values[last] = copy.deepcopy(value)


def _done(plan: _Plan) -> dict[str, Any] | None:
    """The row's file, where it was made with these settings."""
    try:
        found = json.loads(plan.path.read_text())
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) and found.get("stamp") == plan.stamp else None


def _train_all(parser: ArgumentParser, todo: Sequence[_Plan], judge: Judge) -> None:
    started, steps = time.monotonic(), sum(plan.config.trainer.max_steps for plan in todo)
    done, seed, rendered = 0, None, list[FrameDataModule]()
    for number, plan in enumerate(todo, 1):
        if plan.seed != seed:
            seed, rendered = plan.seed, []
        result = _trained(parser, plan, judge, rendered)
        write_whole(plan.path, json.dumps({"stamp": plan.stamp, "result": plain(result)}, indent=1) + "\n")
        done += plan.config.trainer.max_steps
        left = (time.monotonic() - started) / done * (steps - done) / 60
        said = result.failed or f"{result.overall():.3f} of the closed form's errors"
        what = f"[{number}/{len(todo)}] seed {plan.seed}, {plan.row.name}"
        _say(f"{what}: {said}, {result.seconds:.0f} s; {left:.0f} min left")


def _trained(parser: ArgumentParser, plan: _Plan, judge: Judge, rendered: list[FrameDataModule]) -> Result:
    """Trains one row of one seed and judges it. `rendered` has frames of this seed, and gets those that it lacks."""
    folder = Path(plan.config.output)
    pl.seed_everything(plan.seed, workers=True, verbose=False)
    made = parser.instantiate(plan.config)
    data = FrameDataModule(made.data)
    if not any(data.share(other) for other in rendered):
        data.setup()
        rendered.append(data)
    curve, started = _Curve(), time.monotonic()
    options = {**vars(made.trainer), "logger": False, "callbacks": [curve], "enable_progress_bar": False}
    text = as_yaml(parser, plan.config)
    parameters = sum(p.numel() for p in made.model.network.parameters())
    failed, errors = "", dict[str, dict[str, dict[str, float]]]()
    try:
        with contextlib.redirect_stderr(io.StringIO()):  # its own log.txt has it
            fit(made.model, data, folder, options, text, plan.seed, overwrite=True, settings=made.fit)
        model = load_model(folder / "model.safetensors", details=False)
        assert isinstance(model, NetworkModel)
        model.to("cpu")  # where the colons to judge on are
        for told in plan.row.told:
            errors[told] = judge(model.network, made.model.loss_config, told)
        if not all(math.isfinite(v) for sets in errors.values() for found in sets.values() for v in found.values()):
            failed = "its distances are not numbers"
    except PartialFailure as error:
        failed = str(error)
    shutil.rmtree(folder / "checkpoints", ignore_errors=True)
    return Result(
        row=plan.row.name,
        seed=plan.seed,
        steps=plan.config.trainer.max_steps,
        parameters=parameters,
        seconds=time.monotonic() - started,
        curve=curve.points,
        errors=errors,
        closed_form=judge.closed_form,
        failed=failed,
    )


class _Curve(pl.Callback):
    """The validation loss over the steps."""

    def __init__(self) -> None:
        self.points: list[tuple[int, float]] = []

    def on_validation_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        loss = float(trainer.callback_metrics["val/loss"])
        if trainer.state.fn == "fit" and math.isfinite(loss):
            self.points.append((trainer.global_step, loss))


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


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)
