"""What every verb says at its end, with --quiet and with --json; and the completion of its words in a shell."""

from __future__ import annotations

import ast
import ctypes
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import warnings
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from threading import Barrier, BrokenBarrierError

import pytest
from test_options import every_verb, parsers

from lightdepth.checkpoint import bundled
from lightdepth.cli import main
from lightdepth.command_line.outcome import Outcome, end, manners, outcome, speaking
from lightdepth.command_line.parsing import Parser
from lightdepth.command_line.presets import presets
from lightdepth.command_line.verbs import all_verbs
from lightdepth.commands import completion
from lightdepth.counting import counted
from lightdepth.errors import InputError, Interrupted, PartialFailure
from lightdepth.reporting.progress import Progress
from lightdepth.reporting.run import run_folder

ROOT = Path(__file__).parents[1]
PINHOLE = {"model": "PINHOLE", "width": 64, "height": 48, "params": [40.0, 40.0, 32.0, 24.0], "pixel_center": 0.5}
FIELDS = {"verb", "exit_code", "version", "output", "files", "next", "result", "warnings", "failures", "seconds"}


def call(*words: object) -> int:
    try:
        return main([str(word) for word in words])
    except SystemExit as stopped:
        return int(stopped.code or 0)


@pytest.fixture
def camera(tmp_path) -> Path:
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(PINHOLE), encoding="utf-8")
    return path


@every_verb
def test_every_verb_answers_wrong_usage_with_one_document_on_standard_output(verb, capfd, monkeypatch):
    made = parsers()
    monkeypatch.setattr("lightdepth.cli.verb_parser", lambda function, verb: made[verb])
    monkeypatch.setattr("train.commands.train.training_parser", lambda: made["train"])
    assert call(*verb.split(), "--json", "--no-such-option", "3") == 2
    said = capfd.readouterr()
    found = json.loads(said.out)
    assert set(found) == FIELDS | {"error"} and found["exit_code"] == 2 and found["verb"] == verb.split()[0]
    assert set(found["error"]) == {"where", "found", "cure"} and all(found["error"].values())
    assert "Read on: lightdepth" in found["error"]["cure"] and said.err.startswith("lightdepth ")


@every_verb
def test_the_source_of_every_verb_ends_with_what_was_written_and_what_comes_next(verb):
    """Of what runs too long for a test; those that are short are run in test_names_of_verbs."""
    function = all_verbs()[verb.split()[0]].load()
    source = ast.parse(Path(function.__code__.co_filename).read_text(encoding="utf-8"))
    calls = [node for node in ast.walk(source) if isinstance(node, ast.Call) and ast.unparse(node.func) == "end"]
    ways = {"bench": 5, "view": 2}.get(verb.split()[0], 1)  # of view, a page and a recording
    assert len(calls) == (0 if verb == "completion" else ways)  # of which all that is said is the script
    assert all(any(k.arg == "then" for k in node.keywords) for node in calls)


def test_a_document_says_what_came_of_it_and_nothing_else_is_on_standard_output(camera, tmp_path, capfd):
    assert call("convert-camera", camera, "-o", tmp_path / "camera.yaml", "--json") == 0
    said = capfd.readouterr()
    found = json.loads(said.out)
    assert set(found) == FIELDS and found["exit_code"] == 0 and found["result"]["model"] == "PINHOLE"
    assert found["output"] == str(tmp_path / "camera.yaml") and found["files"] == [found["output"]]
    assert found["next"].startswith("lightdepth import VIDEO") and found["next"] in said.err


def test_an_error_has_the_parts_of_its_sentence_and_the_documented_code(tmp_path, capfd):
    assert call("convert-camera", tmp_path / "none.json", "-o", tmp_path / "a.json", "--json") == 3
    said = capfd.readouterr()
    error = json.loads(said.out)["error"]
    assert f"{error['where']}: {error['found']}; {error['cure']}" in said.err and "none.json" in error["where"]
    assert call("densfy", "--json") == 2 and "densify" in json.loads(capfd.readouterr().out)["error"]["cure"]


