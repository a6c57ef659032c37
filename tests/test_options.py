"""The options of every verb: what each says of itself, what --help shows, and what a mistake is told.

`python tests/test_options.py` prints how many options there are, and which say too little.
"""

from __future__ import annotations

import argparse
import difflib
import re
import shlex
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import get_args, get_origin

import pytest
from raising import warned

from lightdepth.cli import main
from lightdepth.command_line.gone_settings import without_gone
from lightdepth.command_line.pages import PAGES
from lightdepth.command_line.parsing import Parser, parsed
from lightdepth.command_line.verbs import all_verbs, parsers_of
from lightdepth.command_line.words import options
from lightdepth.datasets import FORMATS, FormatName

UNIT = re.compile(
    r"\b(mm|millimetres|milliseconds|seconds|pixels|voxels|degrees|radians|megabytes|map units|map unit|turns of the"
    r"|minutes|gigabytes|shares?|numbers?|counts?|weights?|rate|decay|factor|ratios?|exponent|multiple|cosine|log|sigmas?|deviation|days"
    r"|brightness|contrast|code values?|correlation|norm)\b|\bin \[0, 1\]|\bunits of\b",
    re.IGNORECASE,
)
"""A unit, or the word for a number that has none."""
MORE = re.compile(r"(?:^|[.;] )(More|Larger|A larger|A higher|A longer|Another)\b")
"""A sentence on what a larger number does; of seeds and places, what another one does."""
ROOT = Path(__file__).parents[1]
GENERAL = ("help", "config", "print_config", "quiet", "json", "overwrite", "resume", "dry_run")


@cache
def parsers() -> dict[str, Parser]:
    """The parser of every verb; `bench` has five."""
    found = {}
    for verb, entry in all_verbs().items():
        found |= {f"{verb} {way}".rstrip(): parser for way, parser in parsers_of(verb, entry.load()).items()}
    return found


VERBS = sorted(PAGES)
every_verb = pytest.mark.parametrize("verb", VERBS)


def types_in(kind: object) -> Iterator[object]:
    yield kind
    for part in get_args(kind):
        yield from types_in(part)


def is_number(action: argparse.Action) -> bool:
    """Whether a number, or several, are all that is taken."""
    leaves = [t for t in types_in(getattr(action, "_typehint", None)) if get_origin(t) is None and t is not type(None)]
    return bool(leaves) and all(t in (int, float, ...) for t in leaves)


def lacks(action: argparse.Action) -> str:
    """What the sentence of an option lacks, or nothing."""
    text = " ".join((action.help or "").split())
    own = re.split(r"[._]", action.dest.lower())
    words = [w for w in re.findall(r"[A-Za-z][A-Za-z'-]*", text) if w.lower() not in own]
    if len(words) < 5:
        return "five words"
    if is_number(action) and not UNIT.search(text):
        return "a unit"
    if is_number(action) and not MORE.search(text):
        return "what more of it does"
    return ""


def mute(verb: str, dotted: bool) -> dict[str, str]:
    """Options of a verb whose sentence lacks something: those of groups, or the plain ones."""
    found = {a.dest: lacks(a) for a in options(parsers()[verb]) if ("." in a.dest) == dotted}
    return {name: lack for name, lack in found.items() if lack}


def test_every_verb_has_a_page_and_every_page_a_verb():
    assert set(parsers()) == set(PAGES)


@every_verb
def test_every_option_of_a_group_says_what_it_is_its_unit_and_what_more_of_it_does(verb):
    assert mute(verb, dotted=True) == {}


@every_verb
def test_every_plain_option_says_what_it_is_its_unit_and_what_more_of_it_does(verb):
    assert mute(verb, dotted=False) == {}


def test_the_formats_that_can_be_named_are_those_that_are_read():
    assert set(get_args(FormatName)) == set(FORMATS)


def test_the_rule_finds_an_option_that_says_too_little():
    def option(name: str, text: str, kind: type) -> argparse.Action:
        action = argparse.Action([f"--{name}"], name, help=text)
        action._typehint = kind  # type: ignore[attr-defined]
        return action

    assert lacks(option("min_points", "the min points", int)) == "five words"
    assert lacks(option("reach", "How far it goes from here to there. More go farther.", float)) == "a unit"
    assert lacks(option("reach", "How far it goes from here to there, mm.", float)) == "what more of it does"
    assert lacks(option("reach", "How far it goes from here to there, mm. A larger one goes farther.", float)) == ""
    assert lacks(option("name", "What the whole run is called.", str)) == ""


