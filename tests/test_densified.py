"""What a densify run says of its surfaces besides writing them."""

from __future__ import annotations

import json
from contextlib import nullcontext
from dataclasses import replace

import pytest
from colons import colon, sequence, slam, truth

from densify.config import DensifyConfig
from densify.densified import Densified
from densify.judging.config import JudgeConfig
from densify.page import Gallery
from densify.pipeline import densify
from lightdepth.errors import PartialFailure
from lightdepth.reporting.run import run_folder


@pytest.mark.parametrize("few, fails", [((5, 2), True), ((3, 3), True), ((3, 2), False)])
def test_a_run_that_aligns_fewer_than_half_of_its_keyframes_is_written_and_is_4(tmp_path, few, fails):
    """Two submaps of five keyframes, of which so many observed too few points."""
    frames = colon(0).frames
    (submap,) = slam(frames).map.submaps

    def part(number: int, poor: int):
        keyframes = list(submap.keyframes[5 * number : 5 * number + 5])
        for i in range(poor):
            k = keyframes[i]
            keyframes[i] = replace(k, pixels=k.pixels[:7], point_ids=k.point_ids[:7])
        return replace(submap, id=number, keyframes=tuple(keyframes))

    whole = replace(slam(frames).map, submaps=tuple(part(i, n) for i, n in enumerate(few)))
    results = densify(sequence(frames), whole, truth, DensifyConfig(judge=JudgeConfig(on=False)))
    work = Densified("truth", results, Gallery(whole))
    said = pytest.raises(PartialFailure, match="failed, the first: ")
    with said if fails else nullcontext(), run_folder(tmp_path / "run", "densify", {}) as run:
        work.write(run, ("ply",), None)
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    assert (tmp_path / "run" / "map_001" / "mesh.ply").is_file()
    told = [f["reason"] for f in record["failures"] if f["what"] == "the alignment"]
    assert len(told) == fails
    assert not told or told[0].startswith(f"{10 - sum(few)} of 10 keyframes could be aligned, fewer than half")
