"""Inputs are called by names that tell nobody: no file of a run but inputs.json has their paths."""

from __future__ import annotations

import io
import json
import os
import stat
import zipfile
from pathlib import Path

import pytest
import yaml
from raising import refused

from lightdepth.cli import main
from lightdepth.errors import AlreadyFinished, InputError
from lightdepth.files.named_inputs import INPUTS, TOKEN
from lightdepth.reporting.names import names_of
from lightdepth.reporting.run import run_folder

CANARY = "MUSTERMANN_Erika_1957"


def telling(folder: Path, canary: str = CANARY) -> list[str]:
    """Files below a folder, but inputs.json, in whose bytes or whose packed members the canary stands."""
    found = []
    for path in sorted(p for p in folder.rglob("*") if p.is_file() and p.name != INPUTS):
        contents = path.read_bytes()
        if zipfile.is_zipfile(io.BytesIO(contents)):
            with zipfile.ZipFile(path) as packed:
                contents += b"".join(packed.read(name) for name in packed.namelist())
        if any(canary.lower().encode(code) in contents.lower() for code in ("utf-8", "utf-16-le", "utf-32-le")):
            found.append(str(path.relative_to(folder)))
    return found


@pytest.fixture(scope="module")
def patient(tmp_path_factory) -> Path:
    """A folder of the patient's name, with frames and a map in it."""
    folder = tmp_path_factory.mktemp("names") / CANARY
    words = ["synth", "-o", str(folder / "frames"), "--frames", "8", "--travel-mm", "4", "--size", "[64, 48]"]
    assert main([*words, "--slam.kind", "independent"]) == 0
    return folder


def run_on(output: Path, data: Path, **given) -> None:
    with run_folder(output, "densify", {"data": data, "map": str(data / "map.txt"), "kind": "colon"}, **given) as run:
        run.hash_inputs(data=data)
        run.warn(f"{data / 'map.txt'}: doubtful, see {data.parent.resolve()} and {data.name}")
        (run.folder / "report.html").write_text(f"<p>{data}</p>{json.dumps(str(data.resolve()))}", encoding="utf-8")


def made_data(folder: Path) -> Path:
    folder.mkdir(parents=True)
    (folder / "map.txt").write_text("points")
    return folder


def test_a_run_calls_its_inputs_by_option_and_contents_and_inputs_json_alone_has_the_paths(tmp_path):
    data = made_data(tmp_path / CANARY / "Frames & more é")
    before = os.umask(0)
    try:
        run_on(tmp_path / "out", data)
    finally:
        os.umask(before)
    assert telling(tmp_path / "out") == []
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    names = [record["arguments"][key] for key in ("data", "map")]
    assert all(TOKEN.fullmatch(name) for name in names) and record["arguments"]["kind"] == "colon"
    paths = json.loads((tmp_path / "out" / INPUTS).read_text())
    assert [paths[name] for name in names] == [str(data), str(data / "map.txt")]
    assert stat.S_IMODE((tmp_path / "out" / INPUTS).stat().st_mode) == 0o600 and INPUTS in record["files"]
    assert record["inputs"]["data"]["sha256"].startswith(names[0].rpartition("-")[2])
    assert yaml.safe_load((tmp_path / "out" / "config.yaml").read_text()) == record["arguments"]


def test_with_keep_names_paths_stand_everywhere_and_there_is_no_inputs_json(tmp_path):
    run_on(tmp_path / "out", made_data(tmp_path / CANARY), keep_names=True)
    assert telling(tmp_path / "out") == ["config.yaml", "log.txt", "report.html", "run.json"]
    assert not (tmp_path / "out" / INPUTS).exists()


def test_a_finished_run_is_known_again_by_its_inputs_json_and_not_without(tmp_path):
    data = made_data(tmp_path / CANARY)
    run_on(tmp_path / "out", data)
    with pytest.raises(AlreadyFinished):
        run_on(tmp_path / "out", data, resume=True)
    (tmp_path / "out" / INPUTS).unlink()
    with refused(f"{INPUTS} is gone"):
        run_on(tmp_path / "out", data, resume=True)


