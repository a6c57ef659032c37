"""Names of strangers' files do nothing to the terminal, to a log, and to a spreadsheet that opens a table."""

from __future__ import annotations

import warnings
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from densify.evaluation.depth_files import DepthReading
from lightdepth.cli import main, parse
from lightdepth.command_line.warned import warnings_as_sentences
from lightdepth.commands.predict import predict
from lightdepth.foreign_text import for_line, for_table, for_terminal, from_table
from lightdepth.reporting.report import Report
from lightdepth.reporting.run import paths_in, run_folder

EVIL = "\x1b]0;mine\x07\x1b[31m\x9b2J\rgone\u202e"


def harmless(text: str) -> bool:
    return not any(sign in text for sign in "\x1b\x07\x9b\r\u202e") and "mine" in text


def test_every_control_character_is_written_out_and_all_else_stays():
    assert for_terminal(EVIL) == r"\x1b]0;mine\x07\x1b[31m\x9b2J\rgone\u202e"
    assert for_terminal("grün\tµ\n…\udc80") == "grün\tµ\n…\udc80"


def test_a_name_reaches_the_terminal_and_the_log_without_what_a_terminal_obeys(tmp_path, capsys):
    assert main(["predict", str(tmp_path / EVIL), "-o", str(tmp_path / "out")]) == 3
    with pytest.raises(SystemExit):
        main(["predict", f"--{EVIL}"])
    with warnings_as_sentences():
        assert harmless(warnings.formatwarning(EVIL, UserWarning, "somewhere.py", 1))
    with run_folder(tmp_path / "run", "predict", {}) as run:
        run.warn(EVIL)
    said = capsys.readouterr()
    assert harmless(said.err) and harmless(said.out) and harmless((tmp_path / "run" / "log.txt").read_text())


def test_an_error_stays_one_line_whatever_ends_of_lines_are_in_a_name(tmp_path, capsys):
    name = "one\ntwo\u2028three\u2029four\r\nfive"
    assert for_line(name) == r"one\ntwo\u2028three\u2029four\r\nfive"
    assert main(["predict", str(tmp_path / name), "-o", str(tmp_path / "out")]) == 3
    said = capsys.readouterr().err
    assert len(said.splitlines()) == 1 and for_line(name) in said
    (tmp_path / name).mkdir()
    with run_folder(tmp_path / "run", "predict", {"data": tmp_path / name}) as run:
        run.warn(f"{tmp_path / name}: doubtful")
        run.log("a table\nof two lines")
    log = (tmp_path / "run" / "log.txt").read_text("utf-8").splitlines()
    assert len(log) == 3 and log[1].endswith("a table") and "data-" in log[0] and "two" not in log[0]


def test_a_name_in_a_page_does_not_turn_round_what_follows_it(tmp_path):
    page = Report(EVIL)
    page.text(EVIL)
    page.table([EVIL], [[EVIL]])
    page.figures([(b"", EVIL)])
    page.write(tmp_path / "report.html")
    assert harmless((tmp_path / "report.html").read_text("utf-8"))


@pytest.mark.parametrize("text", ["=cmd|' /C calc'!A1", "+1+1", "-2+3", "@SUM(A1)", "\t=1", "\r=1", "'=1"])
def test_a_cell_that_a_spreadsheet_would_compute_is_text_and_read_back_as_it_was(text):
    assert for_table(text) == f"'{text}" and from_table(for_table(text)) == text


def test_every_module_that_writes_a_table_makes_cells_of_names():
    root = Path(__file__).parents[1]
    modules = [p for room in ("lightdepth", "densify", "train") for p in (root / room).rglob("*.py")]
    writers = [p for p in modules if "csv.writer(" in p.read_text("utf-8")]
    without = {p.name for p in writers if "for_table(" not in p.read_text("utf-8")}
    assert len(writers) > 5 and without == {"scan.py"}, "import's table has numbers, and words of its own"


def test_a_file_whose_name_has_the_end_of_a_line_in_it_is_found_as_others_are(tmp_path):
    for name in ("new\nline_02.npz", "plain_03.npz"):
        (tmp_path / name).write_bytes(b"")
    assert sorted(DepthReading().files(tmp_path)) == [2, 3]


@given(st.text())
def test_every_text_is_read_back_from_a_table_as_it_was(text):
    assert from_table(for_table(text)) == text


@pytest.mark.parametrize("text", ["", "-0.5", "+3", "-1e-9", "000012", "colon", "a=b", "'quoted'"])
def test_numbers_and_usual_names_stand_in_a_table_as_they_are(text):
    assert for_table(text) == text == from_table(text)


@pytest.mark.parametrize("name", ["null", "~", "#case", "&x", "2024-01-01", "1e3", "[a]", "{a: b}"])
def test_a_folder_may_be_called_whatever_yaml_takes_for_something_else(name):
    found = parse(predict, "predict", [name, "-o", name])
    assert found["output"] == Path(name) and Path(name) in paths_in(found["source"])