def help_of(verb: str, word: str, capsys) -> str:
    with pytest.raises(SystemExit) as stopped:
        parsed(parsers()[verb], [word])
    assert stopped.value.code == 0
    return capsys.readouterr().out


@every_verb
def test_help_has_two_examples_and_the_everyday_options_and_fits_100_columns(verb, capsys):
    shown = help_of(verb, "--help", capsys)
    page, parser = PAGES[verb], parsers()[verb]
    assert len(page.examples) == 2 and all(f"\n  {example}\n" in shown for example in page.examples)
    everyday = [a for a in options(parser) if page.shows(a.dest)]
    assert len([a for a in everyday if a.dest not in GENERAL]) <= 20
    lines = shown.splitlines()
    entries = [line for line in lines if re.match(r"  (-|[a-z{])", line) and not line.startswith("  lightdepth ")]
    assert len(entries) == len(everyday)
    assert max(len(line) for line in lines if not line.startswith("  lightdepth ")) <= 100


@every_verb
@pytest.mark.parametrize("word", ["--help", "--help-all"])
def test_help_spells_every_option_with_dashes(verb, word, capsys):
    assert re.findall(r"--[a-z][\w.-]*_[\w.-]*", help_of(verb, word, capsys)) == []


def test_help_names_other_options_in_its_sentences_with_dashes(capsys):
    shown = " ".join(help_of("train", "--help-all", capsys).split())
    assert "max-steps" in shown and "max_steps" not in shown
    assert "one_cycle climbs to learning-rate and falls" in shown  # the first is a choice, and typed so


def test_the_documents_spell_options_with_dashes():
    for document in (ROOT / "README.md", *ROOT.glob("docs/*.md"), *ROOT.glob("data/**/*.md"), ROOT / "CHANGELOG.md"):
        assert re.findall(r"--[a-z][\w.-]*_[\w.-]*", document.read_text(encoding="utf-8")) == [], document


@every_verb
def test_the_names_on_a_page_are_options_of_the_verb(verb):
    names = {a.dest for a in options(parsers()[verb])}
    assert set(PAGES[verb].more) | set(PAGES[verb].rare) <= names


@every_verb
def test_help_all_shows_every_option_with_its_sentence(verb, capsys):
    shown = "".join(help_of(verb, "--help-all", capsys).split()).replace("_", "-")
    for action in options(parsers()[verb]):
        spelled = action.option_strings[-1].removesuffix("+") if action.option_strings else action.dest
        assert spelled.replace("_", "-") in shown
        assert "".join((action.help or "").split()).replace("_", "-") in shown


@every_verb
def test_the_examples_are_understood(verb):
    for example in PAGES[verb].examples:
        assert example.startswith(f"lightdepth {verb}")
        for command in example.split(" && "):
            words = shlex.split(command.partition(" > ")[0])[1:]
            if words[0] == "bench" and not words[1].startswith("-"):
                words[:2] = [" ".join(words[:2])]
            if not any(word.startswith("configs/") for word in words):
                parsed(parsers()[words[0]], words[1:])


def told(verb: str, argv: list[str], capsys) -> str:
    """The one line of a mistake in usage."""
    with pytest.raises(SystemExit) as stopped:
        parsed(parsers()[verb], argv)
    shown = capsys.readouterr()
    assert stopped.value.code == 2 and not shown.out
    (line,) = shown.err.splitlines()
    assert line.startswith(f"lightdepth {verb}: error: ") and f"Read on: lightdepth {verb} --help" in line
    return line


@pytest.mark.parametrize("verb", [v for v in VERBS if v not in ("doctor", "completion")])  # without any
def test_a_mistyped_option_is_told_the_nearest_one_in_one_line(verb, capsys):
    names = [a.option_strings[-1] for a in options(parsers()[verb]) if a.option_strings and a.dest not in GENERAL]
    longest = max((n.removesuffix("+") for n in names), key=len)
    wrong = f"{longest[:-2]}{longest[-1]}{longest[-2]}q"
    needed = [a.dest for a in options(parsers()[verb]) if not a.option_strings]
    output = ["-o", "out"] if any("-o" in a.option_strings for a in options(parsers()[verb])) else []
    line = told(verb, [*needed, *output, wrong, "1"], capsys)
    assert f"no option {wrong.replace('_', '-')}; did you mean {longest.replace('_', '-')}?" in line
    assert difflib.get_close_matches(wrong, names, 1)


