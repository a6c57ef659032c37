"""Slurm takes a job back into its queue: `sbatch --signal=USR1@90` warns it, the run saves itself and asks for that."""

from __future__ import annotations

import os
import re
import signal
import subprocess

_INTERACTIVE = ("bash", "interactive")
"""Names that Slurm gives the jobs of people at a terminal; Lightning looks at the same."""
QUEUED = "is in the queue again"


def requeued(number: int) -> str:
    """Asks Slurm to start this job again, and says what came of it; empty where the signal asks for nothing of it.

    The job is one of `sbatch`, the signal SIGUSR1, and of several processes the first one asks.
    """
    job = os.environ.get("SLURM_JOB_ID", "")
    if array := os.environ.get("SLURM_ARRAY_JOB_ID"):
        job = f"{array}_{os.environ.get('SLURM_ARRAY_TASK_ID', '')}"
    first = os.environ.get("SLURM_PROCID", "0") == "0" and os.environ.get("LOCAL_RANK", "0") == "0"
    batch = os.environ.get("SLURM_JOB_NAME") not in _INTERACTIVE
    if number != signal.SIGUSR1 or not re.fullmatch("[0-9_]+", job) or not first or not batch:
        return ""
    try:
        asked = subprocess.run(
            ["scontrol", "requeue", job], capture_output=True, text=True, errors="replace", timeout=60, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"scontrol requeue {job} failed ({error})"
    if asked.returncode:
        said = " ".join(asked.stderr.split()) or f"exit code {asked.returncode}"
        return f"scontrol requeue {job} failed ({said})"
    return f"job {job} {QUEUED}"
