"""Two runs of the benchmark: is B better than A, worse, or within noise?

Notation: x_j the mean of the log of a figure over the shares of wrong points of scene j (of the scale's error and the
share of keyframes left out, which can be nothing, the mean of itself); all figures are errors. d_j = x_j of B - x_j of
A, of the same colon where both runs have the same seeds ("paired"), else of two colons of one design. The verdict is on
the mean of d over the scenes; where x is a log, exp of it is the ratio B / A.

How much d varies from scene to scene is badly known from two scenes. What it was on other colons counts besides, as if
it had been seen on `scenes` more (a moderated variance: Smyth 2004):

    s² = (scenes · spread² + sum (d_j - mean d)²) / (scenes + n - 1)

The interval is a smoothed bootstrap's: scenes are drawn with replacement, and a normal deviate tops the variance of a
draw up to s², itself drawn from what scenes + n - 1 degrees of freedom leave open. Intervals of all rows and figures
hold together with 95 % (Bonferroni), so that a run compared with its like is "within noise" as a whole.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from densify.bench.record import COLUMNS, BenchFile, figure
from densify.bench.work import INLIERS, SPARSE
from densify.evaluation.tables import Table
from lightdepth.errors import InputError

Verdict = Literal["better", "worse", "within noise"]
LEVEL = 0.95
DRAWS = 20_000


@dataclass(frozen=True)
class Spread:
    """Deviation of d from scene to scene where nothing was changed, by figure, and as how many scenes it counts.

    More than a handful would drown what many scenes say of themselves."""

    scenes: int
    deviation: Mapping[str, float]


SAME_COLONS = Spread(
    8, {"rms_mm": 0.1, "median_mm": 0.2, "depth_abs_rel": 0.2, "scale_error": 0.02, "unaligned_share": 0.2}
)
"""Two draws of the SLAM's noise on one colon: what a change that neither helps nor harms may do to a scene."""
OTHER_COLONS = Spread(
    20, {"rms_mm": 0.56, "median_mm": 0.66, "depth_abs_rel": 0.4, "scale_error": 0.035, "unaligned_share": 0.3}
)
"""Two colons of one design. Both measured on the 15 colons of seeds 310 to 324 by tests/benchmarks/bench_bench.py, over
all rows, for one share of wrong points and two; no figure is reported on these."""


@dataclass(frozen=True)
class Judged:
    """One figure of one row: means of both runs (of distances and AbsRel, geometric), the change with its interval, a
    ratio B / A or a difference B - A, from so many scenes; cells (scene and share) that only one run has a figure for.
    """

    row: str
    figure: str
    change_is: Literal["ratio", "difference"]
    a: float
    b: float
    change: float
    low: float
    high: float
    scenes: int
    only_a: int
    only_b: int

    @property
    def verdict(self) -> Verdict:
        none = 1.0 if self.change_is == "ratio" else 0.0
        return "worse" if self.low > none else "better" if self.high < none else "within noise"

    def shown(self) -> tuple[str, str]:
        """The change and its interval, for people: in %, or in points of a per cent."""
        less, unit = (1, "%") if self.change_is == "ratio" else (0, "points")
        change, low, high = (f"{100 * (v - less):+.1f}" for v in (self.change, self.low, self.high))
        return f"{change} {unit}", f"{low} to {high} {unit}"


@dataclass(frozen=True)
class Comparison:
    """All rows that both runs have. `changed` are settings that differ, `unmatched` rows that only one run has."""

    paired: bool
    judged: tuple[Judged, ...]
    changed: Mapping[str, tuple[Any, Any]]
    unmatched: tuple[str, ...]
    level: float = LEVEL

    def of_row(self, row: str) -> Verdict:
        return _together([j.verdict for j in self.judged if j.row == row])

    @property
    def verdict(self) -> Verdict:
        """Worse if any figure of any row is: a change that harms anything wants looking at, whatever else it helps."""
        return _together([j.verdict for j in self.judged])

    def markdown(self, a: str, b: str) -> str:
        rows = [
            [
                j.row,
                COLUMNS[j.figure],
                j.a,
                j.b,
                *j.shown(),
                j.verdict,
            ]
            for j in self.judged
        ]
        headers = ["Row", "Figure", "A", "B", "Change", f"{self.level:.0%} interval of all", "B is"]
        how = "same colons, paired differences" if self.paired else "other colons of the same designs, unpaired"
        n = max(j.scenes for j in self.judged)
        means = "Means over scenes and shares of wrong points (of distances and AbsRel, geometric)."
        title = f"A {a}\nB {b}\n\n{n} scenes, {how}. {means}"
        said = [f"{row}: {self.of_row(row)}." for row in dict.fromkeys(j.row for j in self.judged)]
        said += [f"Setting {k}: {was} in A, {now} in B." for k, (was, now) in self.changed.items()]
        said += [f"Row {row} is in one run only." for row in self.unmatched]
        for row in dict.fromkeys(j.row for j in self.judged):
            first = next(j for j in self.judged if j.row == row)
            if first.only_a or first.only_b:
                said.append(
                    f"{row}: {first.only_a} cells have figures in A alone, {first.only_b} in B alone; they are left "
                    "out, so look at why."
                )
        if n < 5:
            said.append(f"{n} scenes say little about others: use --size full before you believe a small difference.")
        made = Table(title, headers, rows).markdown()
        return f"{made}\n" + "\n".join(said) + f"\n\nB is {self.verdict}" + ("." if "n" in self.verdict else " than A.")


def _together(verdicts: Sequence[Verdict]) -> Verdict:
    return next((v for v in ("worse", "better") if v in verdicts), "within noise")


