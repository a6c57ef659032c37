"""The verb bench: a run of the benchmark, `bench compare A B`, `bench estimators`, `bench per-frame`, `bench
completion`, `bench speed` (densify.commands.bench_speed). Thin: arguments in, files out."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from shlex import quote
from typing import Annotated

from densify.bench import per_frame
from densify.bench.cases import USUAL_CASES, Case
from densify.bench.completion.external import external_folders
from densify.bench.completion.pictures import page as completion_page
from densify.bench.completion.run import RESERVED, completed_cells
from densify.bench.completion.scenes import ERRORS, Errors
from densify.bench.completion.scenes import IMAGE_SIZE as SIZES
from densify.bench.completion.tables import notes as completion_notes
from densify.bench.completion.tables import record as completion_record
from densify.bench.completion.tables import tables as completion_tables
from densify.bench.costs import bench_plan, completion_plan, per_frame_plan
from densify.bench.curve_pictures import bench_picture
from densify.bench.estimators import (
    NO_LIBRARY,
    EstimatorsConfig,
    compared_estimators,
    estimators_picture,
    estimators_tables,
    losses,
)
from densify.bench.files import write_json, write_tables
from densify.bench.record import notes, read_bench, record, tables
from densify.bench.scenes import Size, scenes
from densify.bench.spoilt import SpoiltFrame, spoilt_frames, spoilt_tables
from densify.bench.verdict import compare
from densify.bench.work import IMAGE_SIZE, SHARES, BenchConfig, ModelSources, cells_of, load_models, predicted
from densify.commands.bench_speed import measure_speed
from densify.config import DensifyConfig, OfflineConfig, Recipe
from lightdepth.checkpoint import DEFAULT_CHECKPOINT, ModelSource
from lightdepth.cli import parse
from lightdepth.command_line.options import Group
from lightdepth.command_line.outcome import end, outcome
from lightdepth.command_line.parsing import Parser
from lightdepth.command_line.verbs import verb_parser
from lightdepth.errors import InputError
from lightdepth.files.images import write_image
from lightdepth.files.replacing import check_rewritable
from lightdepth.files.writing import write_whole
from lightdepth.judge_colons import JUDGE_COLONS
from lightdepth.models import DepthModel
from lightdepth.ranges import BELOW_ONE, COUNT, SEED, at_least
from lightdepth.reporting.names import told
from lightdepth.reporting.progress import Progress
from lightdepth.reporting.record import git_revision, versions
from lightdepth.reporting.run import Run, plain, recorded, run_folder


def bench(argv: list[str]) -> int:
    """The built-in benchmark on synthetic colons, or another one: compare, estimators, per-frame, completion, speed."""
    ways = _ways()
    if argv and argv[0] in ways:
        ways[argv[0]](**parse(ways[argv[0]], f"bench {argv[0]}", argv[1:]))
    else:
        run(**parse(run, "bench", argv))
    return 0


def _ways() -> dict[str, Callable[..., None]]:
    return {
        "compare": compare_runs,
        "estimators": compare_estimators,
        "per-frame": compare_per_frame,
        "completion": compare_completions,
        "speed": measure_speed,
    }


def parsers() -> dict[str, Parser]:
    """What the command line of bench is, and of each of its other ways."""
    ways = {way: verb_parser(function, f"bench {way}") for way, function in _ways().items()}
    return {"": verb_parser(run, "bench")} | ways


def run(
    output: Path = Path("runs/bench"),
    size: Size = "small",
    first_seed: Annotated[int, SEED] = 400,
    wrong_shares: Annotated[tuple[float, ...] | None, BELOW_ONE] = None,
    compared: Group[ModelSources] = ModelSources(),
    recipes: tuple[Recipe, ...] = ("paper", "full"),
    cases: tuple[Case, ...] | None = None,
    image_size: Annotated[tuple[int, int] | None, at_least(32, up_to=10_000)] = None,
    method: Group[OfflineConfig] = OfflineConfig(),
    overwrite: bool = False,
    resume: bool = False,
) -> None:
    """Synthetic colons made from seeds, judged row by row; also compare, estimators, per-frame, completion,
    speed.

    Args:
        output: Folder to make, with bench.json, bench.md, bench.png (error against coverage and by distance), and
            report.html with all of it.
        size: How much is measured: small, two short sequences, minutes; full, eight, and one ten times as long (the
            screening), up to an hour.
        first_seed: Number that seeds the first scene; the others count on from it. Bundled checkpoints were trained on
            no seed below 1000. Another one draws other colons.
        wrong_shares: Shares, in [0, 1), of wrong map points, each a map of its own (the screening always has 0.3); left
            out, 0.1 and 0.45 (small), or 0, 0.1, 0.3 and 0.45 (full). More shares take longer, and larger ones are
            harder.
        recipes: Ways to make surfaces that are compared: full (all steps), paper (as published: one scale per keyframe,
            plain TSDF, and the gates and the reach that densify --recipe paper names), or both. Options of agreement,
            bending, contradiction and rectify count for full alone.
        cases: Errors that map points share, each tried with one scale per keyframe and with all steps, by the last of
            --checkpoints: clean (none), side (30 % of the points, on one side, 15 % too far), wide side (45 %, 30 %),
            drift (of scale, 30 %), fold (20 % one fold too far), loop (half closed where there is none), poses (a bent
            path), breath 2, 5 and 10 (the wall breathes by as many %), waves (peristalsis of 10 %). Left out, clean,
            wide side and drift (small), or all (full). More cases take longer.
        image_size: Width and height of the keyframes, pixels; left out, 160 by 128 (small) or 320 by 256 (full). A
            larger one shows finer detail and takes longer.
        overwrite: Replace a run made before.
        resume: Go on with the run that was stopped there, as it was begun; maps of a scene that were judged are not
            made again.
    """
    arguments = recorded(
        compared,
        method,
        output=output,
        size=size,
        first_seed=first_seed,
        wrong_shares=wrong_shares,
        recipes=recipes,
        cases=cases,
        image_size=image_size,
    )
    config = BenchConfig(
        size,
        first_seed,
        wrong_shares or SHARES[size],
        checkpoints=compared.checkpoints,
        recipes=recipes,
        cases=USUAL_CASES[size] if cases is None else cases,
        image_size=image_size or IMAGE_SIZE[size],
        densify=DensifyConfig(**vars(method)),
    )
    models = load_models(compared.checkpoints, compared.device)
    with run_folder(output, "bench", arguments, overwrite, resume) as folder:
        folder.hash_inputs(**{checkpoint: Path(checkpoint) for checkpoint in compared.checkpoints})
        folder.begins(*bench_plan(config))
        cells, seconds = _cells(folder, config, models)
        found = record(config, cells, seconds)
        write_json(folder, "bench.json", found)
        picture = bench_picture(found["cells"])
        if picture is not None:
            (folder.folder / "bench.png").write_bytes(picture)
        caption = "Median error over the share of the truth that is met, and error by distance"
        pictures = [] if picture is None else [(picture, caption)]
        write_tables(folder, "bench", "Surfaces of synthetic colons", tables(found), notes(found), pictures)
    end(output, then=f"lightdepth bench compare {quote(str(output))} OTHER", page=output / "report.html")


def _cells(
    folder: Run, config: BenchConfig, models: Sequence[DepthModel]
) -> tuple[list[Mapping[str, object]], dict[str, float]]:
    """The cells of all scenes as bench.json has them, each a finished part, and the seconds that each scene took."""
    chosen = scenes(config.size, config.first_seed)
    cells: list[Mapping[str, object]] = []
    seconds: dict[str, float] = {}
    with Progress("Benchmark", sum(config.rows_of(s) * s.keyframes for s in chosen)) as bar:
        for scene in chosen:
            start, seen = time.perf_counter(), None
            for name, make in cells_of(scene, config, partial(bar.advance, scene.keyframes)).items():
                part = f"{scene.name}, {name}"
                if not folder.done(part):
                    seen = seen or predicted(scene, config.image_size, models, config.cases_of(scene))
                    folder.finish_part(part, [], [make(seen).record(), time.perf_counter() - start])
                    start = time.perf_counter()
                cell, taken = folder.kept_of(part)
                cells.append(cell)
                seconds[scene.name] = round(seconds.get(scene.name, 0.0) + taken, 3)
    return cells, seconds


def compare_runs(a: Path, b: Path, output: Path | None = None, seed: Annotated[int, SEED] = 0) -> None:
    """Whether run B is better or worse than run A, or within noise; paired where the scenes are the same.

    Args:
        a: File bench.json of the first run, or its folder.
        b: File bench.json of the second run, or its folder.
        output: JSON file to write the comparison to, besides showing it.
        seed: Number that draws the bootstrap samples, which show how large noise is. Another one gives
            slightly different intervals.
    """
    if output is not None:
        check_rewritable(output, '{\n "kind": "bench comparison"', [a, b])
    found = compare(read_bench(a), read_bench(b), seed)
    outcome().last(found.markdown(str(a), str(b)))
    data = {
        "kind": "bench comparison",
        "a": told(str(a), a=a),
        "b": told(str(b), b=b),
        **asdict(found),
        "verdict": found.verdict,
    }
    if output is not None:
        write_whole(output, json.dumps(plain(data), indent=1) + "\n")
    written = [] if output is None else [output]
    end(*written, then="lightdepth bench -o OTHER --size full", result=plain(data))


def compare_estimators(
    output: Path = Path("runs/estimators"),
    shares: Annotated[tuple[float, ...], BELOW_ONE] = EstimatorsConfig.shares,
    points: Annotated[tuple[int, ...], at_least(8, up_to=1_000_000)] = EstimatorsConfig.points,
    draws: Annotated[int, COUNT] = 50,
    seed: Annotated[Annotated[int, SEED], SEED] = 0,
    overwrite: bool = False,
) -> None:
    """Estimators of a keyframe's scale side by side, by share, kind and number of wrong points.

    Args:
        output: Folder to make, with estimators.json, .md and .png, and report.html.
        shares: Shares, in [0, 1), of a keyframe's points that are wrong, each judged on its own. More shares take
            longer, and larger ones are harder.
        points: Numbers of points per keyframe, each at least 8 and judged on its own. More numbers take longer, and
            larger ones make the scale easier to find.
        draws: Number of keyframes drawn for each combination of share, points and kind of error. More make the figures
            more certain and take longer.
        seed: Number that draws the keyframes and their points. Another one draws others.
        overwrite: Replace what an earlier run made there.
    """
    arguments = recorded(output=output, shares=shares, points=points, draws=draws, seed=seed)
    config = EstimatorsConfig(shares=shares, points=points, draws=draws, seed=seed)
    with run_folder(output, "bench estimators", arguments, overwrite) as folder:
        with Progress("Estimators", len(config.kinds) * len(points) * len(shares)) as bar:
            records = compared_estimators(config, bar.advance)
        said = [*losses(records), NO_LIBRARY]
        unit = "shares of 1: |found scale / true scale - 1|"
        data = {"kind": "estimators", "unit": unit, "config": asdict(config), "records": records, "notes": said}
        write_json(folder, "estimators.json", data | {"versions": versions(), "revision": git_revision()})
        picture = estimators_picture(records)
        (folder.folder / "estimators.png").write_bytes(picture)
        pictures = [(picture, "Error of the scale by the share of wrong points")]
        title = "Estimators of a keyframe's scale"
        write_tables(folder, "estimators", title, estimators_tables(records), said, pictures)
    end(output, then="lightdepth bench estimators -o OTHER --draws 200", page=output / "report.html")


def compare_per_frame(
    output: Path = Path("runs/per-frame"),
    compared: Group[ModelSources] = ModelSources((DEFAULT_CHECKPOINT, "lightdepth-self")),
    colons: Path | None = None,
    spoilt: bool = False,
    overwrite: bool = False,
    resume: bool = False,
) -> None:
    """Depth of single frames beside the closed form, on twelve colons of a renderer that nothing was trained on.

    Args:
        output: Folder to make, with per-frame.json, .md and report.html, and, unless --colons is given, the colons'
            frames and their truth in colons/ (each a sequence that predict and evaluate read) with a picture of them.
        colons: Folder colons/ of an earlier run, whose frames are taken in place of making them anew, which takes some
            ten minutes.
        spoilt: Judge frames with blur, smoke, water drops, clipping, noise and compression too, at five severities:
            error, and the shares that import and the gate for depth would keep; some minutes more for each model.
        overwrite: Replace a run made before.
        resume: Go on with the run that was stopped there, as it was begun; colons that were judged are not made again.
    """
    arguments = recorded(compared, output=output, colons=colons, spoilt=spoilt)
    models = load_models(tuple(dict.fromkeys((per_frame.BASELINE, *compared.checkpoints))), compared.device)
    rows: list[per_frame.ColonFigures] = []
    bad: list[SpoiltFrame] = []
    with run_folder(output, "bench per-frame", arguments, overwrite, resume) as folder:
        folder.hash_inputs(colons=colons, **{checkpoint: Path(checkpoint) for checkpoint in compared.checkpoints})
        folder.begins(*per_frame_plan(len(models), colons is None, spoilt))
        sequences = []
        with Progress("Frames", sum(colon.frames for colon in JUDGE_COLONS)) as bar:
            for colon in JUDGE_COLONS:
                place = (folder.folder / "colons" if colons is None else colons) / colon.name
                if not folder.done(colon.name):
                    files = per_frame.write_colon(colon, place, bar.advance) if colons is None else []
                    frames = per_frame.read_colon(colon, place)
                    kept = [asdict(row) for row in per_frame.judged(colon, frames, models)]
                    more = [asdict(row) for row in spoilt_frames(colon, frames, models)] if spoilt else []
                    if not files:
                        bar.advance(colon.frames)
                    folder.finish_part(colon.name, files, {"clean": kept, "spoilt": more})
                else:
                    bar.advance(colon.frames)
                sequences.append(per_frame.read_colon(colon, place))
                rows += [per_frame.ColonFigures(**row) for row in folder.kept_of(colon.name)["clean"]]
                bad += [SpoiltFrame(**row) for row in folder.kept_of(colon.name)["spoilt"]]
        found = per_frame.record(rows) | {"spoilt": [asdict(row) for row in bad], "versions": versions()}
        write_json(folder, "per-frame.json", found)
        write_image(folder.folder / "colons.png", per_frame.contact_sheet(sequences))
        pictures = [((folder.folder / "colons.png").read_bytes(), "A frame of each colon")]
        shown = [*per_frame.tables(rows), *spoilt_tables(bad)]
        write_tables(folder, "per-frame", "Depth of single frames", shown, [], pictures)
    made = quote(str(output / "colons" if colons is None else colons))
    then = f"lightdepth bench per-frame -o OTHER --colons {made} --checkpoints '[CHECKPOINT]'"
    end(output, then=then, page=output / "report.html")


def compare_completions(
    output: Path = Path("runs/completion"),
    size: Size = "small",
    predicting: Group[ModelSource] = ModelSource(),
    errors: tuple[Errors, ...] = ERRORS,
    external: tuple[str, ...] = (),
    inputs: bool = False,
    image_size: Annotated[tuple[int, int] | None, at_least(32, up_to=10_000)] = None,
    method: Group[OfflineConfig] = OfflineConfig(),
    overwrite: bool = False,
    resume: bool = False,
) -> None:
    """Dense depth from the same sparse points and the same prediction, completed in several ways, on six colons.

    Args:
        output: Folder to make, with completion.json and .md, and report.html with curves and pictures.
        size: How large the keyframes are: small, 160 by 128 pixels, some ten minutes; full, 320 by 256, four times as
            long.
        errors: How 30 % of the map's points are wrong: independent (each on its own), coherent (one side of the wall,
            in a SLAM that errs as a real one), or both.
        external: Completions of other programs, each NAME=FOLDER, a row of that name: FOLDER/SCENE/ERRORS/000012.npz
            holds one array, distance or depth, of keyframe 12, in map units (--inputs true writes what they are made
            from).
        inputs: Whether to write what another program completes, one .npz for each keyframe, into inputs/.
        image_size: Width and height of the keyframes, pixels, in place of those of the size. A larger one shows finer
            detail and takes longer.
        overwrite: Replace a run made before.
        resume: Go on with the run that was stopped there, as it was begun; colons that were judged are not made again.
    """
    arguments = recorded(
        predicting,
        method,
        output=output,
        size=size,
        errors=errors,
        external=external,
        inputs=inputs,
        image_size=image_size,
    )
    if not errors or len(set(errors)) < len(errors):
        raise InputError("--errors", f"{list(errors)}", "expected at least one, and none twice")
    folders = external_folders(external, RESERVED)
    (model,) = load_models((predicting.checkpoint,), predicting.device)
    config = DensifyConfig(**vars(method))
    with run_folder(output, "bench completion", arguments, overwrite, resume) as folder:
        folder.hash_inputs(checkpoint=Path(predicting.checkpoint), **folders)
        folder.begins(*completion_plan(len(errors), image_size or SIZES[size]))
        cells, pictures = completed_cells(folder, model, config, errors, folders, inputs, image_size or SIZES[size])
        found = {**completion_record(cells), "config": config, "versions": versions(), "revision": git_revision()}
        write_json(folder, "completion.json", found)
        text = "\n".join(
            [*(t.markdown() for t in completion_tables(cells)), *(f"{n}\n" for n in completion_notes(cells))]
        )
        (folder.folder / "completion.md").write_text(text, encoding="utf-8", errors="backslashreplace")
        page = completion_page(cells, pictures)
        page.files(folder.folder, {"completion.md": "the tables", "completion.json": "every figure, for programs"})
        page.write(folder.folder / "report.html")
        folder.log(text)
    then = "lightdepth bench completion -o OTHER --external '[NAME=FOLDER]'"
    end(output, then=then, page=output / "report.html")
