"""The built-in benchmark: its scenes, its files, and what it says of two runs."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pages import check_self_contained
from raising import refused

from densify.bench import verdict
from densify.bench.record import COLUMNS, read_bench
from densify.bench.scenes import SUITE_VERSION, Scene, render, render_moving, scenes
from densify.bench.verdict import bootstrapped_mean, compare
from densify.bench.work import BenchConfig
from densify.commands import bench as command
from densify.commands.bench import bench
from lightdepth.tube import ShapeConfig, TubeConfig
from lightdepth.tube.breathing import BreathingConfig

TINY = Scene("tiny", 0, 40, 5, travel_mm=8.0)
FIGURES = {"rms_mm": 3.0, "median_mm": 1.5, "depth_abs_rel": 0.08, "scale_error": 0.02}
COUNTS = {"keyframes": 10, "keyframes_aligned": 10}


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """A run of the whole verb on one tiny colon."""
    folder = tmp_path_factory.mktemp("bench") / "out"
    with pytest.MonkeyPatch.context() as patch:
        small = TubeConfig(ShapeConfig(length=90.0, step=1.2))
        patch.setattr(Scene, "colon", small)
        patch.setattr(command, "scenes", lambda size, first: [replace(TINY, seed=first)])
        arguments = [
            "--image_size",
            "[64, 52]",
            "--checkpoints",
            "[decline]",
            "--wrong-shares",
            "[0.0, 0.3]",
            "--cases",
            "[loop, breath 5]",
        ]
        assert bench(["-o", str(folder), *arguments, "--first-seed", "311"]) == 0
    return folder


def test_a_run_has_every_row_for_every_share_with_units_and_versions(made):
    found = json.loads((made / "bench.json").read_text())
    assert found["kind"] == "bench" and found["suite_version"] == SUITE_VERSION and found["versions"]["numpy"]
    assert "mm" in found["unit"] and "Sim(3)" in found["alignment"] and found["config"]["first_seed"] == 311
    places = [(c["scene"], c["seed"], c["wrong_share"]) for c in found["cells"]]
    assert places == [("tiny", 311, 0.0), ("tiny", 311, 0.3), *2 * [("tiny", 311, 0.03)]]
    for cell in found["cells"][:2]:
        assert list(cell["rows"]) == ["sparse map", "sparse inliers", "decline, paper", "decline, full"]
        assert cell["frames"] == 40 and cell["trajectory"]["keyframes"] == 5 and cell["trajectory"]["rms_ate_mm"] < 0.2
        dense = cell["rows"]["decline, full"]
        assert 0 < dense["median_mm"] <= dense["rms_mm"] < 10 and dense["keyframes_aligned"] == 5
        assert 0 <= dense["scale_error"] < 0.3 and 0 < dense["depth_abs_rel"] < 0.3
    clean, dirty, *erring = (c["rows"] for c in found["cells"])
    assert dirty["sparse map"]["rms_mm"] > 10 * clean["sparse map"]["rms_mm"]
    assert dirty["sparse inliers"]["rms_mm"] < 0.2 * dirty["sparse map"]["rms_mm"]
    assert [c["case"] for c in found["cells"][2:]] == ["loop", "breath 5"]
    for rows in erring:
        assert list(rows) == ["sparse map", "decline, one scale", "decline, full"]
        assert 0 < rows["decline, one scale"]["rms_mm"] < 20
    assert (made / "bench.png").stat().st_size > 10_000
    assert check_self_contained(made / "report.html").tags.count("table") == 1 + len(found["cells"])
    table = (made / "bench.md").read_text()
    assert "30% wrong points." in table and all(title in table for title in COLUMNS.values()) and "tiny (311)" in table


def test_dense_rows_have_their_error_by_distance_and_those_that_tell_vertices_apart_a_front(made):
    for cell in json.loads((made / "bench.json").read_text())["cells"]:
        for name, row in cell["rows"].items():
            assert ("bands" in row) == ("decline" in name) and ("front" in row) == (
                name != "decline, paper" and "bands" in row
            )
            for by in ("expected error", "views") if "front" in row else ():
                kept = [point for point in row["front"] if point["by"] == by]
                shares = [point["kept_share"] for point in kept]
                assert shares[0] == 1 and shares == sorted(shares, reverse=True)
                assert kept[0]["median_mm"] == pytest.approx(row["median_mm"])
                assert kept[0]["precision_2mm"] == pytest.approx(row["precision"]["2mm"])
                recalls = [point["recall_2mm"] for point in kept]
                assert recalls == sorted(recalls, reverse=True)
            if "bands" in row:
                pixels = np.array([band["pixels"] for band in row["bands"]])
                errors = np.array([band["abs_rel"] for band in row["bands"]])
                assert (pixels * errors).sum() / pixels.sum() == pytest.approx(row["depth_abs_rel"], rel=0.15)


def test_a_wall_that_moves_is_seen_from_the_same_places_and_judged_as_it_is_at_rest(monkeypatch):
    monkeypatch.setattr(Scene, "colon", TubeConfig(ShapeConfig(length=90.0, step=1.2)))
    still = render(replace(TINY, frames=201), (64, 52))
    moving = render_moving(still, BreathingConfig(0.1, period=3.0))
    assert moving.truth is still.truth and moving.breathing is not None
    for one, other in zip(still.frames, moving.frames, strict=True):
        np.testing.assert_array_equal(one.true_world_from_cam, other.true_world_from_cam)
        assert one.time == other.time
    share = [f.true_distance.mean() / g.true_distance.mean() for f, g in zip(moving.frames, still.frames, strict=True)]
    assert share == pytest.approx([1.0, 1.1, 1.0, 0.9, 1.0], abs=0.03)  # one whole breath of 4 s


def test_a_run_compared_with_itself_is_within_noise(made, capsys, tmp_path):
    assert bench(["compare", str(made), str(made / "bench.json"), "-o", str(tmp_path / "c.json")]) == 0
    assert "B is within noise." in capsys.readouterr().out
    found = json.loads((tmp_path / "c.json").read_text())
    assert found["verdict"] == "within noise" and found["paired"] and len(found["judged"]) == 30
    assert {j["row"] for j in found["judged"]} >= {"decline, full", "decline, full (loop)", "decline, one scale (loop)"}
    for j in found["judged"]:
        none = 1 if j["change_is"] == "ratio" else 0
        assert j["change"] == none and j["low"] < none < j["high"]


def test_scenes_of_a_seed_are_the_same_and_their_names_are_not_those_of_other_sizes():
    full, small = scenes("full", 400), scenes("small", 400)
    assert len(full) == 9 and len({s.seed for s in full}) == 9 and [s.seed for s in small] == [400, 401]
    assert {s.name for s in small} < {s.name for s in full}
    assert [s.keyframes for s in full[:8]] == [16, 7, 14, 21, 24, 15, 11, 42]  # the paper's table 1
    assert full[8].maps == 19 and full[8].frames == 5015


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"wrong_shares": (0.1, 1.0)}, "each number of at least 0 and below 1"),
        ({"wrong_shares": (0.1, 0.1)}, "none twice"),
        ({"recipes": ()}, "at least one"),
        ({"cases": ("side", "side")}, "none twice"),
        ({"image_size": (8, 8)}, "each number from 32"),
        ({"first_seed": -1}, "a number of at least 0"),
    ],
)
def test_what_cannot_be_measured_is_refused_before_anything_is_rendered(changes, message):
    with refused(message):
        BenchConfig(**changes)


# Two runs


def written(folder: Path, factor=1.0, first_seed=400, rows=("net, full", "net, paper"), count=2, noise=0.0, **changes):
    """A fabricated bench.json. `factor` and `noise` (deviation of the log over scenes) change the first row."""
    rng = np.random.default_rng(first_seed)
    cells = []
    for i in range(count):
        shift = float(np.exp(noise * rng.standard_normal()))
        figures = {
            row: {k: v * (factor * shift if row == rows[0] else 1) for k, v in FIGURES.items()} | COUNTS for row in rows
        }
        for share in (0.1, 0.45):
            cells.append({"scene": f"short{i}", "seed": first_seed + i, "wrong_share": share, "rows": figures})
    config = {"size": "small", "image_size": [160, 128], "screening_share": 0.3, "first_seed": first_seed}
    config["densify"] = {"alignment": {"estimator": "lmeds"}}
    data = {"kind": "bench", "suite_version": SUITE_VERSION, "config": config, "cells": cells, **changes}
    folder.mkdir(exist_ok=True)
    (folder / "bench.json").write_text(json.dumps(data))
    return folder


def compared(a: Path, b: Path):
    return compare(read_bench(a), read_bench(b))


def test_the_verdict_names_the_row_that_changed_and_its_direction(tmp_path):
    a = written(tmp_path / "a")
    worse, better = written(tmp_path / "w", 4.0), written(tmp_path / "b", 0.25)
    found = compared(a, worse)
    assert found.paired and found.verdict == "worse"
    assert found.of_row("net, full") == "worse" and found.of_row("net, paper") == "within noise"
    first = found.judged[0]
    assert first.change == pytest.approx(4) and 1 < first.low < 4 < first.high
    scale = next(j for j in found.judged if j.figure == "scale_error")
    assert (scale.a, scale.b, scale.change) == pytest.approx((0.02, 0.08, 0.06)) and scale.shown()[0] == "+6.0 points"
    assert compared(a, better).verdict == "better" and compared(worse, a).verdict == "better"


def test_a_row_that_got_worse_outweighs_one_that_got_better(tmp_path):
    data = json.loads((written(tmp_path / "a", 0.25) / "bench.json").read_text())
    for cell in data["cells"]:
        cell["rows"]["net, paper"] = {k: 4 * v for k, v in FIGURES.items()}
    (tmp_path / "a" / "bench.json").write_text(json.dumps(data))
    found = compared(written(tmp_path / "o"), tmp_path / "a")
    assert (found.of_row("net, full"), found.of_row("net, paper"), found.verdict) == ("better", "worse", "worse")


def test_the_same_difference_on_other_colons_proves_less(tmp_path):
    a, same, other = written(tmp_path / "a"), written(tmp_path / "s", 1.8), written(tmp_path / "o", 1.8, first_seed=410)
    paired, unpaired = compared(a, same), compared(a, other)
    assert paired.paired and not unpaired.paired
    width = [j.high / j.low for j in (paired.judged[0], unpaired.judged[0])]
    assert width[1] > width[0] and unpaired.verdict == "within noise"


def test_more_scenes_make_the_interval_narrower(tmp_path):
    few = compared(written(tmp_path / "a"), written(tmp_path / "b", 1.2)).judged[0]
    many = compared(written(tmp_path / "c", count=9), written(tmp_path / "d", 1.2, count=9)).judged[0]
    assert np.log(many.high / many.low) < 0.4 * np.log(few.high / few.low) and (few.scenes, many.scenes) == (2, 9)


def test_the_interval_covers_as_often_as_it_says():
    """Of the mean of normal differences whose deviation is the one expected: 95 % within 2.5 points, whatever n."""
    rng = np.random.default_rng(0)
    for n in (2, 9):
        inside = 0
        for _ in range(500):
            draws = bootstrapped_mean(rng.normal(0.3, 0.5, n), 0.5, 20, rng, 1000)
            low, high = np.quantile(draws, [0.025, 0.975])
            inside += low < 0.3 < high
        assert inside / 500 == pytest.approx(0.95, abs=0.025)


def test_a_spread_larger_than_expected_widens_the_interval():
    rng = np.random.default_rng(0)
    calm = bootstrapped_mean(np.zeros(8), 0.1, 4, rng).std()
    wild = bootstrapped_mean(np.tile([-1.0, 1.0], 4), 0.1, 4, rng).std()
    assert wild > 3 * calm


def test_cases_are_rows_of_their_own_and_a_run_without_them_can_still_be_compared(tmp_path):
    a, b = written(tmp_path / "a"), written(tmp_path / "b")
    for folder, factor in ((a, 1), (b, 4)):
        data = json.loads((folder / "bench.json").read_text())
        figures = {"net, full": {k: v * factor for k, v in FIGURES.items()} | COUNTS}
        for i in range(2):
            data["cells"].append(
                {"scene": f"short{i}", "seed": 400 + i, "wrong_share": 0.03, "case": "side", "rows": figures}
            )
        (folder / "bench.json").write_text(json.dumps(data))
    found = compared(a, b)
    assert found.of_row("net, full (side)") == "worse" and found.of_row("net, full") == "within noise"
    without = compared(written(tmp_path / "old"), b)
    assert without.unmatched == ("net, full (side)",) and without.verdict == "within noise"


def test_cells_without_figures_are_left_out_and_said(tmp_path):
    a, b = written(tmp_path / "a"), written(tmp_path / "b")
    data = json.loads((b / "bench.json").read_text())
    data["cells"][0]["rows"]["net, full"] = {"error": "no keyframe was aligned", **COUNTS, "keyframes_aligned": 0}
    (b / "bench.json").write_text(json.dumps(data))
    found = compared(a, b)
    assert found.judged[0].only_a == 1 and "1 cells have figures in A alone" in found.markdown("A", "B")


def test_a_row_that_no_longer_aligns_anything_is_worse_though_it_has_no_errors_left(tmp_path):
    a, b = written(tmp_path / "a"), written(tmp_path / "b")
    data = json.loads((b / "bench.json").read_text())
    for cell in data["cells"]:
        cell["rows"]["net, full"] = {"error": "no keyframe was aligned", **COUNTS, "keyframes_aligned": 0}
    (b / "bench.json").write_text(json.dumps(data))
    found = compared(a, b)
    assert [j.figure for j in found.judged if j.row == "net, full"] == ["unaligned_share"]
    assert found.of_row("net, full") == found.verdict == "worse" and compared(b, a).verdict == "better"


def test_settings_that_differ_are_named(tmp_path):
    a = written(tmp_path / "a")
    data = json.loads((a / "bench.json").read_text())
    data["config"]["densify"]["alignment"]["estimator"] = "median"
    b = written(tmp_path / "b", config=data["config"])
    assert compared(a, b).changed == {"densify.alignment.estimator": ("lmeds", "median")}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"suite_version": 0}, "suite version … 1 in A, 0 in B"),
        ({"config": {"size": "full"}}, "size … small in A, full in B"),
        ({"rows": ("other, full",)}, "none is in both … A has net, full; net, paper; B has other, full"),
        ({"count": 3}, "B … short2 at 10% wrong points"),
        ({"first_seed": 401, "count": 2}, "none"),
    ],
)
def test_runs_of_other_work_are_refused(tmp_path, changes, message):
    a, b = written(tmp_path / "a"), written(tmp_path / "b", **changes)
    if message == "none":  # seeds 400, 401 against 401, 402: none is the same for the same scene
        assert not compared(a, b).paired
        return
    with refused(message):
        compared(a, b)


def test_seeds_that_are_the_same_in_part_are_refused(tmp_path):
    a, b = written(tmp_path / "a"), written(tmp_path / "b")
    data = json.loads((b / "bench.json").read_text())
    for cell in data["cells"][2:]:
        cell["seed"] = 900
    (b / "bench.json").write_text(json.dumps(data))
    with refused(found="1 of 2 scenes have the same seed"):
        compared(a, b)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "cannot be read"),
        ("{", "not valid JSON"),
        ("[1]", "not a result of lightdepth bench"),
        ('{"kind": "depth"}', "not a result of lightdepth bench"),
        ('{"kind": "bench", "suite_version": 1, "config": {}}', "cells missing"),
        ('{"kind": "bench", "suite_version": 1, "config": {}, "cells": []}', "cells"),
    ],
)
def test_files_that_are_no_bench_json_are_named(tmp_path, text, message):
    if text is not None:
        (tmp_path / "bench.json").write_text(text)
    with refused(where="bench.json", found=message):
        read_bench(tmp_path)


@pytest.mark.parametrize("value", ["NaN", "Infinity", "0", '"x"', "null"])
def test_a_figure_that_is_no_distance_is_refused_with_its_place(tmp_path, value):
    text = (written(tmp_path / "a") / "bench.json").read_text().replace('"rms_mm": 3.0', f'"rms_mm": {value}', 1)
    (tmp_path / "a" / "bench.json").write_text(text)
    with refused(found="short0 at 10% wrong points, row 'net, full': rms_mm is", cure="above 0"):
        read_bench(tmp_path / "a")


@pytest.mark.parametrize("change", [("depth_abs_rel", "0.08", "NaN"), ("keyframes_aligned", "10", "-1")])
def test_shares_and_counts_must_be_numbers_too(tmp_path, change):
    key, was, now = change
    text = (written(tmp_path / "a") / "bench.json").read_text().replace(f'"{key}": {was}', f'"{key}": {now}', 1)
    (tmp_path / "a" / "bench.json").write_text(text)
    with refused(f"{key} is … a number of at least 0"):
        read_bench(tmp_path / "a")


def test_the_spreads_know_the_same_figures():
    assert set(verdict.SAME_COLONS.deviation) == set(verdict.OTHER_COLONS.deviation) <= set(COLUMNS)