def in_a_run(folder: Path, call: Outcome, after: BaseException | None = None) -> dict[str, object]:
    """What the document says of a run."""
    with speaking(call) as code, run_folder(folder, "predict", {}) as run:
        (run.folder / "a.npz").write_bytes(b"a")
        run.record["verdict"] = {"colour": "amber", "share": float("nan")}
        warnings.warn("from afar", stacklevel=1)
        run.warn("from the run")
        code[0] = 0
        if after is not None:
            raise after
    return {}


@pytest.mark.filterwarnings("always")
def test_a_run_is_told_with_its_files_its_record_and_each_warning_once(tmp_path, capfd):
    in_a_run(tmp_path / "out", Outcome(json=True, verb="predict"))
    found = json.loads(capfd.readouterr().out)
    assert {str(tmp_path / "out" / name) for name in ("a.npz", "run.json", "log.txt")} <= set(found["files"])
    assert all(Path(name).is_file() for name in found["files"])
    assert found["result"]["verdict"] == {"colour": "amber", "share": None}
    assert found["result"]["verb"] == "predict" and "files" not in found["result"]
    assert found["warnings"] == ["from afar", "from the run"]


@pytest.mark.filterwarnings("always")
def test_a_run_that_is_stopped_says_so_and_names_no_files(tmp_path, capfd):
    with pytest.raises(Interrupted):
        in_a_run(tmp_path / "out", Outcome(json=True, verb="predict"), Interrupted(signal.SIGTERM))
    found = json.loads(capfd.readouterr().out)
    assert found["exit_code"] == 128 + signal.SIGTERM and found["files"] == [] and found["result"] is None
    assert found["error"]["found"] == "stopped by SIGTERM" and "begins anew" in found["error"]["cure"]
    assert set(found["warnings"]) == {"from afar", "from the run"}


def test_a_part_that_failed_is_in_the_document_of_what_was_written(tmp_path, capfd):
    with (
        pytest.raises(PartialFailure),
        speaking(Outcome(json=True)),
        run_folder(tmp_path / "out", "predict", {}) as run,
    ):
        run.fail("000003", "black")
    found = json.loads(capfd.readouterr().out)
    assert found["failures"] == [{"what": "000003", "reason": "black"}] and len(found["files"]) > 1


def test_what_libraries_write_past_python_is_kept_off_standard_output_too(capfd):
    with speaking(Outcome(json=True)) as code:
        os.write(1, b"a library's own words\n")
        print("and ours")
        code[0] = 0
    said = capfd.readouterr()
    assert json.loads(said.out)["exit_code"] == 0
    assert "a library's own words" in said.err and "and ours" in said.err
    os.write(1, b"again")
    assert capfd.readouterr().out == "again"


def test_a_fault_of_ours_is_a_document_and_still_a_traceback(capfd):
    with pytest.raises(KeyError), speaking(Outcome(json=True, verb="measure")):
        raise KeyError("spoon")
    found = json.loads(capfd.readouterr().out)
    assert found["exit_code"] == 1 and "KeyError: 'spoon'" in found["error"]["found"]


@pytest.mark.filterwarnings("always")
def test_quiet_leaves_warnings_and_what_was_written_and_the_log_is_whole(tmp_path, capfd):
    with speaking(Outcome(quiet=True)), run_folder(tmp_path / "out", "predict", {}) as run:
        with Progress("Predicting", 2, interval=0.0) as bar:
            bar.advance()
        run.log("how it goes")
        run.warn("it is dark")
        run.warn("it is very dark")
    with speaking(Outcome(quiet=True)):
        end(tmp_path / "out", then="lightdepth doctor")
    said = capfd.readouterr()
    assert said.out == f"written: {tmp_path / 'out'}\n"
    assert said.err == "warning: it is dark\nwarning: it is very dark\n"
    log = (tmp_path / "out" / "log.txt").read_text()
    assert all(line in log for line in ("how it goes", "warning: it is dark"))


