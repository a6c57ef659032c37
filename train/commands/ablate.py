"""`lightdepth ablate`: what each ingredient of a training recipe is worth, by leaving it out.

OUT/  seed_<K>/<ROW>.json (one training and its errors, written whole)  seed_<K>/<ROW>/ (its model, log and settings)
      ablation.md  ablation.csv  ablation.json  run.json (written last)

Every row is a base preset with some settings changed, trained as `train` does it. The rows of a seed share its colons,
weights' seed and order of frames, so that they differ in what was changed and in nothing else. All are judged on the
same frames of colons that none of them saw. Rows that are already there are kept, so that a run can be continued.
"""

from __future__ import annotations

import os
import re
import time
from collections.abc import Mapping
from pathlib import Path
from shlex import quote
from typing import Annotated

from lightdepth.command_line.outcome import end, outcome
from lightdepth.counting import counted, full_stop
from lightdepth.errors import InputError, PartialFailure
from lightdepth.files import replacing
from lightdepth.files.lock import locked
from lightdepth.files.named_inputs import INPUTS, write_inputs
from lightdepth.files.replacing import (
    RECORD,
    check_replaceable,
    check_rewritable,
    hidden,
    read_record,
    real_output,
    recover,
    stamp,
    unfinished_path,
)
from lightdepth.ranges import SEED
from lightdepth.reporting.names import KEPT, Names, names_of
from lightdepth.reporting.record import write_run_json
from lightdepth.reporting.run import recorded
from lightdepth.reporting.same import paths_in
from lightdepth.reporting.unfinished import begin

from ..ablation.judge import Judge
from ..ablation.plan import check, check_apart, plans_of
from ..ablation.rows import JudgedColons, Row, Settings
from ..ablation.run import finished, say, train_all
from ..ablation.table import HEADING, AblationTable, Result, write_table
from ..parser import training_parser
from ..running import while_training

_OURS = ("ablation.md", "ablation.csv", "ablation.json", INPUTS, "run.json")


def ablate(
    output: Path,
    base: Path = Path("configs/train/lightdepth.yaml"),
    settings: Settings | None = None,
    rows: tuple[Row, ...] = (),
    judged: tuple[JudgedColons, ...] = (),
    seeds: Annotated[tuple[int, ...], SEED] = (0, 1, 2),
    table: Path | None = None,
    overwrite: bool = False,
) -> None:
    """What each ingredient of a training preset is worth: leave them out one by one, train, and compare.

    Args:
        output: Run folder, with the table (ablation.md). Trainings already in it are kept where their settings are the
            same, so that a stopped run goes on.
        base: YAML file of options of `train` that the training of every row starts from; --settings and the row's own
            come on top, and a row's own preset replaces its model part. Another file compares changes to another
            training.
        settings: Options of `train` by their dotted names, with values, such as {trainer.max_steps: 300}, which all
            rows have in place of those of --base; a row's own win over them.
        rows: Trainings to compare, best given in a --config file: a list with name, settings and more for each, as
            configs/ablation/lightdepth.yaml has it. The first is what the others are compared with.
        judged: Synthetic colons whose depth errors all rows are judged by, and on which none is trained; best given in
            a --config file: a list with name, make, strength, first and count for each, as
            configs/ablation/lightdepth.yaml has it.
        seeds: Numbers that colons, first weights and order of frames follow from; each row is trained once with each of
            them. More make the comparison more certain and take longer.
        table: Markdown file to which a copy of the table is written. Left out, it is in the run folder only.
        overwrite: Train all rows anew, also those already in the run folder. Without it, these are kept.
    """
    arguments = recorded(
        output=output, base=base, settings=settings, rows=rows, judged=judged, seeds=seeds, table=table
    )
    check(output, rows, judged, seeds)
    real = real_output(output)
    if table is not None:
        check_rewritable(table, HEADING, [base])
    real.parent.mkdir(parents=True, exist_ok=True)
    with locked(real):
        recover(real)
        before = stamp(real)
        if overwrite and real.is_dir() and any(real.iterdir()):
            replacing.check_apart(real, paths_in({**arguments, "table": None}))
            check_replaceable(real, "ablate")
            place = unfinished_path(real)  # the old one stays until the new one is whole
            begin(place, {"verb": "ablate"})
        else:
            _check_ours(real)
            place = real
        failed = _ablate(place, base, settings, rows, judged, seeds, table, arguments)
        if place != real:
            (place / replacing.BEGUN).unlink(missing_ok=True)
            replacing.replace(place, real, before)
    outcome().made(output)
    if failed:
        first = full_stop(f"{failed[0].row}: {failed[0].failed}")
        raise PartialFailure(f"{counted(len(failed), 'training')} failed, the first: {first} The rest is in {output}")
    page = table or output / "ablation.md"
    end(*filter(None, (output, table)), then=f"cat {quote(str(page))}", page=page)


def _check_ours(output: Path) -> None:
    """Raises InputError where a folder holds what no ablation writes: it would be listed as the run's, or replaced."""
    if os.path.lexists(output / RECORD) and ((record := read_record(output)) is None or record["verb"] != "ablate"):
        raise InputError(output, f"holds a {RECORD} that no ablation made", "choose another -o")
    for path in sorted(output.iterdir()) if output.is_dir() else ():
        if path.name not in _OURS and not re.fullmatch(r"seed_-?\d+", path.name) and not hidden(path):
            raise InputError(output, f"holds {path.name}, which no ablation made", "choose another -o")


def _ablate(
    output: Path,
    base: Path,
    settings: Settings | None,
    rows: tuple[Row, ...],
    judged: tuple[JudgedColons, ...],
    seeds: tuple[int, ...],
    table: Path | None,
    arguments: Mapping[str, object],
) -> list[Result]:
    """Trains what is not in the folder yet, and writes the table; the trainings that failed."""
    started = time.monotonic()
    parser = training_parser()
    parser.exit_on_error = False
    plans = plans_of(parser, output, base, settings or {}, rows, judged, seeds)
    common = parser.instantiate(plans[0].config).data
    check_apart(common.tube, judged, seeds)
    (output / "run.json").unlink(missing_ok=True)
    todo = [plan for plan in plans if finished(plan) is None]
    say(f"{counted(len(plans), 'training')}, {len(plans) - len(todo)} of them already there")
    if todo:
        with while_training():
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
    names = Names() if KEPT.get() else names_of(arguments, (output,))
    if names.paths:
        write_inputs(output, names.paths)
    write_run_json(output, "ablate", arguments, started, record, names)
    return failed
