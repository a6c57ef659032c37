import os
from pathlib import Path

import pytest
import torch

torch.set_num_threads(1)


@pytest.fixture(scope="session")
def realdata() -> Path:
    """The folder of real data, which is never part of the project. Tests that need it are skipped without it."""
    beside_project = Path(__file__).resolve().parents[2] / "shared" / "realdata"
    folder = Path(os.environ.get("LIGHTDEPTH_REALDATA") or beside_project)
    if not folder.is_dir():
        pytest.skip(f"no real data: set LIGHTDEPTH_REALDATA, or put it at {beside_project}")
    return folder