def test_quiet_leaves_errors_and_the_answers_of_verbs_that_write_nothing(camera, tmp_path, capfd):
    assert call("convert-camera", camera, "-o", tmp_path / "a.json", "--quiet") == 0
    said = capfd.readouterr()
    assert (said.out, said.err) == (f"written: {tmp_path / 'a.json'}\n", "")
    assert call("convert-camera", camera, "-o", tmp_path / "b.json", "--quiet", "--json") == 0
    said = capfd.readouterr()
    assert json.loads(said.out)["output"] == str(tmp_path / "b.json") and said.err == ""
    assert call("convert-camera", camera, "-o", tmp_path / "a.json", "--quiet") == 3
    said = capfd.readouterr()
    assert said.out == "" and "already there" in said.err and len(said.err.splitlines()) == 1
    with speaking(Outcome(quiet=True)):
        outcome().last("12.3 mm")
        end(then="lightdepth doctor")
    assert capfd.readouterr().out == "12.3 mm\n"


def test_both_words_may_stand_anywhere_and_help_is_help(capfd):
    for words in (["--json", "--quiet", "predict", "x"], ["predict", "x", "--quiet", "--json"]):
        found, rest = manners(words)
        assert (found.quiet, found.json, found.verb, rest) == (True, True, "predict", ["predict", "x"])
    assert not manners(["predict", "--json", "--help"])[0].json and not manners(["--json", "--print-config"])[0].json
    assert call("convert-camera", "--json", "--help") == 0
    assert capfd.readouterr().out.startswith("usage: lightdepth convert-camera")


@pytest.mark.filterwarnings("ignore")  # jsonargparse takes beginnings of options, and will not for long
def test_quiet_help_is_help_and_half_a_word_is_none(capfd):
    for words in (["--help", "--quiet"], ["--quiet"], ["-V", "--quiet"], ["convert-camera", "--help", "--quiet"]):
        call(*words)
        assert capfd.readouterr().out.strip()
    assert call("convert-camera", "x", "-o", "y", "--jso") == 2
    assert "--json: has to be written in full" in capfd.readouterr().err


def test_what_libraries_in_c_hold_back_is_said_before_the_document(capfd):
    with speaking(Outcome(json=True, verb="predict")):
        ctypes.CDLL(None).printf(b"held back\n")
    said = capfd.readouterr()
    assert json.loads(said.out)["verb"] == "predict" and "held back" in said.err


def test_a_run_that_fails_tells_its_warnings_as_the_terminal_does(tmp_path, capfd):
    data = tmp_path / "Smith_Anna"
    data.mkdir()
    with (
        speaking(Outcome(json=True, verb="predict")),
        pytest.raises(InputError),
        run_folder(tmp_path / "out", "predict", {"data": data}) as run,
    ):
        run.warn(f"{data}/mask.png: is odd")
        raise InputError("the data", "nothing of it", "give more")
    said = capfd.readouterr()
    assert "data/mask.png: is odd" in said.err and json.loads(said.out)["warnings"] == ["data/mask.png: is odd"]


def test_a_file_of_settings_does_not_make_a_run_quiet(tmp_path, camera, capfd):
    (tmp_path / "c.yaml").write_text("quiet: true\n")
    with pytest.warns(UserWarning, match="given with each run: quiet"):
        assert call("convert-camera", camera, "-o", tmp_path / "b.json", "--config", tmp_path / "c.yaml") == 0
    said = capfd.readouterr()
    assert said.out.splitlines()[-2].startswith("next: ")


def test_one_has_no_plural():
    assert counted(1, "finished part") == "1 finished part" and counted(0, "hole") == "0 holes"
    assert counted(2, "stretch", "stretches") == "2 stretches"
    undecided = []
    for path in (p for package in ("lightdepth", "densify", "train") for p in (ROOT / package).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.JoinedStr):
                texts = [part.value for part in node.values if isinstance(part, ast.Constant)]
                undecided += [f"{path.name}: {text}" for text in texts if "(s)" in str(text)]
    assert undecided == []