MISTAKES = {
    "the end of a name": (
        "densify",
        ["D", "-o", "O", "--voxel", "1"],
        "did you mean --fusion.voxel?",
    ),
    "a single dash": ("densify", ["D", "-o", "O", "-mask", "x"], "did you mean --mask?"),
    "before what is missing": ("densify", ["--mpa", "x"], "no option --mpa; did you mean --map?"),
    "nothing is like it": ("densify", ["D", "-o", "O", "--qqq", "1"], "no option --qqq. Read on"),
    "dashes": ("densify", ["D", "-o", "O", "--mm-per-unt", "3"], "did you mean --mm-per-unit?"),
    "choice": ("synth", ["-o", "O", "--layout", "c3d"], "one of frames, c3vd, endomapper; did you mean c3vd?"),
    "format": ("densify", ["D", "-o", "O", "--format", "colmap"], "--format colmap: expected one of folder, c3vd"),
    "lens": ("synth", ["-o", "O", "--lens", "rear"], "--lens rear: expected one of pinhole, telescope, fisheye, c3vd."),
    "mesh": (
        "densify",
        ["D", "-o", "O", "--formats", "stl"],
        "each one of ply, glb, obj",
    ),
    "choice in a list": ("densify", ["D", "-o", "O", "--merging.by", "point"], "did you mean points?"),
    "choice of train": ("train", ["-o", "O", "--model.network.kind", "unett"], "did you mean unet?"),
    "number": ("densify", ["D", "-o", "O", "--alignment.t", "wide"], "--alignment.t wide: expected a number."),
    "whole number": ("synth", ["-o", "O", "--frames", "1.5"], "--frames 1.5: expected a whole number."),
    "two numbers": ("synth", ["-o", "O", "--size", "3"], "--size 3: expected 2 whole numbers"),
    "nothing after it": ("predict", ["D", "-o"], "-o needs a value."),
    "an empty number": ("scale", ["R", "--wall-mm", ""], "--wall-mm '': expected a number. Read on"),
    "an empty list": (
        "scale",
        ["R", "--length.ends="],
        "--length.ends '': expected a list, each 3 numbers, as [N, N, N]",
    ),
    "no output": ("predict", ["D"], "missing: -o OUTPUT."),
    "no data": ("predict", ["-o", "O"], "missing: DATA."),
    "a word too many": ("predict", ["D", "E", "-o", "O"], "E: nothing takes this word"),
}


@pytest.mark.parametrize("case", MISTAKES)
def test_a_mistake_is_told_what_was_typed_and_what_would_be_right(case, capsys):
    verb, argv, words = MISTAKES[case]
    assert words in told(verb, argv, capsys)


def test_a_file_of_settings_may_spell_them_with_dashes_as_help_does(tmp_path):
    (tmp_path / "c.yaml").write_text("mm-per-unit: 3\nfit-light: false\nalignment: {min-points: 21}\n")
    found = parsed(parsers()["densify"], ["D", "-o", "O", "--config", str(tmp_path / "c.yaml")])
    assert (found["mm_per_unit"], found["fit_light"], found["alignment.min_points"]) == (3, False, 21)


def test_an_option_that_is_gone_is_said_to_be_on_the_command_line_and_left_out_of_a_file(tmp_path, capsys):
    words = ["-o", "O", "--trainer.limit-test-batches", "2"]
    assert "--trainer.limit-test-batches is no more (it had no effect): leave it out" in told("train", words, capsys)
    (tmp_path / "c.yaml").write_text("trainer.limit-test-batches: 2\ntrainer: {barebones: true, max-steps: 7}\n")
    with warned("limit_test_batches", "barebones"):
        (text,) = without_gone("train", [f"--config={tmp_path / 'c.yaml'}"])
    assert text == "--config=trainer:\n  max_steps: 7\n"


FILES = {
    "key": ("chekpoint: decline\n", "no setting chekpoint; did you mean checkpoint?"),
    "key of a group": (
        "alignment:\n  min_point: 3\n",
        "no setting alignment.min_point; did you mean alignment.min_points?",
    ),
    "value": ("alignment:\n  t: wide\n", "alignment.t: wide: expected a number."),
    "choice": ("recipe: papre\n", "recipe: papre: expected one of full, paper; did you mean paper?"),
    "no YAML": ("alignment: [\n", "not YAML: "),
}


