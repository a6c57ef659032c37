"""Processes side by side: what is lost with one, what they leave, and when they end; and jobs of a cluster."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import pytest
from raising import refused

from densify.batch import cluster
from densify.batch.cluster import Gone, Share, SlurmConfig, check_cluster, submitted
from densify.batch.workers import Lost, worked

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="processes are ended by signals")


@dataclass(frozen=True)
class Work:
    """Writes its start into a folder; a task is a word that says what to do."""

    folder: Path

    def __call__(self):
        (self.folder / f"start-{os.getpid()}").write_text("")
        return self.do

    def do(self, task: str) -> str:
        word, _, number = task.partition(" ")
        if word == "die":
            os.kill(os.getpid(), signal.SIGKILL)
        if word == "fault":
            raise RuntimeError("a fault")
        if word == "wait":
            (self.folder / f"at-{os.getpid()}").write_text("")
            time.sleep(60)
        threads = ",".join(os.environ.get(f"{name}_NUM_THREADS", "") for name in ("OMP", "NUMBA"))
        return f"{number} {threads}"


def alive(folder: Path) -> list[int]:
    """The processes that began in a folder and live."""
    pids = [int(path.name.partition("-")[2]) for path in folder.glob("start-*")]
    return [pid for pid in pids if Path(f"/proc/{pid}/cmdline").exists() and Path(f"/proc/{pid}/cmdline").read_bytes()]


def until(true, seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "too long"
        time.sleep(0.05)


def test_two_processes_do_all_tasks_with_their_threads_and_one_that_dies_loses_its_task_alone(tmp_path):
    tasks = ["do 0", "do 1", "die 2", "do 3", "do 4", "fault 5", "do 6"]
    before = {name: os.environ.get(name) for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS")}
    found = dict(worked(tasks, Work(tmp_path), 2, 3))
    assert {name: os.environ.get(name) for name in before} == before
    assert set(found) == set(tasks)
    lost = {task for task, result in found.items() if isinstance(result, Lost)}
    assert lost == {"die 2", "fault 5"}
    assert "killed by SIGKILL" in str(found["die 2"]) and "memory" in str(found["die 2"])
    assert str(found["fault 5"]) == "its process ended with 1"
    assert all(found[task] == f"{task[-1]} 3,3" for task in tasks if task not in lost)
    assert 2 <= len(list(tmp_path.glob("start-*"))) <= 4  # each starts once, whatever the number of its tasks
    until(lambda: not alive(tmp_path))


def test_processes_that_are_at_work_end_when_the_loop_is_left(tmp_path):
    for task, _ in worked(["wait 0", "do 1"], Work(tmp_path), 2):
        assert task == "do 1"
        until(lambda: list(tmp_path.glob("at-*")))
        break
    until(lambda: not alive(tmp_path))


def test_processes_end_when_the_one_that_started_them_is_killed(tmp_path):
    program = "\n".join(
        (
            "import sys; sys.path.insert(0, sys.argv[1])",
            "if __name__ == '__main__':",
            "    from pathlib import Path",
            "    from densify.batch.workers import worked",
            "    from test_batch_workers import Work",
            "    list(worked(['wait 0', 'wait 1'], Work(Path(sys.argv[2])), 2))",
        )
    )
    (tmp_path / "program.py").write_text(program)
    here = Path(__file__).parent
    environment = os.environ | {"PYTHONPATH": os.pathsep.join((str(here.parent), str(here)))}
    with subprocess.Popen(
        [sys.executable, str(tmp_path / "program.py"), str(here), str(tmp_path)], env=environment
    ) as one:
        until(lambda: len(list(tmp_path.glob("at-*"))) == 2)
        assert len(alive(tmp_path)) == 2
        one.kill()
    until(lambda: not alive(tmp_path))


# ---- jobs, by submitit's executors that need no cluster


def test_shares_run_as_jobs_and_one_that_fails_loses_its_own_tasks_alone(tmp_path, monkeypatch):
    pytest.importorskip("submitit")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join((str(Path(__file__).parents[1]), str(Path(__file__).parent))))
    shares = [["do 0", "do 1"], [], ["fault 2", "do 3"]]
    found = dict(submitted(shares, Work(tmp_path), SlurmConfig(minutes=2), tmp_path / "jobs", 2, cluster="local"))
    assert found["do 0"] == "0 2,2" and found["do 1"] == "1 2,2"
    assert isinstance(found["fault 2"], Gone) and isinstance(found["do 3"], Gone)
    assert str(found["fault 2"]) == "its job ended: RuntimeError: a fault"


def test_a_job_that_is_queued_again_is_the_same_job():
    pytest.importorskip("submitit")
    share = Share(Work(Path()), ["do 0"], 1)
    assert share.checkpoint().function is share


def test_what_slurm_is_asked_for_is_what_submitit_knows(monkeypatch):
    submitit = pytest.importorskip("submitit")
    monkeypatch.setattr(shutil, "which", lambda name: f"/usr/bin/{name}")
    executor = submitit.AutoExecutor(folder="unused-%j", cluster="slurm")
    config = SlurmConfig(partition="short", account="lab", minutes=30, memory_gb=6, gpus=1)
    executor.update_parameters(**cluster._parameters(config, 2, "slurm"))
    text = executor._executor._make_submission_file_text("command", "uid")
    for line in ("partition=short", "account=lab", "time=30", "mem=6GB", "cpus-per-task=2", "gpus-per-node=1"):
        assert f"#SBATCH --{line}" in text
    assert "export OMP_NUM_THREADS=2" in text


def test_where_jobs_cannot_be_submitted_that_is_said_before_any_work(monkeypatch):
    monkeypatch.setattr(cluster, "_submitit", lambda: None)
    monkeypatch.setattr(shutil, "which", lambda name: None)
    with refused("--executor slurm", found="no sbatch"):
        check_cluster()


def test_a_missing_submitit_is_told_with_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "submitit", None)
    with refused("--executor slurm", found="submitit is not installed", cure="lightdepth[slurm]"):
        check_cluster()