SHELLS = ("bash", "zsh", "fish")


@pytest.fixture(scope="module")
def scripts(tmp_path_factory) -> dict[str, Path]:
    """The scripts of all shells; the parsers are built once."""
    folder, found = tmp_path_factory.mktemp("shell"), {}
    for shell in SHELLS:
        found[shell] = folder / f"completion.{shell}"
        with pytest.MonkeyPatch.context() as patched, found[shell].open("w", encoding="utf-8") as out:
            patched.setattr(completion, "parsers_of", lambda verb, function: ways_of(verb))
            patched.setattr("sys.stdout", out)
            assert main(["completion", shell]) == 0
    return found


def ways_of(verb: str) -> dict[str, Parser]:
    """The parsers of a verb, by the words that may follow it."""
    return {name.partition(" ")[2]: made for name, made in parsers().items() if name.split()[0] == verb}


def completed(script: Path, words: list[str], folder: Path) -> set[str]:
    """What bash offers after `words`, of which the last is begun."""
    if shutil.which("bash") is None:
        pytest.skip("bash is not installed")
    program = (
        'source "$1"; shift; cd "$1"; shift; COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); compopt() { :; }; '
        "$(complete -p lightdepth | sed 's/.*-F \\([^ ]*\\).*/\\1/'); printf '%s\\n' \"${COMPREPLY[@]}\""
    )
    done = subprocess.run(
        ["bash", "--norc", "-c", program, "bash", str(script), str(folder), *words],
        capture_output=True,
        text=True,
        check=True,
    )
    return set(done.stdout.split())


def test_bash_completes_verbs_options_choices_and_files(scripts, tmp_path):
    (tmp_path / "my_map").mkdir()
    (tmp_path / "my_frames.mp4").touch()

    def after(line: str) -> set[str]:
        return completed(scripts["bash"], line.split(" "), tmp_path)

    assert after("lightdepth den") == {"densify"}
    assert {"demo", "doctor", "export", "completion"} <= after("lightdepth ")
    assert {"--fusion.voxel", "--fusion.max-error"} <= after("lightdepth densify --fus")
    assert all(word.startswith("--fus") for word in after("lightdepth densify --fus"))
    assert after("lightdepth densify x --qu") == {"--quiet"} and after("lightdepth doctor --js") == {"--json"}
    assert after("lightdepth synth --layout c") == {"c3vd"}
    assert after("lightdepth export x --to ") >= {"colmap", "onnx", "tum"}
    assert after("lightdepth densify --merge f") == {"false"}
    assert after("lightdepth train --preset ") == set(presets("train"))
    assert after("lightdepth completion z") == {"zsh"}
    assert after("lightdepth bench per") == {"per-frame"}
    assert "--external" in after("lightdepth bench completion --ext")
    assert after("lightdepth densify my_f") == {"my_frames.mp4"}
    assert after("lightdepth densify my_frames.mp4 --map my_m") == {"my_map"}
    assert after("lightdepth densify x --checkpoint ") == {"my_map", "my_frames.mp4", "decline", "constant", *bundled()}
    assert after("lightdepth export ") >= {"my_map", *bundled()} and "decline" not in after("lightdepth export ")
    for words in ("predict x --checkpoint", "bench --checkpoints", "adapt x --checkpoint", "train --model.start"):
        assert after(f"lightdepth {words} lightdepth-b") == {"lightdepth-both"}, words


def test_every_shell_offers_the_depth_models_that_come_with_the_program(scripts):
    for shell in SHELLS:
        assert all(name in scripts[shell].read_text() for name in [*bundled(), "decline"])


