"""What the paper's recipe adds to the paper: said, and taken away by the values that it names."""

from __future__ import annotations

import json
from dataclasses import fields, replace

from colons import colon, sequence, slam, truth

from densify.additions import additions, said
from densify.alignment import AlignmentConfig
from densify.config import DensifyConfig
from densify.densified import Densified
from densify.judging.config import JudgeConfig
from densify.page import Gallery
from densify.pipeline import densify
from lightdepth.reporting.run import run_folder

PAPER = DensifyConfig(recipe="paper", judge=JudgeConfig(on=False))


def opened(config: DensifyConfig) -> DensifyConfig:
    """The settings with everything that is added to the paper at the value at which it does nothing."""
    for added in additions(config):
        group, name = added.setting.split(".")
        config = replace(config, **{group: replace(getattr(config, group), **{name: added.nothing})})
    return config


def test_every_gate_and_the_reach_are_said_with_their_value_until_they_are_opened():
    found = {added.setting: added for added in additions(PAPER)}
    gates = {f"alignment.{f.name}" for f in fields(AlignmentConfig) if f.name.startswith(("min_", "max_"))}
    assert set(found) == gates | {"fusion.far"}
    for added in found.values():
        group, name = added.setting.split(".")
        assert added.value == getattr(getattr(PAPER, group), name) != added.nothing
        assert f"--{added.setting.replace('_', '-')} " in said((added,))
    assert additions(opened(PAPER)) == () and "nothing added" in said(())
    assert additions(DensifyConfig()) == ()


def test_opened_gates_and_reach_leave_no_keyframe_and_no_distance_out():
    frames = colon(0).frames
    (submap,) = slam(frames).map.submaps
    k = submap.keyframes[0]
    few = replace(submap, keyframes=(replace(k, pixels=k.pixels[:5], point_ids=k.point_ids[:5]), *submap.keyframes[1:]))
    whole = replace(slam(frames).map, submaps=(few,))
    kept, open_ = (densify(sequence(frames), whole, truth, config)[0].dense for config in (PAPER, opened(PAPER)))
    assert not kept.alignments[0].ok and all(a.ok for a in open_.alignments)
    reach = [abs(d.vertices - d.submap.keyframes[-1].center).max() for d in (kept, open_)]
    assert reach[1] > reach[0]


def test_report_log_and_record_say_what_was_added(tmp_path, capsys):
    frames = colon(0).frames
    found = slam(frames).map
    results = densify(sequence(frames), found, truth, PAPER)
    for recipe in ("paper", "full"):
        work = Densified("truth", results, Gallery(found), config=replace(PAPER, recipe=recipe))
        with run_folder(tmp_path / recipe, "densify", {}) as run:
            work.write(run, ("ply",), None)
        record = json.loads((tmp_path / recipe / "run.json").read_text())
        told = any("--fusion.far" in note for note in work.notes("of", sequence(frames), None))
        assert told is ("recipe" in record) is ("--fusion.far" in capsys.readouterr().out) is (recipe == "paper")
        if recipe == "paper":
            far = next(added for added in record["recipe"]["adds"] if added["setting"] == "fusion.far")
            assert far["value"] == 2.0 and "2 times" in far["sentence"] and len(record["recipe"]["adds"]) == 8