def compare(a: BenchFile, b: BenchFile, seed: int = 0) -> Comparison:
    """B against A. Raises InputError where they are not of the same work: other suites, scenes, shares or image sizes,
    seeds that are the same in part, or no row in common."""
    if a.suite_version != b.suite_version:
        raise InputError(
            "suite version",
            f"{a.suite_version} in A, {b.suite_version} in B: their scenes differ",
            "run both again with one version of the program",
        )
    for key in ("size", "image_size", "screening_share"):
        if a.config.get(key) != b.config.get(key):
            raise InputError(key, f"{a.config.get(key)} in A, {b.config.get(key)} in B", "run both with the same")
    places = [{(c.scene, c.wrong_share, c.case): c for c in run.cells} for run in (a, b)]
    apart = sorted(place for place in set(places[0]) ^ set(places[1]) if not place[2])  # cases are rows of their own
    if apart:
        scene, share, _ = apart[0]
        which = "A" if apart[0] in places[0] else "B"
        raise InputError(which, f"{scene} at {share:.0%} wrong points is in it alone", "run both with the same shares")
    same = [name for name, number in a.seeds.items() if b.seeds[name] == number]
    if same and len(same) < len(a.seeds):
        raise InputError(
            "seeds of A and B",
            f"{len(same)} of {len(a.seeds)} scenes have the same seed in both runs",
            "expected all (paired) or none",
        )
    rows = [[*dict.fromkeys(_Row(c.case, r) for c in run.cells for r in c.rows)] for run in (a, b)]
    rows = [[row for row in of if row.name not in (SPARSE, INLIERS)] for of in rows]
    common = [row for row in rows[0] if row in rows[1]]
    if not common:
        raise InputError(
            "rows of A and B",
            "none is in both",
            f"run both with the same: A has {'; '.join(map(str, rows[0]))}; B has {'; '.join(map(str, rows[1]))}",
        )
    spread = SAME_COLONS if same else OTHER_COLONS
    tail = (1 - LEVEL) / 2 / (len(common) * len(spread.deviation))
    judged: list[Judged] = []
    for row in common:
        for key in spread.deviation:
            values = [
                {p: compared_value(cell.rows.get(row.name), key) for p, cell in cells.items() if cell.case == row.case}
                for cells in places
            ]
            rng = np.random.default_rng([seed, len(judged)])
            found = _judge(str(row), key, values, spread, tail, rng)
            if found is not None:
                judged.append(found)
    if not judged:
        raise InputError(
            "rows of A and B", "none has figures for the same scenes in both runs", "their bench.md say why"
        )
    unmatched = tuple(str(row) for row in dict.fromkeys((*rows[0], *rows[1])) if row not in common)
    return Comparison(bool(same), tuple(judged), _changed(a.config, b.config), unmatched)


class _Row(NamedTuple):
    """A row of the cells of one case of errors that come together, or of those that have none."""

    case: str
    name: str

    def __str__(self) -> str:
        return f"{self.name} ({self.case})" if self.case else self.name


_Place = tuple[str, float, str]
_ADDITIVE = ("scale_error", "unaligned_share")


def compared_value(row: Mapping[str, Any] | None, key: str) -> float | None:
    """What x is the mean of; None where a row has no such figure."""
    value = figure(row, key) if row else None
    return value if value is None or key in _ADDITIVE else float(np.log(max(value, 1e-9)))


def _judge(
    row: str,
    key: str,
    values: Sequence[Mapping[_Place, float | None]],
    spread: Spread,
    tail: float,
    rng: np.random.Generator,
) -> Judged | None:
    first, second = ({p: v for p, v in of.items() if v is not None} for of in values)
    both = [place for place in first if place in second]
    if not both:
        return None
    scenes = list(dict.fromkeys(scene for scene, *_ in both))
    of_scene = [[p for p in both if p[0] == scene] for scene in scenes]
    x_a = np.array([np.mean([first[p] for p in places]) for places in of_scene])
    x_b = np.array([np.mean([second[p] for p in places]) for places in of_scene])
    draws = bootstrapped_mean(x_b - x_a, spread.deviation[key], spread.scenes, rng)
    interval = np.quantile(draws, [tail, 1 - tail])
    means = np.array([x_a.mean(), x_b.mean(), x_b.mean() - x_a.mean(), *interval])
    a, b, change, low, high = (float(v) for v in (means if key in _ADDITIVE else np.exp(means)))
    alone = len(first) - len(both), len(second) - len(both)
    kind: Literal["ratio", "difference"] = "difference" if key in _ADDITIVE else "ratio"
    return Judged(row, key, kind, a, b, change, low, high, len(scenes), *alone)


def bootstrapped_mean(
    d: np.ndarray, spread: float, weight: int, rng: np.random.Generator, draws: int = DRAWS
) -> np.ndarray:
    """Draws (draws,) of the mean of d (n,) over scenes, as the module's docstring has it."""
    n, freedom = len(d), weight + len(d) - 1
    moderated = (weight * spread**2 + ((d - d.mean()) ** 2).sum()) / freedom
    drawn = d[rng.integers(n, size=(draws, n))].mean(1)
    missing = moderated * freedom / rng.chisquare(freedom, draws) - d.var()
    result: np.ndarray = drawn + np.sqrt(np.maximum(missing, 0) / n) * rng.standard_normal(draws)
    return result


def _changed(a: Mapping[str, Any], b: Mapping[str, Any], above: str = "") -> dict[str, tuple[Any, Any]]:
    """Settings by dotted name that differ, but for the seeds."""
    found: dict[str, tuple[Any, Any]] = {}
    for key in dict.fromkeys((*a, *b)):
        one, other = a.get(key), b.get(key)
        if isinstance(one, Mapping) and isinstance(other, Mapping):
            found |= _changed(one, other, f"{above}{key}.")
        elif one != other and key != "first_seed":
            found[above + key] = (one, other)
    return found