def test_bash_completes_names_of_checkpoints_and_files_with_a_blank(scripts, tmp_path):
    (tmp_path / "my case").mkdir()
    (tmp_path / "decided.ckpt").touch()
    for line, more in (
        ("densify x --checkpoint de", {"decline"}),
        ("export de", set()),
        ("adapt x --checkpoint de", set()),
    ):
        assert completed(scripts["bash"], ["lightdepth", *line.split(" ")], tmp_path) == {"decided.ckpt", *more}
    for words in (["densify", "my c"], ["densify", "x", "--map", "my c"], ["densify", "x", "--checkpoint", "my c"]):
        assert completed(scripts["bash"], ["lightdepth", *words], tmp_path) == {"my", "case"}  # one line of two words


def test_fish_completes_verbs_choices_names_of_checkpoints_and_files(scripts, tmp_path):
    if shutil.which("fish") is None:
        pytest.skip("fish is not installed")
    (tmp_path / "my case").mkdir()
    (tmp_path / "decided.ckpt").touch()
    lines = ["den", "synth --layout c", "densify x --checkpoint de", "densify my\\ c", "densify x --map my\\ c"]
    program = 'source $argv[1]; for line in $argv[2..]; complete -C "lightdepth $line"; echo; end'
    done = subprocess.run(
        ["fish", "--no-config", "-c", program, str(scripts["fish"]), *lines],
        capture_output=True,
        text=True,
        check=True,
        cwd=tmp_path,
        env=os.environ | {"HOME": str(tmp_path)},
    )
    told = [{one.split("\t")[0] for one in block.splitlines()} for block in done.stdout.split("\n\n")[: len(lines)]]
    assert told == [{"densify"}, {"c3vd"}, {"decline", "decided.ckpt"}, {"my case/"}, {"my case/"}]


def test_what_a_shell_says_of_an_option_ends_with_a_whole_word(scripts):
    text = scripts["zsh"].read_text(encoding="utf-8")
    assert "_lightdepth_model_or_file() {" in text
    said = re.findall(r'^  "--[a-z.-]+\[([^\]]+)\]', text, re.MULTILINE)
    assert len(said) > 300 and sum(one.endswith(" ...") for one in said) > 30


def test_a_command_that_is_done_does_not_look_through_its_objects_again_before_it_ends():
    program = (
        "import atexit, gc\natexit.register(lambda: print('frozen:', gc.get_freeze_count() > 1000))\n"
        "from lightdepth.cli import main\nmain()"
    )
    done = subprocess.run([sys.executable, "-c", program, "--version"], capture_output=True, text=True, check=True)
    assert done.stdout.endswith("frozen: True\n")


def test_a_tab_starts_no_python(scripts):
    text = scripts["bash"].read_text()
    assert "python" not in text.lower() and "$(lightdepth" not in text


@pytest.mark.parametrize("shell", SHELLS)
def test_a_script_is_one_that_its_shell_reads(scripts, shell):
    text = scripts[shell].read_text()
    assert "densify" in text and "fusion.voxel" in text and "next: " not in text and "it belongs to" in text
    assert ("where FOLDER is one of $fpath" in text) == (shell == "zsh")
    if shutil.which(shell) is None:
        pytest.skip(f"{shell} is not installed")
    subprocess.run([shell, "-n", str(scripts[shell])], check=True)


def test_zsh_knows_from_the_first_line_what_the_script_is_for(scripts):
    assert scripts["zsh"].read_text().startswith("#compdef lightdepth\n")


def test_two_threads_that_ask_for_json_at_once_get_a_document_each(monkeypatch, capfd):
    together = Barrier(2)

    def work(argv: list[str]) -> int:
        print(f"words of {argv[0]}")
        with suppress(BrokenBarrierError):
            together.wait(0.5)  # the other one, where it does not wait for its turn
        return 0

    monkeypatch.setattr("lightdepth.cli._main", work)
    with ThreadPoolExecutor(2) as pool:
        assert list(pool.map(main, [["doctor", "--json"], ["demo", "--json"]])) == [0, 0]
    said, told = capfd.readouterr(), []
    while text := said.out.strip():
        found, end = json.JSONDecoder().raw_decode(text)
        told.append(found["verb"])
        said = said._replace(out=text[end:])
    assert sorted(told) == ["demo", "doctor"] and said.err.count("words of") == 2
