"""The verb bench: a run of the benchmark, `bench compare A B`, `bench estimators`. Thin: arguments in, files out."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path

from densify.bench.cases import USUAL_CASES, Case
from densify.bench.estimators import (
    NO_LIBRARY,
    EstimatorsConfig,
    compared_estimators,
    estimators_picture,
    estimators_tables,
    losses,
)
from densify.bench.record import notes, read_bench, record, tables
from densify.bench.scenes import Size, scenes
from densify.bench.verdict import compare
from densify.bench.work import IMAGE_SIZE, SHARES, BenchConfig, CellFigures, load_models, predicted, run_scene
from densify.config import DensifyConfig, OfflineConfig, Recipe
from densify.judging.config import JudgeConfig
from lightdepth.checkpoint import DEFAULT_CHECKPOINT
from lightdepth.cli import parse
from lightdepth.command_line.options import Group
from lightdepth.files.writing import write_whole
from lightdepth.models import DepthModel
from lightdepth.reporting.progress import Progress
from lightdepth.reporting.run import Run, git_revision, plain, recorded, run_folder, versions


def bench(argv: list[str]) -> int:
    """The built-in benchmark on synthetic colons; `bench compare A B`; `bench estimators`."""
    of: dict[str, Callable[..., None]] = {"compare": compare_runs, "estimators": compare_estimators}
    if argv and argv[0] in of:
        of[argv[0]](**parse(of[argv[0]], f"bench {argv[0]}", argv[1:]))
    else:
        run(**parse(run, "bench", argv))
    return 0


def run(
    output: Path = Path("runs/bench"),
    size: Size = "small",
    first_seed: int = 400,
    wrong_shares: tuple[float, ...] | None = None,
    checkpoints: tuple[str, ...] = ("decline", DEFAULT_CHECKPOINT),
    recipes: tuple[Recipe, ...] = ("paper", "full"),
    cases: tuple[Case, ...] | None = None,
    image_size: tuple[int, int] | None = None,
    method: Group[OfflineConfig] = OfflineConfig(),
    overwrite: bool = False,
) -> None:
    """Synthetic colons made from seeds, judged row by row (bench compare A B, bench estimators: --help of each).

    Args:
        output: Folder to make, with bench.json and bench.md.
        size: How much is measured: small, two short sequences, minutes; full, eight and a screening, up to an hour.
        first_seed: Number that seeds the first scene; the others count on from it. Seeds below 1000 were never
            trained on. Another one draws other colons.
        wrong_shares: Shares of wrong map points, each a SLAM export of its own (the screening always has 0.3); left
            out, those of the size. More shares take longer.
        checkpoints: Depth models to compare: paths, names of bundled ones, decline (the closed form) or constant.
        recipes: Ways to make surfaces that are compared: full, paper, or both.
        cases: Map errors that come together, each judged with one scale a keyframe and in full: clean, side, wide side,
            drift, fold, poses; left out, those of the size. More cases take longer.
        image_size: Width and height of the keyframes, pixels; left out, that of the size. A larger one takes longer.
        overwrite: Replace a run made before.
    """
    arguments = recorded(
        method,
        output=output,
        size=size,
        first_seed=first_seed,
        wrong_shares=wrong_shares,
        checkpoints=checkpoints,
        recipes=recipes,
        cases=cases,
        image_size=image_size,
    )
    config = BenchConfig(
        size,
        first_seed,
        wrong_shares or SHARES[size],
        checkpoints=checkpoints,
        recipes=recipes,
        cases=USUAL_CASES[size] if cases is None else cases,
        image_size=image_size or IMAGE_SIZE[size],
        densify=DensifyConfig(**vars(method), judge=JudgeConfig(on=False)),
    )
    models = load_models(checkpoints)
    with run_folder(output, "bench", arguments, overwrite) as folder:
        cells, seconds = _cells(config, models)
        found = record(config, [cell.record() for cell in cells], seconds)
        _write_json(folder, "bench.json", found)
        text = "\n".join([*(t.markdown() for t in tables(found)), *(f"{note}\n" for note in notes(found))])
        (folder.folder / "bench.md").write_text(text, encoding="utf-8", errors="backslashreplace")
        folder.log(text)


def _cells(config: BenchConfig, models: Sequence[DepthModel]) -> tuple[list[CellFigures], dict[str, float]]:
    """The cells of all scenes, and the seconds that each scene took."""
    chosen = scenes(config.size, config.first_seed)
    cells: list[CellFigures] = []
    seconds: dict[str, float] = {}
    with Progress("Benchmark", sum(config.rows_of(s) * s.keyframes for s in chosen)) as bar:
        for scene in chosen:
            start = time.perf_counter()
            seen = predicted(scene, config.image_size, models)
            cells += run_scene(seen, config, partial(bar.advance, scene.keyframes))
            seconds[scene.name] = round(time.perf_counter() - start, 3)
    return cells, seconds


def compare_runs(a: Path, b: Path, output: Path | None = None, seed: int = 0) -> None:
    """Whether run B is better or worse than run A, or within noise; paired where the scenes are the same.

    Args:
        a: File bench.json of the first run, or its folder.
        b: File bench.json of the second run, or its folder.
        output: JSON file to write the comparison to, besides showing it.
        seed: Number that draws the bootstrap samples. Another one gives slightly different intervals.
    """
    found = compare(read_bench(a), read_bench(b), seed)
    print(found.markdown(str(a), str(b)))
    if output is not None:
        data = {"kind": "bench comparison", "a": a, "b": b, **asdict(found), "verdict": found.verdict}
        write_whole(output, json.dumps(plain(data), indent=1) + "\n")


def compare_estimators(
    output: Path = Path("runs/estimators"),
    shares: tuple[float, ...] = EstimatorsConfig.shares,
    points: tuple[int, ...] = EstimatorsConfig.points,
    draws: int = 50,
    seed: int = 0,
    overwrite: bool = False,
) -> None:
    """Estimators of a keyframe's scale side by side, by share, kind and number of wrong points.

    Args:
        output: Folder to make, with estimators.json, .md and .png.
        shares: Shares of wrong points, each judged on its own. More shares take longer.
        points: Numbers of points per keyframe, each judged on its own. More numbers take longer.
        draws: Number of keyframes drawn for each combination. More make the figures more certain and take longer.
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
        _write_json(folder, "estimators.json", data | {"versions": versions(), "revision": git_revision()})
        text = "\n".join([*(t.markdown() for t in estimators_tables(records)), *(f"{line}\n" for line in said)])
        (folder.folder / "estimators.md").write_text(text, encoding="utf-8", errors="backslashreplace")
        (folder.folder / "estimators.png").write_bytes(estimators_picture(records))
        folder.log(text)


def _write_json(run: Run, name: str, data: Mapping[str, object]) -> None:
    (run.folder / name).write_text(json.dumps(plain(data), indent=1, allow_nan=False) + "\n", encoding="utf-8")
