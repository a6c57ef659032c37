"""How much faster the exact LMedS is than trying every proposal, as ratios of times taken side by side in one run.

Run by `make bench`, or `pytest tests/benchmarks -o python_files='bench_*.py'`. Nothing here belongs to the test suite.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import pytest

from lightdepth.robust import lmeds_scale

AT_LEAST = {1000: 8.0, 3000: 15.0}
"""Least ratio to the loop with np.partition, by number of points."""
PROBLEMS, ROUNDS = 10, 4
"""The exact search draws its proposals at random: one problem may take it 5 draws, another 13. So many are averaged."""


def problem(n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Mapped and predicted distances, 30 % of them wrong, 3 % noise."""
    rng = np.random.default_rng([n, seed])
    predicted = rng.uniform(15, 100, n)
    mapped = 2.5 * predicted * np.exp(0.03 * rng.normal(size=n))
    wrong = rng.permutation(n)[: 3 * n // 10]
    mapped[wrong] = 2.5 * rng.uniform(5, 300, len(wrong))
    return mapped, predicted


def loop_with_partition(mapped: np.ndarray, predicted: np.ndarray) -> float:
    """The least lower median over all proposals, one by one: the same objective."""
    n, best = len(mapped), np.inf
    for scale in mapped / predicted:
        residuals = np.abs(mapped - scale * predicted)
        best = min(best, np.partition(residuals, (n - 2) // 2 + 1)[(n - 2) // 2 + 1])
    return float(best)


def loop_with_median(mapped: np.ndarray, predicted: np.ndarray) -> float:
    """The same with np.median, as one would write it first (the mean of the middle two where there are two)."""
    return float(min(np.median(np.abs(mapped - scale * predicted)) for scale in mapped / predicted))


def milliseconds(functions: list[Callable], problems: list[tuple]) -> np.ndarray:
    """Time of each function, mean over problems of the least of some rounds.

    The functions take turns, so that a busy machine slows them alike.
    """
    taken = np.zeros((ROUNDS, len(problems), len(functions)))
    for index in np.ndindex(taken.shape):
        start = time.perf_counter()
        functions[index[2]](*problems[index[1]])
        taken[index] = 1000 * (time.perf_counter() - start)
    return taken.min(0).mean(0)


@pytest.mark.parametrize("n", AT_LEAST)
def test_exact_lmeds_beats_the_loops_over_all_proposals(n, benchmark, capsys):
    problems = [problem(n, seed) for seed in range(PROBLEMS)]
    found = benchmark(lambda: [lmeds_scale(*each) for each in problems])
    assert found[0].median == pytest.approx(loop_with_partition(*problems[0]), rel=1e-9)
    exact, partition, median = milliseconds([lmeds_scale, loop_with_partition, loop_with_median], problems)
    with capsys.disabled():
        print(f"\nLMedS, n = {n}, {PROBLEMS} problems     time [ms]   exact is faster by")
        print(f"  lmeds_scale (exact)            {exact:9.2f}")
        print(
            f"  loop with np.partition         {partition:9.2f}   {partition / exact:6.1f}x  (gate {AT_LEAST[n]:.0f}x)"
        )
        print(f"  loop with np.median            {median:9.2f}   {median / exact:6.1f}x")
    assert partition / exact >= AT_LEAST[n]
