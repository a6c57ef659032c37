"""batch: many sequences, each done once, whoever does it and however it is stopped; one table of all."""

from __future__ import annotations

import csv
import errno
import json
import os
import re
import shutil
from pathlib import Path

import pytest
from sequences import batch, called, killed_after, made_sequences, quick_run, read_table, stamps, table
from test_names import telling

import densify.batch.make
from densify.batch import work
from densify.batch.make import Maker
from lightdepth.errors import InputError, Interrupted
from lightdepth.files.lock import locked
from lightdepth.reporting.run import recorded, run_folder

CANARY = "MUSTERMANN_Erika"


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    """A folder of four sequences, of which a patient's name is all that tells one."""
    folder = tmp_path_factory.mktemp("batch") / "data"
    made_sequences(folder, 4, CANARY + "_{:02d}")
    return folder


@pytest.fixture(scope="module", autouse=True)
def quick():
    """Surfaces take seconds each, and are what other tests are of."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(densify.batch.make, "dense_run", quick_run)
        yield


@pytest.fixture(scope="module")
def whole(data, tmp_path_factory) -> Path:
    """The output of a batch that nothing stopped."""
    output = tmp_path_factory.mktemp("whole") / "out"
    assert batch(data, output) == 0
    return output


def test_every_sequence_has_a_run_and_a_line_in_the_table(data, whole):
    lines = read_table(whole)
    assert [line["state"] for line in lines] == ["done"] * 4
    assert [line["frames"] for line in lines] == [4, 5, 6, 4]
    for line in lines:
        run = json.loads((whole / "sequences" / line["sequence"] / "run.json").read_text())
        assert run["verb"] == "densify" and run["maps"][0]["vertices"] == line["vertices"] > 20
        assert line["submaps"] == 1 and line["aligned"] == line["keyframes"] == line["frames"]
        assert run["seconds"] == line["seconds"] and line["seen_well"] == 0.5
        assert (line["verdict"], line["judged_off"]) == ("green", run["verdict"]["number"])
    with (whole / "table.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["sequence"] for row in rows] == [line["sequence"] for line in lines]
    assert {name: int(rows[1][name]) for name in ("frames", "vertices")} == {
        name: lines[1][name] for name in ("frames", "vertices")
    }
    page = (whole / "report.html").read_text(encoding="utf-8")
    assert (
        all(f"sequences/{line['sequence']}/report.html" in page for line in lines)
        and "4 sequences: 4 done; verdicts: 4 green" in page
    )
    record = json.loads((whole / "run.json").read_text())
    assert record["verb"] == "batch" and record["sequences"] == 4 and record["failures"] == []
    assert [path for path in whole.parent.iterdir()] == [whole]  # no lock is left


def test_no_file_but_inputs_json_names_a_sequence_by_its_path(data, whole):
    assert telling(whole) == []
    names = json.loads((whole / "inputs.json").read_text())
    paths = [names[line["sequence"]] for line in read_table(whole)]
    assert paths == [str(path) for path in sorted(data.iterdir())]
    assert (whole / "inputs.json").stat().st_mode & 0o777 == 0o600


def test_what_is_done_is_not_done_again_and_a_sequence_that_is_gone_is_redone_the_same(data, whole, tmp_path):
    output = tmp_path / "out"
    shutil.copytree(whole, output)
    before = stamps(output)
    assert batch(data, output) == 0 and stamps(output) == before
    gone = sorted(before)[1]
    shutil.rmtree(output / "sequences" / gone)
    (output / "run.json").unlink()
    assert batch(data, output) == 0
    assert {name for name, at in stamps(output).items() if at != before.get(name)} == {gone}
    assert table(output) == table(whole) and (output / "run.json").is_file()


def test_shares_of_one_manifest_go_to_one_output_and_make_the_table_of_the_whole(data, whole, tmp_path, capsys):
    output = tmp_path / "out"
    assert batch(data, output, "--shard", "2/2") == 0
    half = [line["state"] for line in read_table(output)]
    assert sorted(half) == ["done", "done", "waiting", "waiting"] and not (output / "run.json").exists()
    assert "2 sequences of 4, 0 of them already made" in capsys.readouterr().err
    assert batch(data, output, "--shard", "1/2") == 0
    assert table(output) == table(whole) and (output / "run.json").is_file()


def test_one_sequence_that_fails_stops_no_other_and_is_tried_again_by_the_next_run(data, whole, tmp_path, capsys):
    mine, output = tmp_path / CANARY / "data", tmp_path / "out"
    shutil.copytree(data, mine)
    broken = sorted(mine.iterdir())[2]
    kept = broken.with_name("kept")
    (broken / "slam").rename(tmp_path / "slam")
    assert batch(mine, output) == 4
    said = capsys.readouterr().err
    lines = read_table(output)
    failed = [line for line in lines if line["state"] == "failed"]
    assert len(failed) == 1 and failed[0]["error"] and failed[0]["verdict"] is None
    assert f"1 sequence of 4 failed: {failed[0]['sequence']}: " in said and "Traceback" not in said
    assert [line for line in table(output) if line["state"] == "done"] == [
        line for line in table(whole) if line["sequence"] != failed[0]["sequence"]
    ]
    record = json.loads((output / "run.json").read_text())
    assert [failure["what"] for failure in record["failures"]] == [failed[0]["sequence"]]
    assert telling(output) == []
    before = stamps(output)
    assert batch(mine, output) == 4 and stamps(output) == before  # it fails again, and nothing else is touched
    (tmp_path / "slam").rename(broken / "slam")
    assert batch(mine, output) == 0 and not kept.exists()
    assert table(output) == table(whole) and list((output / "failed").iterdir()) == []


def test_a_sequence_that_is_not_there_is_a_line_of_its_own_and_stops_nothing(data, tmp_path):
    first = sorted(data.iterdir())[0]
    (tmp_path / "list.csv").write_text(f"data\n{first}\nnowhere/{CANARY}\n")
    assert batch(tmp_path / "list.csv", tmp_path / "out") == 4
    done, missing = read_table(tmp_path / "out")
    assert done["state"] == "done" and missing["state"] == "failed" and missing["sequence"] == "row-0002"
    assert "does not exist" in missing["error"] and CANARY not in missing["error"] and missing["frames"] is None


@pytest.mark.parametrize(
    "spoilt",
    [
        {"verdict": ["green"], "maps": {"0": 1}, "failures": "none", "seconds": "long"},
        {"verdict": {"colour": ["green"], "number": {}}, "maps": [3, {"coverage": "all", "keyframes": "many"}]},
        {"verdict": {"colour": "mauve", "number": True}, "failures": [4], "seconds": float("inf")},
        {"maps": [{"coverage": {"well_share": "half"}, "vertices": float("nan")}]},
    ],
)
def test_a_run_json_that_somebody_wrote_to_costs_its_own_figures_and_no_other_line(data, whole, tmp_path, spoilt):
    output = tmp_path / "out"
    shutil.copytree(whole, output)
    name = sorted(stamps(output))[0]
    path = output / "sequences" / name / "run.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | spoilt))
    assert batch(data, output) == 0
    lines = {line["sequence"]: line for line in table(output)}
    mine = lines.pop(name)
    assert mine["state"] == "done" and mine["verdict"] == (None if "verdict" in spoilt else "green")
    assert (mine["vertices"] == 0) == ("maps" in spoilt) and json.dumps(mine, allow_nan=False)
    assert list(lines.values()) == [line for line in table(whole) if line["sequence"] != name]


def test_of_thousands_of_rows_that_are_not_there_ten_are_named_and_the_others_counted(data, tmp_path, capsys):
    first = sorted(data.iterdir())[0]
    (tmp_path / "list.csv").write_text("data\n" + "".join(f"nowhere/{i}\n" for i in range(25)) + f"{first}\n")
    assert batch(tmp_path / "list.csv", tmp_path / "out") == 4
    said = capsys.readouterr().err
    assert sum(": failed: " in line for line in said.splitlines()) == 10 and "/26 seq-" in said
    assert "15 more cannot be read: the table has them all" in said
    assert sum(line["state"] == "failed" for line in read_table(tmp_path / "out")) == 25


@pytest.mark.parametrize("where", ["sequence", "note", "table"])
def test_on_a_full_disk_it_is_said_that_the_same_command_goes_on(data, tmp_path, monkeypatch, capsys, where):
    """It has no --resume."""

    def halfway(asked, model, output, overwrite=False, resume=False):
        with run_folder(output, "densify", recorded(asked.source), overwrite, resume) as run:
            (run.folder / "a").write_text("a finished part")
            run.finish_part("a")
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "table.csv")

    monkeypatch.setattr(densify.batch.make, "dense_run", quick_run if where == "table" else halfway)
    if where != "sequence":
        monkeypatch.setattr(*((densify.batch.make, "write_whole") if where == "note" else (work, "write_table")), full)
    code = batch(data, tmp_path / "out", "--shard", "1/4")
    said = capsys.readouterr().err
    assert "--resume" not in said and "the disk is full" in said and "the same command goes on" in said
    assert code == (4 if where == "sequence" else 5)
    assert ("1 finished part is kept" in said) == (where == "sequence")
    assert ("Finished sequences are kept" in said) == (where != "sequence")


def test_a_fault_of_the_program_is_tried_twice_and_kept_with_its_trace(data, tmp_path, monkeypatch, capsys):
    real, tried = densify.batch.make.dense_run, []

    def faulty(asked, model, output, **given):
        tried.append(output.name)
        if len(set(tried)) == 1:
            raise KeyError(f"fault of {asked.source.data}")
        if tried.count(output.name) == 1:
            raise RuntimeError("a bad moment")
        real(asked, model, output, **given)

    monkeypatch.setattr(densify.batch.make, "dense_run", faulty)
    assert batch(data, tmp_path / "out", "--shard", "1/2") == 4
    assert len(tried) == 4 and len(set(tried)) == 2
    (note,) = (tmp_path / "out" / "failed").iterdir()
    said = json.loads(note.read_text())
    assert said["tries"] == 2 and said["error"].startswith("KeyError") and "faulty" in "".join(said["trace"])
    assert CANARY not in note.read_text()
    assert sorted(line["state"] for line in read_table(tmp_path / "out")) == ["done", "failed", "waiting", "waiting"]


def test_a_sequence_that_another_run_is_at_is_left_to_it(data, whole, tmp_path, capsys):
    output, name = tmp_path / "out", sorted(stamps(whole))[0]
    (output / "sequences").mkdir(parents=True)
    (output / "batch.json").write_text((whole / "batch.json").read_text())
    with locked(output / "sequences" / name):
        assert batch(data, output) == 0
        lines = {line["sequence"]: line for line in read_table(output)}
        assert lines[name]["state"] == "elsewhere" and "another run is writing to it" in lines[name]["error"]
        assert not (output / "run.json").exists() and len(stamps(output)) == 3
    assert batch(data, output) == 0
    assert table(output) == table(whole)


def test_a_signal_keeps_what_is_done_ends_with_its_number_and_the_next_run_ends_as_one_that_nothing_stopped(
    data, whole, tmp_path, monkeypatch
):
    real, begun = densify.batch.make.dense_run, []

    def stopped(asked, model, output, **given):
        begun.append(output.name)
        if len(begun) == 3:
            raise Interrupted(15)
        real(asked, model, output, **given)

    with monkeypatch.context() as patch:
        patch.setattr(densify.batch.make, "dense_run", stopped)
        assert batch(data, tmp_path / "out") == 128 + 15
    kept = stamps(tmp_path / "out")
    assert set(kept) == set(begun[:2])
    assert batch(data, tmp_path / "out") == 0
    assert {name: stamps(tmp_path / "out")[name] for name in kept} == kept
    assert table(tmp_path / "out") == table(whole)


def test_other_options_or_an_output_of_others_are_refused_before_any_work(data, whole, tmp_path, capsys):
    assert batch(data, whole, "--fusion.voxel", "2.0") == 3
    assert "--fusion.voxel" in capsys.readouterr().err
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.txt").write_text("years of work")
    assert batch(data, tmp_path / "out") == 3
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["thesis.txt"]
    assert batch(data / f"{CANARY}_00", tmp_path / "one") == 3 and not (tmp_path / "one").exists()
    assert "lightdepth densify" in capsys.readouterr().err


def test_a_table_gives_each_sequence_options_and_a_name_of_its_own(data, tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr(densify.batch.make, "dense_run", lambda *a, **g: made.append(a[0]) or quick_run(*a, **g))
    sequences = sorted(data.iterdir())
    rows = [
        ["data", "map", "mm-per-unit", "name", "light"],
        [sequences[0], sequences[0] / "slam", "3.5", "case-017", "gamma=2.2,mu=0"],
        [sequences[1], "", "", "", ""],
    ]
    text = "\ufeff" + "\r\n".join(";".join(map(str, row)) for row in rows)
    (tmp_path / "list.csv").write_text(text + "\r\n;;;;\r\n", encoding="utf-8")
    assert batch(tmp_path / "list.csv", tmp_path / "out") == 0
    called = read_table(tmp_path / "out")[0]["sequence"]
    assert re.fullmatch("case-017-[0-9a-f]{8}", called)
    runs = tmp_path / "out" / "sequences"
    first = json.loads((runs / called / "run.json").read_text())
    assert first["arguments"]["light"] == "gamma=2.2,mu=0"
    (other,) = (json.loads((p / "run.json").read_text()) for p in runs.iterdir() if p.name != called)
    assert other["arguments"]["light"] is None
    assert {(asked.files.mm_per_unit, asked.mapped.map) for asked in made} == {
        (3.5, sequences[0] / "slam"),
        (None, sequences[1] / "slam"),
    }


def test_settings_of_densify_in_a_file_serve_for_each_sequence(data, tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr(densify.batch.make, "dense_run", lambda *a, **g: made.append(a[0]) or quick_run(*a, **g))
    (tmp_path / "c.yaml").write_text("formats: [ply, obj]\nfusion: {voxels_per_distance: 30}\noutput: elsewhere\n")
    (tmp_path / "notes.txt").write_text("no sequence")
    shutil.copytree(data, tmp_path / "here" / "data")
    with pytest.warns(UserWarning, match="given with each run"):
        assert batch(f"{tmp_path}/*/*/*_0[01]", tmp_path / "out", "--config", tmp_path / "c.yaml") == 0
    assert [asked.config.fusion.voxels_per_distance for asked in made] == [30, 30]
    assert {asked.files.formats for asked in made} == {("ply", "obj")}


def test_copies_are_two_sequences_and_the_same_row_twice_is_one(data, tmp_path, capsys):
    first = sorted(data.iterdir())[0]
    shutil.copytree(first, tmp_path / "copy")
    (tmp_path / "list.csv").write_text(f"data\n{first}\ncopy\n{first}\n")
    assert batch(tmp_path / "list.csv", tmp_path / "out") == 0
    one, two = read_table(tmp_path / "out")
    assert two["sequence"] == f"{one['sequence']}-2" and one["vertices"] == two["vertices"]
    page = (tmp_path / "out" / "report.html").read_text()
    assert "The manifest repeats 1 row." in page
    warned = [line for line in capsys.readouterr().err.splitlines() if line.startswith("warning: ")]
    assert len(warned) == 1 and warned[0].startswith("warning: 1 sequence has the same frames as another one, ")
    assert str(first) not in warned[0]  # no terminal
    named = f"{one['sequence']} and {two['sequence']}."
    assert warned[0].endswith(f": {named[:-1]}")
    assert named in page and json.loads((tmp_path / "out" / "run.json").read_text())["warnings"][1].endswith(named)


def test_the_checkpoint_is_loaded_once_for_all_sequences_of_a_process(data, tmp_path, monkeypatch):
    loaded = []
    real = Maker.__call__
    monkeypatch.setattr(Maker, "__call__", lambda self: loaded.append(1) or real(self))
    assert batch(data, tmp_path / "out") == 0 and loaded == [1]


def test_nothing_that_is_wrong_with_a_row_is_found_after_the_first_sequence(data, tmp_path):
    first = sorted(data.iterdir())[0]
    for row in (
        "name\nx",
        "data,mapp\nx,y",
        f"data,mm_per_unit\n{first},-2",
        f"data,mm_per_unit\n{first},wide",
        "data",
    ):
        (tmp_path / "list.csv").write_text(f"{row}\n")
        assert batch(tmp_path / "list.csv", tmp_path / "out") == 3 and not (tmp_path / "out").exists()


def test_an_input_error_names_its_row(tmp_path):
    from densify.batch.manifest import read_manifest

    (tmp_path / "list.csv").write_text("data,trust_map\na,true\n\nb,perhaps\n")
    with pytest.raises(InputError) as caught:
        read_manifest(tmp_path / "list.csv", tmp_path / "out")
    assert "row 3" in caught.value.where and "trust_map" in caught.value.found


@pytest.mark.slow
def test_a_share_that_is_killed_and_resumed_beside_another_makes_the_table_of_one_run(data, tmp_path):
    many, count = tmp_path / "many", int(os.environ.get("SEQUENCES", 12))
    for number in range(count):
        shutil.copytree(sorted(data.iterdir())[number % 4], many / f"{CANARY}_{number:02d}")
    assert called(many, tmp_path / "whole", real=False)[0] == 0
    there = killed_after(count // 4, many, tmp_path / "out", "--shard", "1/2", real=False)
    kept = stamps(tmp_path / "out")
    assert count // 4 <= there < count // 2
    assert called(many, tmp_path / "out", "--shard", "2/2", real=False)[0] == 0
    assert len(stamps(tmp_path / "out")) == there + count // 2
    assert called(many, tmp_path / "out", "--shard", "1/2", real=False)[0] == 0
    assert {name: stamps(tmp_path / "out")[name] for name in kept} == kept
    assert table(tmp_path / "out") == table(tmp_path / "whole") and len(stamps(tmp_path / "out")) == count
    assert [path.name for path in (tmp_path / "out" / "sequences").glob(".*")] == []