@pytest.mark.parametrize("case", FILES)
def test_a_mistake_in_a_file_of_settings_names_the_file(case, tmp_path, capsys):
    text, words = FILES[case]
    (tmp_path / "c.yaml").write_text(text)
    line = told("densify", ["D", "-o", "O", "--config", str(tmp_path / "c.yaml")], capsys)
    assert f"error: {tmp_path / 'c.yaml'}: {words}" in line


@pytest.mark.parametrize(
    ("verb", "option", "typed", "taken"),
    [
        ("densify", "formats", "ply", ["ply"]),
        ("densify", "formats", "[ply, glb]", ["ply", "glb"]),
        ("densify", "merging.by", "points", ["points"]),
        ("densify", "bending.grids", "7", [7]),
        ("adapt", "more", "some, folder", [Path("some, folder")]),
        ("train", "data.sequences", "folder", ["folder"]),
        ("ablate", "seeds", "3", [3]),
        ("bench", "wrong_shares", "0.3", [0.3]),
        ("measure", "points", "[1, 2, 3]", [(1.0, 2.0, 3.0)]),
        ("measure", "points", "[[1, 2, 3], [4, 5, 6]]", [(1.0, 2.0, 3.0), (4.0, 5.0, 6.0)]),
    ],
)
def test_a_single_value_is_taken_where_a_list_is_wanted(verb, option, typed, taken, tmp_path):
    parser = parsers()[verb]
    needed = [a.dest for a in options(parser) if not a.option_strings]
    output = ["-o", "out"] if any(a.dest == "output" for a in options(parser)) else []
    for words in ([f"--{option}", typed], [f"--{option}={typed}"]):
        assert list(parsed(parser, [*needed, *output, *words])[option]) == taken
    text = f"{typed!r}" if "," in typed and not typed.startswith("[") else typed
    *groups, last = option.split(".")
    lines = [f"{'  ' * i}{group}:" for i, group in enumerate(groups)] + [f"{'  ' * len(groups)}{last}: {text}"]
    (tmp_path / "c.yaml").write_text("\n".join(lines) + "\n")
    assert list(parsed(parser, [*needed, *output, "--config", str(tmp_path / "c.yaml")])[option]) == taken


@pytest.mark.parametrize(
    ("verb", "words", "option", "value"),
    [
        ("densify", ["--no-merge"], "merge", False),
        ("densify", ["--no_merge"], "merge", False),
        ("densify", ["--merge", "false"], "merge", False),
        ("densify", ["--bending.no-on"], "bending.on", False),
        ("densify", ["--alignment.finite-sample"], "alignment.finite_sample", True),
        ("train", ["--model.freeze-distance"], "model.freeze_distance", True),
        ("train", ["--data.no-augment"], "data.augment", False),
        ("train", ["--data.batch-size", "7"], "data.batch_size", 7),
        ("train", ["--data.batch-size=7"], "data.batch_size", 7),
        ("select", ["--no-frames"], "no_frames", True),
    ],
)
def test_dashes_are_underscores_and_switches_need_no_value(verb, words, option, value):
    needed = [a.dest for a in options(parsers()[verb]) if not a.option_strings]
    assert parsed(parsers()[verb], [*needed, "-o", "out", *words])[option] is value or value == 7


def test_the_command_itself_ends_with_2_and_one_line(capsys):
    with pytest.raises(SystemExit) as stopped:
        main(["predict", "D", "-o", "O", "--chekpoint", "x"])
    assert stopped.value.code == 2
    assert "no option --chekpoint; did you mean --checkpoint?" in capsys.readouterr().err


if __name__ == "__main__":
    said = {verb: {**mute(verb, dotted=False), **mute(verb, dotted=True)} for verb in VERBS}
    total = sum(len(options(parser)) for parser in parsers().values())
    print(f"{total} options of {len(VERBS)} verbs; {sum(map(len, said.values()))} say too little")
    for verb, found in said.items():
        for name, lack in found.items():
            print(f"  {verb} --{name} lacks {lack}")


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"fusion: 3", "fusion is 3; expected settings below it"),
        (b"\xff\xfe\x00", "not YAML: "),
        (b"", "no settings in it"),
        (b"- 1", "no settings in it"),
    ],
)
def test_a_file_that_holds_no_settings_is_named_in_one_line(content, said, tmp_path, capsys):
    (tmp_path / "c.yaml").write_bytes(content)
    with pytest.raises(SystemExit) as ended:
        main(["densify", "data", "-o", str(tmp_path / "out"), "--config", str(tmp_path / "c.yaml")])
    told = capsys.readouterr().err
    assert ended.value.code == 2 and told.count("\n") == 1 and "c.yaml" in told and said in told
