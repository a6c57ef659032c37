"""Every parser on what has ever broken one, and on a few hundred new inputs that a fixed seed draws.

`make fuzz` draws new ones for hours, in processes of their own with a limit of memory.
"""

from __future__ import annotations

import pytest
from fuzz import CORPUS, Fuzzing
from strangers import PARSERS

INPUTS = 100


@pytest.mark.parametrize("name", PARSERS)
def test_what_a_parser_makes_of_spoilt_files_is_an_input_error_or_nothing(name, tmp_path, capfd):
    fuzzing = Fuzzing(PARSERS[name], tmp_path, seed=0, keeping=False)
    fuzzing.again()
    for _ in range(INPUTS):
        fuzzing.one(*fuzzing.drawn())
    assert fuzzing.found.findings == {}


@pytest.mark.parametrize("name", PARSERS)
def test_the_samples_of_a_parser_are_read_as_they_are(name, tmp_path, capfd):
    fuzzing = Fuzzing(PARSERS[name], tmp_path, seed=0, keeping=False)
    accepted = [not fuzzing.one(i, sample.content) for i, sample in enumerate(fuzzing.samples)]
    assert sum(accepted) >= len(accepted) - (name == "depth in NPZ")  # whose last sample is repaired into one


def test_the_corpus_belongs_to_parsers_that_there_are():
    assert {folder.name for folder in CORPUS.iterdir()} <= PARSERS.keys() if CORPUS.is_dir() else True
