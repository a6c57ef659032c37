"""python -m mutants --seed 1 --count 300: draws, runs, and writes the table."""

from __future__ import annotations

import argparse
import os
import random
import re
import time
from dataclasses import dataclass
from pathlib import Path

from mutants.cover import Cover, measured
from mutants.forked import Outcome, Planted, run_tests, warm
from mutants.modules import ROOT, mutated, test_files
from mutants.operators import Fault, Site, planted, sites

ENVIRONMENT = {
    "NUMBA_DISABLE_JIT": "1",
    "NUMBA_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "MPLBACKEND": "Agg",
    "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1",
}
EXPLAINED = ROOT / "docs" / "mutants.md"


@dataclass(frozen=True)
class Mutant:
    room: str
    module: str
    file: Path
    site: Site
    fault: Fault

    @property
    def name(self) -> str:
        """Where and what, without the number of the line, which changes with the code above it."""
        shown = self.fault.shown(self.file.read_text(encoding="utf-8"))
        return f"{self.module} | {self.site.function} | {shown}"


def drawn(seed: int, count: int) -> list[Mutant]:
    """Different places, each as likely as any other, and one fault for each."""
    places = [
        (room, module, path, site)
        for module, (room, path) in mutated().items()
        for site in sites(path.read_text(encoding="utf-8"))
    ]
    rng = random.Random(seed)
    chosen = rng.sample(places, min(count, len(places)))
    return [Mutant(*place, rng.choice(place[3].faults)) for place in chosen]


def tried(mutant: Mutant, cover: Cover, budget: float) -> tuple[Outcome, int]:
    """What became of a mutant, and how many tests were there to find it."""
    tests, total = [], 0.0
    for test in cover.of(mutant.file, *mutant.site.lines):
        total += cover.seconds[test]
        if tests and total > budget:
            break
        tests.append(test)
    if not tests:
        return Outcome("survived", "no test runs it", 0.0), 0
    source = mutant.file.read_text(encoding="utf-8")
    code = compile(planted(source, mutant.fault), str(mutant.file), "exec")
    allowed = {test: 3 * cover.seconds[test] + 10 for test in tests}
    return run_tests(tests, allowed, Planted(mutant.module, mutant.file, code)), len(tests)


def explained() -> dict[str, str]:
    """The sentences of docs/mutants.md, by mutant."""
    text = EXPLAINED.read_text(encoding="utf-8") if EXPLAINED.is_file() else ""
    rows = [[cell.strip(" `") for cell in line.strip("| \n").split(" | ")] for line in text.splitlines()]
    return {" | ".join(row[:3]): row[3] for row in rows if len(row) == 4}


def table(path: Path) -> dict[str, list[str]]:
    if not path.is_file():
        return {}
    return {row[1]: row for row in (line.split("\t") for line in path.read_text(encoding="utf-8").splitlines())}


def main() -> None:
    parser = argparse.ArgumentParser(prog="mutants")
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--count", type=int, default=300)
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "mutants")
    parser.add_argument("--budget", type=float, default=30.0, help="seconds of tests for one mutant")
    parser.add_argument("--survivors", action="store_true", help="runs again what the table says is not killed")
    parser.add_argument("--rooms", nargs="*", default=[])
    args = parser.parse_args()
    os.environ |= ENVIRONMENT
    begun = time.monotonic()
    mutants = [m for m in drawn(args.seed, args.count) if not args.rooms or m.room in args.rooms]
    print(f"seed {args.seed}: {len(mutants)} mutants", flush=True)
    path = args.out / f"seed-{args.seed}.tsv"
    old = {name: row for name, row in table(path).items() if not args.survivors or row[0] == "killed"}
    files = test_files()
    warm(files)
    cover = measured(files, [file for _, file in mutated().values()], args.out / "cover.json")
    rows: dict[str, list[str]] = {}
    for i, mutant in enumerate(mutants):
        row = old.get(mutant.name)
        if row is None:
            found, tests = tried(mutant, cover, args.budget)
            where = f"{mutant.file.relative_to(ROOT)}:{mutant.site.line}"
            row = [
                found.status,
                mutant.name,
                mutant.room,
                where,
                mutant.fault.operator,
                found.by,
                f"{found.seconds:.1f}",
            ]
            row.append(str(tests))
            print(f"{i + 1:4} {found.seconds:5.1f} s {found.status:8} {where} {mutant.name}  [{found.by}]", flush=True)
        rows[mutant.name] = row
        everything = {**old, **rows}
        path.write_text("".join("\t".join(r) + "\n" for r in everything.values()), encoding="utf-8")
    _control(list(rows.values()), cover)
    print(summary(list(rows.values())))
    print(f"{time.monotonic() - begun:.0f} s on the clock")


def _control(rows: list[list[str]], cover: Cover) -> None:
    """The tests that killed pass where nothing is planted."""
    tests = sorted({r[5] for r in rows if r[0] == "killed" and r[5] in cover.seconds})
    if tests:
        found = run_tests(tests, {t: 3 * cover.seconds[t] + 10 for t in tests}, None)
        print(f"control: the {len(tests)} tests that killed, with nothing planted: {found.status} {found.by}")


def summary(rows: list[list[str]]) -> str:
    """Counts by room and together, and the survivors with their sentences."""
    lines = [f"{'room':16} killed survived timeout error  share"]
    for room in [*dict.fromkeys(room for room, _ in mutated().values()), "all"]:
        of = [r for r in rows if room in (r[2], "all")]
        n = {s: sum(r[0] == s for r in of) for s in ("killed", "survived", "timeout", "error")}
        judged = n["killed"] + n["survived"]
        share = f"{n['killed'] / judged:6.1%}" if judged else "     -"
        lines.append(f"{room:16} {n['killed']:6} {n['survived']:8} {n['timeout']:7} {n['error']:5} {share}")
    reasons = explained()
    for r in rows:
        if r[0] == "survived":
            reason = reasons.get(re.sub(r"`", "", r[1]), "NO SENTENCE YET")
            lines.append(f"survived: {r[3]} {r[1]}: {reason}" + (f" ({r[5]})" if r[5] else ""))
        elif r[0] in ("timeout", "error"):
            lines.append(f"{r[0]}: {r[3]} {r[1]} ({r[5]})")
    seconds = sum(float(r[6]) for r in rows)
    return "\n".join(
        [*lines, f"{seconds:.0f} s of processor time, {seconds / max(len(rows), 1):.1f} s for each mutant"]
    )


if __name__ == "__main__":
    main()
