"""train/in_pieces.sh: calls of limited time, one after another, until every seed's run is whole."""

from __future__ import annotations

import os
import subprocess
import tarfile
from pathlib import Path

SCRIPT = Path(__file__).resolve().parents[1] / "train" / "in_pieces.sh"
# It needs two calls of each seed, as a training does that outlasts the first.
PROGRAM = """#!/bin/sh
while [ "$1" != -o ]; do shift; done
mkdir -p "$2/checkpoints" "$2/.state/colons"
if [ -f "$2/checkpoints/last.ckpt" ]; then echo {} > "$2/run.json"; exit 0; fi
echo half > "$2/checkpoints/last.ckpt"
exit 143
"""


def call(folder: Path) -> subprocess.CompletedProcess[str]:
    program = folder / "program"
    program.write_text(PROGRAM, encoding="utf-8")
    program.chmod(0o755)
    environment = {**os.environ, "LIGHTDEPTH": str(program), "SEEDS": "1 2"}
    return subprocess.run(
        ["bash", SCRIPT, "both", folder / "runs"], env=environment, capture_output=True, text=True, timeout=60
    )


def test_calls_go_on_from_what_the_one_before_packed_until_all_seeds_are_done(tmp_path):
    codes = []
    for _ in range(4):
        done = call(tmp_path)
        codes.append(done.returncode)
        (tmp_path / "runs").rename(tmp_path / f"bare{len(codes)}")  # the next machine has nothing but the packed file
        if done.returncode == 0:
            break
    assert codes == [75, 75, 0], done.stderr
    with tarfile.open(tmp_path / "runs.tar.gz") as packed:
        names = packed.getnames()
    assert {"runs/both-1/run.json", "runs/both-2/run.json"} <= set(names)
    assert not [name for name in names if "checkpoints" in name or ".state" in name]
