"""What densify writes where it asks the light for the millimetres of its maps."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from test_judging import known
from test_scale import LIGHT, dense_map, frames

from densify import densified
from densify.densified import Densified
from densify.page import Gallery
from densify.pipeline import SubmapResult
from densify.scale_file import MapScale, Scales
from lightdepth.cli import main
from lightdepth.photometry import PhotometricCalibration
from lightdepth.reporting.run import run_folder
from lightdepth.sparse_map import SparseMap


def densified_in(folder: Path, scales: Scales, monkeypatch) -> tuple[Densified, dict]:
    """Two spheres written as densify writes them where the light is asked."""
    monkeypatch.setattr(densified, "scales_of", lambda *_: scales)
    results = [SubmapResult(dense_map(i), None, 0.0, {}) for i in (0, 1)]
    maps = SparseMap(tuple(r.dense.submap for r in results), "maps")
    work = Densified("truth", results, Gallery(maps))
    with run_folder(folder, "densify", {}) as run:
        work.write(run, ("ply",), work.ask_light(run, frames(4), LIGHT, 30.0))
    return work, json.loads((folder / "run.json").read_text())


def test_densify_writes_millimetres_where_every_map_has_them_and_says_so(tmp_path, monkeypatch, capsys):
    scales = Scales((MapScale(0, 2.0, (1.6, 2.5), "the light"), MapScale(1, 3.0, (2.5, 3.6), "the light")))
    work, record = densified_in(tmp_path / "run", scales, monkeypatch)
    assert record["unit"] == "mm" and work.of_millimetres.endswith("nine of ten are within 25%")
    low = trimesh.load(tmp_path / "run" / "map_001" / "mesh.ply").bounds
    np.testing.assert_allclose(np.abs(low), 30.0, rtol=0.01)
    assert json.loads((tmp_path / "run" / "scale.json").read_text())["unit"] == "mm"
    assert "Millimetres, map 0: 2 mm per map unit" in " ".join(work.notes("x", frames(4), None))
    capsys.readouterr()
    argv = ["measure", str(tmp_path / "run"), "--map", "1", "--points", "[[0, 0, 30], [0, 30, 0]]"]
    assert main(argv) == 0 and "straight 42.4 mm (35.4 to 50.9)" in capsys.readouterr().out  # not scaled again


def test_where_one_map_is_refused_all_surfaces_stay_in_map_units(tmp_path, monkeypatch, capsys):
    scales = Scales((MapScale(0, 2.0, (1.6, 2.5), "the light"), MapScale(1, refused="it is dark", cure="more light")))
    work, record = densified_in(tmp_path / "run", scales, monkeypatch)
    assert record["unit"] == "map units"
    assert work.of_millimetres == "the surfaces are in map units, as the light does not tell every map's millimetres"
    why = "the light does not tell every map's millimetres; of map 1: it is dark; more light"
    assert work.without_millimetres == f"the surfaces are in map units: {why}"
    np.testing.assert_allclose(np.abs(trimesh.load(tmp_path / "run" / "map_000" / "mesh.ply").bounds), 10, rtol=0.01)
    said = capsys.readouterr().out
    assert "warning: map 1: no millimetres, it is dark; more light" in said


def test_the_verdict_says_that_surfaces_are_in_map_units_where_millimetres_were_asked_for():
    result = SubmapResult(dense_map(0), known(), 0.0, {})
    gallery = Gallery(SparseMap((result.dense.submap,), "maps"))
    asked = Densified(
        "truth", [result], gallery, scales=Scales((MapScale(0, refused="it is dark", cure="more light"),))
    )
    assert asked.verdict is not None
    for said in (asked.headline, asked.verdict.sentence):
        assert said.endswith("; the surfaces are in map units, as the light does not tell every map's millimetres")
    assert "map units" not in Densified("truth", [result], gallery).headline


@pytest.mark.parametrize(
    ("asked", "beside", "unit"),
    [(2.0, None, "mm"), ("light", None, "map units"), ("light", "mm", "mm"), ("light", "map units", "map units")],
)
def test_a_run_at_work_is_viewed_in_the_unit_that_its_surfaces_have(tmp_path, asked, beside, unit):
    pytest.importorskip("viser")
    from densify.viewing.known import _unit_meant

    if beside is not None:
        Scales((MapScale(0, 2.0, (1.0, 4.0)),)).write_file(tmp_path, beside, PhotometricCalibration())
    watched = SimpleNamespace(record={"arguments": {"mm_per_unit": asked}}, folder=tmp_path)
    assert _unit_meant(watched, None) == unit and _unit_meant(SimpleNamespace(record={}, folder=tmp_path), 2.0) == "mm"
