"""`lightdepth ablate`: what each ingredient of a training recipe is worth, by leaving it out.

OUT/  seed_<K>/<ROW>.json (one training and its errors, written whole)  seed_<K>/<ROW>/ (its model, log and settings)
      ablation.md  ablation.csv  ablation.json  run.json (written last)

Every row is a base preset with some settings changed, trained as `train` does it. The rows of a seed share its colons,
weights' seed and order of frames, so that they differ in what was changed and in nothing else. All are judged on the
same frames of colons that none of them saw. Rows that are already there are kept, so that a run can be continued.
"""

from __future__ import annotations

import shutil
import time
from pathlib import Path

from lightdepth.errors import PartialFailure
from lightdepth.reporting.run import recorded, write_run_json

from ..ablation.judge import Judge
from ..ablation.plan import check, check_apart, plans_of
from ..ablation.rows import JudgedColons, Row, Settings
from ..ablation.run import finished, say, train_all
from ..ablation.table import AblationTable, write_table
from ..parser import training_parser
from ..running import quiet

_OURS = ("ablation.md", "ablation.csv", "ablation.json", "run.json")


def ablate(
    output: Path,
    base: Path = Path("configs/train/lightdepth.yaml"),
    settings: Settings | None = None,
    rows: tuple[Row, ...] = (),
    judged: tuple[JudgedColons, ...] = (),
    seeds: tuple[int, ...] = (0, 1, 2),
    table: Path | None = None,
    overwrite: bool = False,
) -> None:
    """What each ingredient of a training preset is worth: leave them out one by one, train, and compare.

    Args:
        output: Run folder; rows that are already in it, made with the same settings, are kept.
        base: Training preset that all rows start from, a YAML file; a row's own preset, where it has one, replaces its
            model part.
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
    check(output, rows, judged, seeds)
    parser = training_parser()
    parser.exit_on_error = False
    plans = plans_of(parser, output, base, settings or {}, rows, judged, seeds)
    common = parser.instantiate(plans[0].config).data
    check_apart(common.tube, judged, seeds)
    if overwrite:
        for name in (*_OURS, *(f"seed_{seed}" for seed in {plan.seed for plan in plans})):
            path = output / name
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
    (output / "run.json").unlink(missing_ok=True)
    todo = [plan for plan in plans if finished(plan) is None]
    say(f"{len(plans)} trainings, {len(plans) - len(todo)} of them already there")
    if todo:
        quiet()
        train_all(parser, todo, Judge(judged, common.tube, common.size))
    results = [finished(plan) for plan in plans]
    made = AblationTable(
        title=base.stem,
        rows=rows,
        judged=judged,
        results=[result for result in results if result is not None],
        tube=common.tube,
        size=common.size,
        batch_size=common.batch_size,
    )
    write_table(made, output, table)
    failed = [r for r in made.results if r.failed]
    record = {"trainings": len(plans), "failures": [{"what": f"{r.row}, {r.seed}", "reason": r.failed} for r in failed]}
    write_run_json(output, "ablate", arguments, started, record)
    say(f"table: {table or output / 'ablation.md'}")
    if failed:
        raise PartialFailure(f"{len(failed)} trainings failed, the first: {failed[0].row}: {failed[0].failed}")
