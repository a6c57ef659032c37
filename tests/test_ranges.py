"""Every number option of every verb has a range, which its help shows and which is held against what is typed before
any work; settings that are made in a program are held against the same ranges."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Annotated, Any, get_args, get_type_hints

import pytest
from raising import refused
from test_options import VERBS, every_verb, is_number, options, parsers, told, types_in

from lightdepth.cli import main
from lightdepth.command_line.parsing import parsed
from lightdepth.command_line.ranges import check_ranges, range_in
from lightdepth.errors import InputError
from lightdepth.ranges import BELOW_ONE, LARGEST, PIXELS, SHARE, Range, above, at_least, checked, ends_of, range_of

ODD = {".nan": math.nan, ".inf": math.inf, "-.inf": -math.inf, "-1": -1, "0": 0, "1.0e+30": 1e30, str(10**20): 10**20}
"""Numbers as they are typed, and what they are."""
HUGE_ON_PURPOSE = {"time_offset": 1e12, "frame": 1e19, "map_sensor": 2**32}
"""Options that take numbers beyond the usual: Unix times, names in nanoseconds, COLMAP's ids."""
ALSO_WORDS = ("trainer.precision", "settings")
"""Whose numbers are names, or stand for options that have ranges of their own."""


def number_options(verb: str) -> list[argparse.Action]:
    """All options of a verb that take a number, alone, in a list, or besides words."""
    found = []
    for action in options(parsers()[verb]):
        kinds = [getattr(action, "_typehint", None), action.type]
        if any(t in (int, float) for kind in kinds for t in types_in(kind)) and action.dest not in ALSO_WORDS:
            found.append(action)
    return found


def within(action: argparse.Action) -> Range:
    found = range_in(action)
    assert found is not None, f"--{action.dest} has no range"
    return found


@every_verb
def test_every_number_option_has_a_range_that_its_default_is_in_and_its_help_shows(verb, capsys):
    with pytest.raises(SystemExit):
        parsed(parsers()[verb], ["--help-all"])
    shown = "".join(capsys.readouterr().out.split())
    for action in number_options(verb):
        one = within(action)
        assert not one.wrong(action.default), action.dest
        assert is_number(action) <= ("".join(one.words.split()) in shown), action.dest


@every_verb
def test_no_number_option_takes_what_is_no_number_or_beyond_all_measure(verb):
    for action in number_options(verb):
        one = within(action)
        assert not {math.nan, math.inf, -math.inf, 1e30, -1e30} & {n for n in ODD.values() if n in one}, action.dest
        largest = HUGE_ON_PURPOSE.get(action.dest, LARGEST)
        assert max(abs(one.low), abs(one.high)) <= largest, action.dest


def typed(action: argparse.Action, word: str) -> str:
    """A word in the shape that an option takes."""
    hint = str(getattr(action, "_typehint", ""))
    if "list[tuple[" in hint:
        count = hint.split("list[tuple[")[1].split("]")[0].count(",") + 1
        return f"[[{', '.join([word] * count)}]]"
    if "tuple[" in hint:
        inner = hint.split("tuple[")[1].split("]")[0]
        return f"[{word}]" if "..." in inner else f"[{', '.join([word] * (inner.count(',') + 1))}]"
    return word


def takes_words(action: argparse.Action) -> bool:
    return str in types_in(getattr(action, "_typehint", None))


def needed(verb: str) -> list[str]:
    """What a verb cannot do without."""
    words = [a.dest for a in options(parsers()[verb]) if not a.option_strings]
    return [*words, "-o", "out"] if any(a.dest == "output" for a in options(parsers()[verb])) else words


def outcome(verb: str, action: argparse.Action, word: str, capsys) -> str:
    """What is said of a word typed for an option; "" where it is taken."""
    try:
        parsed(parsers()[verb], [*needed(verb), f"--{action.dest}={typed(action, word)}"])
    except InputError as error:
        return str(error)
    except SystemExit as ended:
        assert ended.code == 2
        return capsys.readouterr().err
    return ""


@every_verb
def test_what_is_typed_out_of_an_option_s_range_is_refused_by_its_name_before_any_work(verb, capsys):
    for turn, action in enumerate(number_options(verb)):
        one, name = within(action), f"--{action.dest.replace('_', '-')}"
        wrong = [word for word, number in ODD.items() if number not in one and not takes_words(action)]
        for word in wrong[turn % max(len(wrong), 1) :][
            :1
        ]:  # one of them: a parse takes 10 ms, and the range knows the others
            assert name in outcome(verb, action, word, capsys), word
        for number in {float(n) for n in ODD.values()}:
            if number not in one:
                with refused(where=name):
                    check_ranges([action], {action.dest: number}.get, lambda _, name=name: name)


