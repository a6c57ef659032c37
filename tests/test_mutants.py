"""The planting of faults by `make mutants`: where it plants them, and where never."""

from __future__ import annotations

import ast

from mutants.__main__ import drawn
from mutants.operators import planted, sites

SOURCE = '''
"""Words with 1 in them."""
from typing import Annotated

STEP: Annotated[int, 3] = 4


def reach(length: float, least: int = 0) -> float:
    """Up to 5."""
    assert length > -1, f"length {length + 1}"
    if not length:
        raise ValueError("length", 7)
    for i in range(least):
        length += i
    return min(length, STEP) + [1.0, 2.0][1:][0]
'''


def shown() -> list[str]:
    return [fault.shown(SOURCE) for site in sites(SOURCE) for fault in site.faults]


def test_faults_are_planted_in_what_is_calculated_compared_returned_and_done():
    found = " ; ".join(shown())
    planted_here = (
        "[4 -> 5]",
        "[0 -> 1]",
        "[length > -1 -> length >= -1]",
        "[not length -> length]",
        "[raise ValueError('length', 7) -> nothing]",
        "[length += i -> nothing]",
        "[length += i -> length -= i]",
        "[min(length, STEP) -> max(length, STEP)]",
        "[1: -> :]",
        "[1.0 -> 2.0]",
    )
    assert [fault for fault in planted_here if fault not in found] == []


def test_no_fault_is_planted_in_words_annotations_and_messages():
    for words in ("[3 -> ", "[5 -> ", "[7 -> ", "[length + 1 -> "):
        assert not any(words in text for text in shown())


def test_every_fault_changes_the_code_and_still_compiles():
    whole = ast.unparse(ast.parse(SOURCE))
    for site in sites(SOURCE):
        for fault in site.faults:
            tree = planted(SOURCE, fault)
            compile(tree, "reach.py", "exec")
            assert ast.unparse(tree) != whole


def test_a_seed_draws_the_same_faults_again_and_another_seed_others():
    first, again, other = ([m.name for m in drawn(seed, 20)] for seed in (1, 1, 2))
    assert first == again and first != other