def test_inputs_of_the_same_contents_have_names_of_their_own(tmp_path):
    first, second = made_data(tmp_path / "a"), made_data(tmp_path / "b")
    found = names_of({"more": (first, second), "checkpoint": "decline", "format": "folder"})
    assert len(found.paths) == 2 and set(found.paths.values()) == {str(first), str(second)}


def test_words_of_a_language_and_numbers_in_a_path_change_no_other_text(tmp_path):
    names = names_of({"data": made_data(tmp_path / "colon" / "2024" / CANARY)})
    assert names.text('{"colon": 2024, "T1": "colon"}') == '{"colon": 2024, "T1": "colon"}'
    assert CANARY not in names.text(f"{CANARY}: {tmp_path / 'colon' / '2024'}") and "2024" not in names.text(
        str(tmp_path / "colon" / "2024")
    )


def test_the_config_of_a_run_serves_again_and_says_where_its_inputs_json_is_gone(patient, tmp_path, capsys):
    data, run = str(patient / "frames"), tmp_path / "depth"
    predict = ["predict", data, "--checkpoint", "decline", "--no-previews", "-o", str(run)]
    assert main([*predict, "--camera", f"{data}/camera.json"]) == 0
    assert telling(run) == []
    again = ["predict", "--config", str(run / "config.yaml"), "-o", str(tmp_path / "again")]
    assert main(again) == 0
    assert telling(tmp_path / "again") == []
    (run / INPUTS).unlink()
    assert main([*again[:-1], str(tmp_path / "third")]) == 3
    assert INPUTS in capsys.readouterr().err and not (tmp_path / "third").exists()


@pytest.fixture(scope="module")
def dense(patient) -> Path:
    output = patient.parent / "dense"
    words = ["--map", str(patient / "frames" / "slam"), "--checkpoint", "decline", "-o", str(output)]
    words += ["--no-fit-light", "--no-merge", "--judge.on", "false"]
    assert main(["densify", str(patient / "frames"), *words]) == 0
    return output


@pytest.mark.slow
def test_densify_names_no_patient(dense):
    assert telling(dense) == []


@pytest.mark.slow
def test_what_reads_a_run_finds_its_inputs_and_names_no_patient(dense, patient, tmp_path):
    assert main(["export", str(dense), "--to", "nerfstudio", "-o", str(tmp_path / "nerf")]) == 0
    assert any((tmp_path / "nerf").rglob("images/*.png"))
    assert telling(tmp_path / "nerf") == []
    assert main(["evaluate", str(dense), "--truth", str(patient / "frames"), "-o", str(tmp_path / "errors")]) == 0
    assert telling(tmp_path / "errors") == []


def test_a_verb_that_is_asked_to_keeps_the_names(patient, tmp_path):
    words = ["--checkpoint", "decline", "--no-previews", "--keep-names", "-o", str(tmp_path / "kept")]
    assert main(["predict", str(patient / "frames"), *words]) == 0
    assert "run.json" in telling(tmp_path / "kept") and not (tmp_path / "kept" / INPUTS).exists()


def test_a_spoilt_inputs_json_is_refused(tmp_path):
    data = made_data(tmp_path / CANARY)
    run_on(tmp_path / "out", data)
    (tmp_path / "out" / INPUTS).write_text("[")
    with pytest.raises(InputError):
        run_on(tmp_path / "out", data, resume=True)


@pytest.mark.slow
def test_a_training_names_no_patient_in_any_file_and_goes_on_from_its_own_settings(patient, tmp_path):
    run = tmp_path / "run"
    words = ["--data.sequences", str(patient / "frames"), "--model.network.kind", "tiny", "--data.size", "[64, 48]"]
    steps = ["--trainer.max_steps", "2", "--trainer.accelerator", "cpu", "-o", str(run)]
    assert main(["train", *words, *steps]) == 0
    assert telling(run) == [] and stat.S_IMODE((run / INPUTS).stat().st_mode) == 0o600
    assert main(["train", "--resume", "--trainer.max_steps", "3", "-o", str(run)]) == 0
    assert telling(run) == []