# ---- settings made in a program


def settings_of(kind: Any) -> Iterator[type]:
    """All dataclasses below a type or a function."""
    for hint in get_type_hints(kind, include_extras=True).values():
        for part in dict.fromkeys(types_in(hint)):
            if isinstance(part, type) and is_dataclass(part):
                yield part
                yield from settings_of(part)


def all_settings() -> list[type]:
    from importlib import metadata

    from densify.bench.estimators import EstimatorsConfig
    from densify.bench.work import BenchConfig
    from lightdepth.losses import LossConfig
    from lightdepth.network import NetworkConfig
    from train.datamodule import FrameData
    from train.watching import FitConfig

    found = [EstimatorsConfig, BenchConfig, LossConfig, NetworkConfig, FrameData, FitConfig]
    for entry in metadata.entry_points(group="lightdepth.commands"):
        found += settings_of(entry.load())
    found += [below for one in list(found) for below in settings_of(one)]
    return sorted(set(found), key=lambda one: one.__name__)


@pytest.mark.parametrize("settings", all_settings(), ids=lambda one: one.__name__)
def test_every_number_in_settings_has_a_range_that_making_them_holds_to(settings):
    hints = get_type_hints(settings, include_extras=True)
    for field in fields(settings):
        hint = hints[field.name]
        if not {int, float} & set(types_in(hint)) or field.name in ALSO_WORDS:
            continue
        one = range_of(hint)
        assert one is not None, f"{settings.__name__}.{field.name} has no range"
        needs = {f.name: "a" for f in fields(settings) if f.default == f.default_factory and f.name != field.name}
        for bad in (math.nan, math.inf, 1e30, 10**20):
            shaped = (bad,) if "tuple" in str(hint) else bad
            with refused(where=f"{settings.__name__}.{field.name}"):
                settings(**needs, **{field.name: shaped})


def test_a_copy_of_settings_is_held_to_their_ranges_too_and_checks_of_their_own_go_on():
    @dataclass(frozen=True)
    @checked
    class Made:
        width: Annotated[int, PIXELS] = 3
        share: Annotated[float | None, SHARE] = None

        def __post_init__(self) -> None:
            if self.width == 7:
                raise InputError("width", "7", "expected another")

    get_type_hints(Made)  # of a local class, whose names are found
    with refused(where="Made.share", found="2", cure="from 0 to 1"):
        replace(Made(), share=2.0)
    with refused(where="width", found="7"):
        Made(7)


def test_ranges_say_what_they_take():
    words = {
        one.words for one in (Range(), above(0), at_least(3), SHARE, BELOW_ONE, above(0, up_to=1), above(0, below=1))
    }
    assert words == {
        "",
        "above 0",
        "of at least 3",
        "from 0 to 1",
        "of at least 0 and below 1",
        "above 0 and up to 1",
        "above 0 and below 1",
    }
    assert ends_of(SHARE).wrong((0.7, 0.2)) and not ends_of(SHARE).wrong((0.2, 0.2))
    assert (
        "1e+09" in above(0).wrong(1e30)
        and not above(0).wrong(None)
        and not SHARE.wrong("auto")
        and not SHARE.wrong(True)
    )
    assert "each" in SHARE.wrong([[0.1, 0.2], [0.3, 7]])
    assert range_of(list[Annotated[int, SHARE]]) == SHARE and range_of(int) is None and get_args(SHARE) == ()


def test_a_number_out_of_range_ends_with_3_and_one_line_also_from_a_file(tmp_path, capsys):
    (tmp_path / "c.yaml").write_text("fusion: {voxel: -2}\n")
    assert main(["densify", "D", "-o", str(tmp_path / "out"), "--config", str(tmp_path / "c.yaml")]) == 3
    err = capsys.readouterr().err
    assert f"{tmp_path / 'c.yaml'}: --fusion.voxel: -2" in err and err.count("\n") == 1
    assert "--frames" in told("synth", ["-o", "O", "--frames", "1.5"], capsys)


if __name__ == "__main__":
    print(sum(len(number_options(verb)) for verb in VERBS), "number options of", len(VERBS), "verbs")
