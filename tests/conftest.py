import functools
import os
from pathlib import Path

import pytest
import torch
from docstring_parser import attrdoc

torch.set_num_threads(1)
os.environ["LIGHTDEPTH_HEARTBEAT"] = "off"  # on a busy machine it has more to say

# Each run of a verb in this process reads the sentences of its options from the sources anew; once is enough here.
_read = functools.cache(functools.partial(attrdoc.AttributeDocstrings.get_attr_docs, attrdoc.AttributeDocstrings()))
attrdoc.AttributeDocstrings.get_attr_docs = lambda self, component: _read(component)


@pytest.fixture(scope="session")
def realdata() -> Path:
    """The folder of real data, which is never part of the project. Tests that need it are skipped without it."""
    beside_project = Path(__file__).resolve().parents[2] / "shared" / "realdata"
    folder = Path(os.environ.get("LIGHTDEPTH_REALDATA") or beside_project)
    if not folder.is_dir():
        pytest.skip(f"no real data: set LIGHTDEPTH_REALDATA, or put it at {beside_project}")
    return folder
