"""What a refusal says, told by its fields: where, what was found there, and the cure; and what a warning names."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from lightdepth.errors import InputError


@contextmanager
def refused(*said: str, where: str = "", found: str = "", cure: str = "") -> Iterator[pytest.ExceptionInfo[InputError]]:
    """The block raises an InputError whose fields hold these texts; each of `said` is in one of the three.

    One of `said` may be of several such texts, with " … " between them.
    """
    with pytest.raises(InputError) as raised:
        yield raised
    error = raised.value
    assert where in error.where, f"where: {error}"
    assert found in error.found, f"found: {error}"
    assert cure in error.cure, f"cure: {error}"
    for text in (part for one in said for part in one.split(" … ")):
        assert any(text in field for field in (error.where, error.found, error.cure)), f"{text!r}: {error}"


@contextmanager
def warned(*named: str) -> Iterator[pytest.WarningsRecorder]:
    """The block warns of something in one sentence that names all of these."""
    with pytest.warns(UserWarning) as seen:
        yield seen
    messages = [str(w.message) for w in seen]
    assert any(all(name in message for name in named) for message in messages), messages
