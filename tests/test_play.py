"""A sequence against the clock: every keyframe is accounted for, nothing of one submap is held for the next."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
from colons import colon, sequence, slam
from raising import refused
from test_live import setting
from verbs import by_options

from densify.commands.live import live as live_verb
from densify.config import DensifyConfig
from densify.fusion.volume import FusionConfig
from densify.judging.config import JudgeConfig
from densify.live.densifier import STEPS, StepTime
from densify.live.play import Played, play, time_spent, timings_picture, write_timings
from lightdepth.datasets import FrameSequence
from lightdepth.errors import InputError, PartialFailure
from lightdepth.frame import Frame
from lightdepth.models import DeclineModel
from lightdepth.tube.export import write_synthetic

live = by_options(live_verb)

DECLINE = DeclineModel(details=False)
COARSE = DensifyConfig(judge=JudgeConfig(on=False), fusion=FusionConfig(voxels_per_distance=15.0))


def one(wall_ms: dict[str, float], **changes) -> Played:
    times = {step: StepTime(ms / 1000, 2 * ms / 1000) for step, ms in wall_ms.items()}
    values = {"map": 0, "keyframe": "0", "arrival": 0.0, "done": 0.3, "renewed": 1, "patches": 1, "kept_bytes": 5}
    return Played(times=times, **{**values, **changes})


def test_maps_and_keyframes_come_in_the_order_of_the_recording():
    frames, found, _ = setting(maps=2, count=6)
    backward = replace(found.map, submaps=found.map.submaps[::-1])
    surfaces = []
    played = play(sequence(frames), backward, DECLINE, COARSE, lambda done: surfaces.append(done.dense))
    assert [p.map for p in played] == [0] * 3 + [1] * 5
    assert [d.submap.id for d in surfaces] == [0, 1] and all(len(d.triangles) for d in surfaces)
    assert all(set(p.times) == {"read", *STEPS} for p in played)
    assert all(p.done > p.arrival and p.renewed >= p.patches - played[i - 1].patches for i, p in enumerate(played) if i)
    assert played[3].kept_bytes < played[2].kept_bytes  # the first map's keyframes are no longer held


def test_a_frame_that_is_lost_or_broken_is_said_and_the_others_go_on():
    frames, found, config = setting(count=5)

    def load(i: int) -> Frame:
        if i == 2:
            raise InputError("000002", "not a readable image", "copy it again")
        return frames[i]

    broken = FrameSequence([f.name for f in frames[:4]], load, "the folder")
    surfaces = []
    played = play(broken, found.map, DECLINE, config, lambda done: surfaces.append(done.dense))
    assert {p.keyframe: p.reason for p in played if p.unread} == {
        "000002.png": "000002: not a readable image; copy it again",
        "000004.png": "the folder: no frame number 4; expected the frames that the map was made from",
    }
    assert len(surfaces[0].aligned) == 3 and len(surfaces[0].triangles)
    assert time_spent(played, 1e9).read == 3


def test_at_a_rate_no_keyframe_is_there_before_its_time_and_a_late_one_says_so():
    frames, found, config = setting(count=4)
    played = play(sequence(frames), found.map, DECLINE, config, lambda _: None, rate=2.0)
    assert [p.arrival for p in played] == [0, 0.5, 1.0, 1.5]
    assert all(p.done >= p.arrival + p.times["predict"].wall for p in played)
    with refused(where="rate", found="0", cure="keyframes per second"):
        play(sequence(frames), found.map, DECLINE, config, lambda _: None, rate=0)


def test_the_share_in_the_budget_counts_all_steps_and_waiting_only_where_it_is_asked_for():
    steps = {"read": 5.0, "predict": 100.0, "align": 5.0, "integrate": 30.0, "extract": 40.0}
    slow = {**steps, "extract": 100.0}
    played = [one(steps), one(steps, done=0.1), one(slow, done=0.1), one({"read": 1.0}, unread=True, reason="lost")]
    found = time_spent(played, 0.2)
    assert (found.keyframes, found.read) == (4, 3) and found.timings is not None
    figures = found.timings
    assert figures.share_in_budget == pytest.approx(2 / 3) and figures.share_in_time == pytest.approx(2 / 3)
    assert figures.without_network.median_ms == pytest.approx(80)
    assert figures.total.cpu_ms == pytest.approx(360)
    assert figures.steps["extract"].median_ms == pytest.approx(40)
    assert time_spent(played[3:], 0.2).record() == {"keyframes": 1, "read": 0}


def test_timings_are_written_a_row_a_keyframe_and_drawn(tmp_path):
    steps = {"read": 5.0, "predict": 100.0, "align": 5.0, "integrate": 30.0, "extract": 40.0}
    played = [one(steps), one(steps, map=1, reason="few, too few")]
    write_timings(played, tmp_path / "timings.csv")
    rows = list(csv.DictReader((tmp_path / "timings.csv").open()))
    assert [float(r["total_ms"]) for r in rows] == [180, 180] and float(rows[0]["cpu_predict_ms"]) == 200
    assert rows[1]["reason"] == "few, too few" and rows[1]["map"] == "1"
    picture = cv2.imdecode(np.frombuffer(timings_picture(played, 0.2), np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape[1] > picture.shape[0] > 100 and picture.std() > 10


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("live") / "data"
    frames = colon(0).frames[:6]
    write_synthetic(frames, slam(frames, maps=2, shared_keyframes=1), folder)
    return folder


def test_the_verb_writes_surfaces_timings_and_what_they_say(data, tmp_path, capsys):
    run = tmp_path / "run"
    coarse = FusionConfig(voxels_per_distance=15.0)
    live(data, run, map=data / "slam", checkpoint="decline", fit_light=False, budget_ms=1e6, fusion=coarse)
    names = {str(p.relative_to(run)) for p in run.rglob("*") if p.is_file()}
    assert {
        "timings.csv",
        "timings.png",
        "report.html",
        "run.json",
        "config.yaml",
        "map_000/mesh.ply",
        "map_001/keyframes.csv",
    } <= names
    record = json.loads((run / "run.json").read_text())
    assert record["timings"]["share_in_budget"] == 1 and record["timings"]["keyframes"] == 7
    assert set(record["timings"]["steps"]) == {"read", *STEPS}
    assert all(0 <= m["coverage"]["well_share"] <= 1 < m["coverage"]["area"] for m in record["maps"])
    told = capsys.readouterr().out
    assert "100% of 7 keyframes within 1e+06 ms" in told and f"verdict: {record['verdict']['colour']}" in told
    assert f"next: lightdepth view {run}\n" in told
    counts = [m["ahead"]["new_points"]["count"] for m in record["maps"]]
    rows = list(csv.DictReader((run / "timings.csv").open()))
    assert sum(counts) == sum(int(r["new_points"]) for r in rows) > 0
    page = (run / "report.html").read_text(encoding="utf-8")
    assert "Agreement with the map ahead" in page
    links = re.findall('href="([^"]+)"', page)
    assert {"map_001/mesh.ply", "run.json"} < set(links) and all((run / link).is_file() for link in links)
    (scene,) = re.findall(r'<script type="application/json">(.*?)</script>', page)
    shown = json.loads(scene)["surfaces"]
    assert [s["title"] for s in shown] == ["map 0", "map 1"] and all(s["triangles_made"] > 100 for s in shown)


def test_the_verb_names_lost_frames_and_refuses_settings_that_are_none(data, tmp_path):
    for setting_, message in (
        ({"rate": -1.0}, "--rate … -1"),
        ({"budget_ms": 0.0}, "--budget-ms … 0"),
    ):
        with refused(message):
            live(data, tmp_path / "x", map=data / "slam", checkpoint="decline", **setting_)
    assert not (tmp_path / "x").exists()
    images = sorted(p for p in data.rglob("*.png") if p.stem.isdigit() and "truth" not in p.parts)
    content = images[1].read_bytes()
    images[1].write_bytes(b"")
    try:
        with pytest.raises(PartialFailure, match="1 part"):
            live(data, tmp_path / "y", map=data / "slam", checkpoint="decline", fit_light=False)
    finally:
        images[1].write_bytes(content)
    assert (tmp_path / "y" / "map_000" / "mesh.ply").is_file()


def test_a_map_none_of_whose_keyframes_can_be_aligned_is_bad_input(data, tmp_path):
    from densify.alignment import AlignmentConfig

    with refused(where="the maps", found="no keyframe of any"):
        live(
            data,
            tmp_path / "z",
            map=data / "slam",
            checkpoint="decline",
            fit_light=False,
            alignment=AlignmentConfig(min_points=10**6),
        )
    assert not (tmp_path / "z").exists()


def test_a_screening_in_small_ends_with_a_surface_for_every_submap_and_memory_for_one_only():
    """Row 7's shape: submaps with tracking lost between them, frames that no map holds, one map too poor to align."""
    frames, found, _ = setting(maps=3, count=9, shared_keyframes=0)
    poor = found.map.submaps[1]
    few = [replace(k, pixels=k.pixels[:5], point_ids=k.point_ids[:5]) for k in poor.keyframes]
    submaps = (found.map.submaps[0], replace(poor, keyframes=tuple(few)), found.map.submaps[2])
    surfaces = []
    played = play(
        sequence(frames), replace(found.map, submaps=submaps), DECLINE, COARSE, lambda done: surfaces.append(done.dense)
    )
    assert len(played) == 9 and [len(d.triangles) > 0 for d in surfaces] == [True, False, True]
    assert all("at least 8" in p.reason for p in played[3:6])
    unpacked = frames[0].image.nbytes + frames[0].true_distance.nbytes
    assert all(0 < p.kept_bytes < 0.4 * unpacked * (i % 3 + 1) for i, p in enumerate(played))
