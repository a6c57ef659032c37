"""The model of cost: fitted to measured runs, found where `bench speed` wrote it, and asked by dry runs."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from raising import refused

from densify.bench.costs import bench_plan
from densify.bench.work import BenchConfig
from densify.costs import GIVEN, TABLE, Cost, WholeRun, fitted, known_cost, read_speed
from densify.speed.tables import priced, workloads


def run(size: tuple[int, int], keyframes: int, cost: Cost, predict: float = 0.0) -> WholeRun:
    """One that takes exactly what a cost says, and its prediction besides."""
    seconds = cost.of(keyframes, size[0] * size[1] / 1e6)
    steps = {"read": 0.0, "predict": predict, "judge": seconds / 2}
    return WholeRun(
        size=size, keyframes=keyframes, seconds=seconds + predict, processor=2 * seconds, bytes=5.0, steps=steps
    )


TRUE = Cost(2.0, 0.3, 1.5)
RUNS = [run((320, 256), 6, TRUE, 1.0), run((640, 512), 6, TRUE, 2.0), run((320, 256), 12, TRUE, 3.0)]


@pytest.fixture
def here(tmp_path, monkeypatch) -> Path:
    """An empty working folder, on the machine of the tables, twice as slow as it was when speeds were measured."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv(GIVEN, raising=False)
    monkeypatch.setattr("densify.costs.slowness", lambda: 2.0)
    return tmp_path


def written(file: Path, **changes: object) -> Path:
    file.parent.mkdir(parents=True, exist_ok=True)
    said = {"kind": "bench speed", "slowness": 1.0, "runs": [each.model_dump() for each in RUNS], "more": 1} | changes
    file.write_text(json.dumps(said), encoding="utf-8")
    return file


def test_three_runs_tell_what_a_run_a_keyframe_and_a_megapixel_take_besides_prediction():
    found = fitted(RUNS, lambda each: each.besides)
    assert (found.fixed, found.keyframe, found.megapixel) == pytest.approx((2.0, 0.3, 1.5))
    assert found.of(100, 2.0, runs=3) == pytest.approx(6 + 100 * 3.3)


def test_no_part_of_a_cost_is_below_nothing_where_runs_contradict_each_other():
    slow_and_small = [RUNS[0], run((640, 512), 6, Cost(0.1, 0.01, 0.0)), RUNS[2]]
    found = fitted(slow_and_small, lambda each: each.seconds)
    assert min(found.fixed, found.keyframe, found.megapixel) >= 0 and found.of(6, 0.1) > 0


def test_a_run_of_one_size_still_tells_what_its_keyframes_take():
    alone = [RUNS[0], RUNS[2]]
    found = fitted(alone, lambda each: each.besides)
    for each in alone:
        assert found.of(each.keyframes, each.megapixels) == pytest.approx(each.besides)


def test_without_a_file_the_table_is_asked_and_the_machine_s_slowness_counts(here):
    known = known_cost()
    assert known.cost == TABLE.times(2.0) and known.by == "by a table"


def test_a_file_is_found_where_bench_speed_writes_it_and_scaled_by_how_slow_the_machine_was(here):
    written(here / "runs" / "speed" / "speed.json", slowness=4.0)
    known = known_cost()
    assert known.cost.keyframe == pytest.approx(0.3 * 2 / 4) and known.by == "by runs/speed/speed.json"


def test_a_file_that_is_found_and_none_of_ours_is_left_alone(here):
    written(here / "runs" / "speed" / "speed.json", kind="bench")
    assert known_cost().by == "by a table"


def test_a_file_that_is_named_wins_and_is_refused_where_it_is_none(here, monkeypatch):
    written(here / "runs" / "speed" / "speed.json")
    other = written(here / "other.json", slowness=1.0)
    monkeypatch.setenv(GIVEN, str(other))
    assert known_cost().by == f"by {other}"
    other.write_text("{}")
    with refused(where=GIVEN, found="kind missing"):
        known_cost()


@pytest.mark.parametrize("runs", [[], [{**RUNS[0].model_dump(), "keyframes": 0}], [{"size": [320, 256]}]])
def test_a_file_without_runs_that_can_be_reckoned_with_is_refused(here, runs):
    with refused(where="speed.json"):
        read_speed(written(here / "speed.json", runs=runs))


@pytest.mark.parametrize(
    "spoilt",
    [
        {"slowness": 1e-320},
        {"runs": [RUNS[0].model_dump() | {"keyframes": 10**400}]},
        {"runs": [RUNS[0].model_dump() | {"size": [10**200, 10**200]}]},
        {"runs": [RUNS[0].model_dump() | {"seconds": 1e308}]},
    ],
)
def test_numbers_that_no_run_can_have_are_refused_and_spoil_no_dry_run(here, monkeypatch, spoilt):
    file = written(here / "runs" / "speed" / "speed.json", **spoilt)
    assert known_cost().by == "by a table"
    monkeypatch.setenv(GIVEN, str(file))
    with refused(where=GIVEN):
        known_cost()


def test_a_benchmark_s_plan_goes_with_the_measured_keyframe(here):
    _, work = bench_plan(BenchConfig())
    before = work()[0].seconds
    written(here / "runs" / "speed" / "speed.json")
    after = work()[0].seconds
    megapixels = 160 * 128 / 1e6
    assert before and after
    assert after / before == pytest.approx((0.3 + 1.5 * megapixels) / (TABLE.keyframe + TABLE.megapixel * megapixels))


def test_a_procedure_costs_what_its_keyframes_and_maps_do():
    one, year, _ = workloads()
    assert (one.keyframes, one.maps, one.size) == (475, 19, (1440, 1080))
    price = priced(one, RUNS)
    assert price.processor_hours == pytest.approx(2 * TRUE.of(475, 1440 * 1080 / 1e6, 19) / 3600)
    assert priced(year, RUNS).processor_hours == pytest.approx(1e4 * price.processor_hours)
