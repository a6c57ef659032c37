"""Keyframes that the gate for depth doubts are named by every verb, and left out of the surface where that is asked."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from colons import colon, sequence, slam, truth
from verbs import by_options

from densify.config import DensifyConfig, LiveConfig
from densify.densified import Densified
from densify.gating import LEFT_OUT, GateConfig
from densify.judging.config import JudgeConfig
from densify.live.play import play
from densify.page import Gallery
from densify.pipeline import densify, densify_submap
from lightdepth.commands.predict import predict
from lightdepth.datasets import write_folder
from lightdepth.frame import Frame
from lightdepth.models import ConstantModel
from lightdepth.reporting.run import run_folder

BAD = (2, 5, 6)


def hazy(count: int = 3) -> list[Frame]:
    """A colon's ten keyframes, the first `count` of BAD and those beyond seen through dense smoke."""
    which = [*BAD, 0, 1, 3][:count]
    return [
        replace(f, image=(0.5 + 0.02 * f.image).astype(np.float32)) if i in which else f
        for i, f in enumerate(colon(0).frames)
    ]


def config(on: bool, recipe: str = "full") -> DensifyConfig:
    return DensifyConfig(judge=JudgeConfig(on=False), gate=GateConfig(on=on), recipe=recipe)


def submap():
    (found,) = slam(colon(0).frames).map.submaps
    return found


def test_doubted_keyframes_are_left_out_with_the_reason_where_the_gate_is_on():
    result = densify_submap(submap(), sequence(hazy()), truth, config(on=True))
    left_out = {a.keyframe: a.reason for a in result.dense.alignments if not a.ok}
    assert [*left_out] == [*result.doubts] == [f"00000{i}.png" for i in BAD]
    assert all(reason.startswith(LEFT_OUT) and "smoke" in reason for reason in left_out.values())
    assert len(result.dense.aligned) == 7 and len(result.dense.triangles) > 1000


@pytest.mark.parametrize("on, recipe, count", [(False, "full", 3), (True, "paper", 3), (True, "full", 6)])
def test_they_stay_where_the_gate_is_off_in_the_papers_recipe_and_where_they_are_more_than_half(on, recipe, count):
    result = densify_submap(submap(), sequence(hazy(count)), truth, config(on, recipe))
    assert len(result.dense.aligned) == 10 and len(result.doubts) == count


def test_clear_keyframes_give_the_same_surface_with_the_gate_and_without():
    on, off = (densify_submap(submap(), sequence(colon(0).frames), truth, config(each)) for each in (True, False))
    assert on.doubts == {} and np.array_equal(on.dense.vertices, off.dense.vertices)


@pytest.mark.parametrize("on, out", [(True, 3), (False, 0)])
def test_a_run_of_densify_says_whose_depth_is_doubted_and_how_many_were_left_out(tmp_path, on, out):
    frames, found = sequence(hazy()), slam(colon(0).frames).map
    work = Densified("truth", densify(frames, found, truth, config(on)), Gallery(found), config=config(on))
    with run_folder(tmp_path / "run", "densify", {}) as run:
        work.write(run, ("ply",), None)
    record = json.loads((tmp_path / "run" / "run.json").read_text(encoding="utf-8"))
    assert list(record["maps"][0]["doubted"]) == [f"00000{i}.png" for i in BAD]
    said = (
        f"the depth of 3 of 10 frames is doubted, as they have too little contrast of light; the first, 00000{BAD[0]}"
    )
    log = (tmp_path / "run" / "log.txt").read_text(encoding="utf-8")
    assert said in log and f"({out} left out" in log
    assert any(said in note for note in work.notes("frames", frames, None))


def test_a_played_sequence_says_whose_depth_is_doubted():
    played = play(sequence(hazy()), slam(colon(0).frames).map, ConstantModel(), LiveConfig(), lambda done: None)
    assert [bool(p.doubt) for p in played] == [i in BAD for i in range(10)]


def test_predict_records_which_frames_are_doubted_and_why(tmp_path):
    write_folder(hazy(), tmp_path / "frames")
    by_options(predict)(tmp_path / "frames", tmp_path / "out", checkpoint="constant", previews=False)
    record = json.loads((tmp_path / "out" / "run.json").read_text(encoding="utf-8"))
    assert len(record["doubted"]) == 3 and all("smoke" in reason for reason in record["doubted"].values())
    assert any("3 of 10 frames is doubted" in each for each in record["warnings"])
