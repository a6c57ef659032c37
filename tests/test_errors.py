"""An error of the user's input says where, what was found, and the cure, wherever it is made and goes."""

from __future__ import annotations

import ast
import copy
import pickle
import re
from itertools import pairwise
from pathlib import Path

import pytest
from raising import refused

from lightdepth.errors import InputError
from lightdepth.files.reading import check_bytes

ROOT = Path(__file__).parents[1]


def made_without_three_fields(source: str) -> list[int]:
    """The lines on which an InputError is made with other than where, found and cure, or with an empty one."""
    calls = [
        node
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Call) and "InputError" in (getattr(node.func, "id", ""), getattr(node.func, "attr", ""))
    ]

    def whole(call: ast.Call) -> bool:
        given = [*call.args, *(keyword.value for keyword in call.keywords)]
        empty = any(isinstance(a, ast.Constant) and not a.value for a in given)
        return len(given) == 3 and not empty and not any(isinstance(a, ast.Starred) for a in given)

    return [call.lineno for call in calls if not whole(call)]


@pytest.mark.parametrize("package", ["lightdepth", "densify", "train"])
def test_every_input_error_says_where_what_was_found_and_the_cure(package):
    bare = {
        f"{path.relative_to(ROOT)}:{line}"
        for path in (ROOT / package).rglob("*.py")
        for line in made_without_three_fields(path.read_text())
    }
    assert not bare


def test_an_input_error_without_its_fields_is_seen():
    assert made_without_three_fields('raise InputError("a.png: broken")') == [1]
    assert made_without_three_fields('x = 1\nraise errors.InputError("a.png", "broken", "")') == [2]
    assert made_without_three_fields("raise InputError(*what)") == [1]
    assert not made_without_three_fields('raise InputError("a.png", found="broken", cure="copy it again")')


def test_a_message_is_where_found_and_cure():
    error = InputError(Path("a") / "b.png", "0 bytes", "copy it again")
    assert str(error) == "a/b.png: 0 bytes; copy it again"
    assert (error.where, error.found, error.cure) == ("a/b.png", "0 bytes", "copy it again")


@pytest.mark.parametrize("fields", [("", "b", "c"), ("a", "", "c"), ("a", "b", "")])
def test_an_empty_field_is_our_own_mistake(fields):
    with pytest.raises(AssertionError):
        InputError(*fields)


def test_an_error_told_of_a_place_inside_a_file_names_the_file_first():
    outer = InputError("light", "gamma 0", "expected 2.2").within(Path("light.json"))
    with refused(where="light.json: light", found="gamma 0", cure="expected 2.2"):
        raise outer


def test_an_error_comes_back_from_another_process_and_from_a_copy():
    error = InputError("a.png", "0 bytes", "copy it again").within("seq")
    for other in (pickle.loads(pickle.dumps(error)), copy.copy(error), copy.deepcopy(error)):
        assert type(other) is InputError and str(other) == str(error)
        assert (other.where, other.found, other.cure) == ("seq: a.png", "0 bytes", "copy it again")


_NO_VOWEL = {"config.kind", "MAPS", "RECORD", "self.kind", "a"}
"""What stands behind a written `a` and never begins with a vowel that is heard as one: kinds of networks (`a unet`) and
of boards, names of ours, and a title's own letter."""


def written_articles(source: str) -> set[str]:
    """The values that texts put behind an `a` or `an` of their own, whatever they begin with."""
    found = set()
    for text in (node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.JoinedStr)):
        for before, value in pairwise(text.values):
            words = str(before.value) if isinstance(before, ast.Constant) else ""
            if isinstance(value, ast.FormattedValue) and re.search(r"(^|[^\w'])an? $", words, re.IGNORECASE):
                found.add(ast.unparse(value.value))
    return found


def test_no_text_writes_an_article_before_a_value_that_it_may_not_fit():
    packages = [ROOT / package for package in ("lightdepth", "densify", "train")]
    found = {name for at in packages for path in at.rglob("*.py") for name in written_articles(path.read_text())}
    assert found <= _NO_VOWEL, found - _NO_VOWEL


def test_a_file_that_is_too_large_is_told_of_with_the_article_of_its_kind():
    for what, said in (("image", "an image"), ("mask", "a mask")):
        with refused(cure=f"expected {said} of at most 1 bytes"):
            check_bytes(2, 1, "x.png", what)
