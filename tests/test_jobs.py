"""Work in local processes ends as it should; under Slurm and on Ray it gives the same files."""

import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from lerobot_lansar.jobs import executors
from lerobot_lansar.jobs.work import SlurmConfig, WorkerDied

OPTIONS = [
    "--cameras=[]",
    "--episodes=9",
    "--validation_episodes=1",
    "--tasks=[turn_on_led,open_drawer]",
    "--seed=5",
]


def run(module, output, *options, **environment):
    command = [sys.executable, "-m", module, f"--output_dir={output}", *options]
    done = subprocess.run(command, env={**os.environ, **environment}, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    return done.stdout


def record(output, *options, **environment):
    return run("lerobot_lansar.demos.record", output, *OPTIONS, *options, **environment)


def convert(root, output, *options, **environment):
    fixed = [f"--root={root}", "--repo_id=me/desk", "--images=none"]
    return run("dataset_convert", output, *fixed, *options, **environment)


def frames(folder):
    return {file.name: dict(np.load(file)) for file in sorted(folder.rglob("episode_*.npz"))}


def assert_same(one, other):
    a, b = frames(one), frames(other)
    assert a.keys() == b.keys()
    assert a
    for name, frame in a.items():
        for key, value in frame.items():
            np.testing.assert_array_equal(value, b[name][key])
    for split in ("training", "validation"):  # bounds, scenes, statistics, windows and sentences
        notes = [{k: v for k, v in contents(folder / split).items() if k.suffix != ".npz"} for folder in (one, other)]
        assert notes[0] == notes[1]
        assert notes[0]


def contents(folder):
    return {file.relative_to(folder): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


@pytest.fixture(scope="module")
def local(tmp_path_factory):
    folder = tmp_path_factory.mktemp("local") / "desk"
    record(folder)
    return folder


@pytest.fixture(scope="module")
def converted(local, tmp_path_factory):
    folder = tmp_path_factory.mktemp("converted") / "out"
    convert(local, folder)
    return folder


def test_slurm_jobs_record_the_same(local, slurm, tmp_path):
    printed = record(tmp_path / "desk", "--executor=slurm", "--workers=2", "--slurm.partition=cpu", PATH=slurm)
    assert "submitted" in printed
    assert_same(local, tmp_path / "desk")
    script = (tmp_path / "desk" / ".recording-slurm" / "work" / "launch_script.slurm").read_text()
    assert "#SBATCH --partition=cpu" in script
    assert "#SBATCH --array=0-2%2" in script
    done = subprocess.run(
        [sys.executable, "-m", "lerobot_lansar.demos.record", f"--output_dir={tmp_path / 'desk'}", *OPTIONS],
        capture_output=True,
        text=True,
    )
    assert "already holds a recording (training, validation)" in done.stderr


def leave_note(folder, shard):
    (folder / f"{shard}").touch()


LARGE = b"x" * 1_000_000  # a worker must read it before the next one is started


def misbehave(folder, how, _, shard):
    """Shard 0 leaves its process id and works for ever; shard 1 ends its process, or raises, at once or once told."""
    note = folder / "process"
    if shard == 0:
        note.write_text(str(os.getpid()))
        time.sleep(600)
    while not (note.exists() and note.read_text()):
        time.sleep(0.01)
    if how == "dies":
        os.kill(os.getpid(), signal.SIGKILL)
    while how == "raises when told" and not (folder / "told").exists():
        time.sleep(0.01)
    raise ValueError(f"shard {shard} failed")


def run_here(work, finish, workers=2, shards=4):
    return executors.run_shards(
        work,
        shards,
        finish,
        executor="local",
        workers=workers,
        slurm=SlurmConfig(),
        logging_dir=Path("unused"),
        progress=lambda: 0,
        total=shards,
        unit="shard",
    )


def is_gone(process, seconds=30):
    deadline = time.time() + seconds
    while time.time() < deadline:
        try:
            os.kill(process, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.05)
    return False


@pytest.mark.parametrize("workers", [1, 2])
def test_local_work_runs_all_shards_before_the_finishing_step(workers, tmp_path):
    done, finished = tmp_path / "done", tmp_path / "finished"
    done.mkdir()
    finished.mkdir()
    assert run_here((leave_note, (done,)), (leave_note, (finished,)), workers)
    assert sorted(note.name for note in done.iterdir()) == ["0", "1", "2", "3"]
    assert [note.name for note in finished.iterdir()] == ["0"]


@pytest.mark.parametrize(
    ("how", "error", "message"),
    [("dies", WorkerDied, "a worker process was killed"), ("raises", ValueError, "shard 1 failed")],
)
@pytest.mark.parametrize(("main_thread", "shards"), [(True, 4), (False, 4), (True, 2)])
def test_a_worker_that_dies_or_fails_ends_the_others(how, error, message, main_thread, shards, tmp_path):
    """Also when the work was begun from another thread than the main one, and when no shard is waiting."""
    arguments = (misbehave, (tmp_path, how, LARGE)), (leave_note, (tmp_path,)), 2, shards
    with ThreadPoolExecutor(1) as thread, pytest.raises(error, match=message):
        run_here(*arguments) if main_thread else thread.submit(run_here, *arguments).result()
    assert not (tmp_path / "0").exists(), "the finishing step must not run"
    assert is_gone(int((tmp_path / "process").read_text()))


def test_a_worker_that_fails_leaves_processes_of_other_threads_alone(tmp_path):
    other = multiprocessing.get_context("spawn").Process(target=time.sleep, args=(600,))
    with ThreadPoolExecutor(1) as thread:
        work = thread.submit(run_here, (misbehave, (tmp_path, "raises when told", LARGE)), (leave_note, (tmp_path,)))
        while not (tmp_path / "process").exists():
            time.sleep(0.01)
        other.start()
        (tmp_path / "told").touch()
        with pytest.raises(ValueError, match="shard 1 failed"):
            work.result()
    assert is_gone(int((tmp_path / "process").read_text()))
    assert other.is_alive()
    other.kill()
    other.join()


def test_slurm_runs_work_again_whose_results_were_deleted_and_whose_submission_failed(slurm, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", slurm)
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent))  # the jobs import leave_note
    done, finished = tmp_path / "done", tmp_path / "finished"
    finished.mkdir()

    def submit():
        done.mkdir()
        return executors.run_shards(
            (leave_note, (done,)),
            3,
            (leave_note, (finished,)),
            executor="slurm",
            workers=2,
            slurm=SlurmConfig(partition="cpu", shards_per_job=2),
            logging_dir=tmp_path / "logs",
            progress=lambda: 0,
            total=3,
            unit="note",
        )

    refuse = 'if "--job-name=lansar-finish" in script:\n    sys.exit("too many jobs")\narray ='
    sbatch = (tmp_path / "sbatch").read_text()
    (tmp_path / "sbatch").write_text(sbatch.replace("array =", refuse, 1))
    (tmp_path / "scancel").write_text(f"#!/bin/sh\necho $@ > {tmp_path}/cancelled\n")
    (tmp_path / "scancel").chmod(0o755)
    with pytest.raises(subprocess.CalledProcessError):
        submit()
    assert set((tmp_path / "cancelled").read_text().split()) == {"42"}, "jobs without a finish run for nothing"
    assert not list(finished.iterdir())
    (tmp_path / "sbatch").write_text(sbatch)
    for _ in range(2):
        shutil.rmtree(done)
        assert not submit()
        assert sorted(note.name for note in done.iterdir()) == ["0", "1", "2"]
        (finished / "0").unlink()


def test_slurm_without_sbatch_is_refused(tmp_path):
    command = [
        sys.executable,
        "-m",
        "lerobot_lansar.demos.record",
        f"--output_dir={tmp_path / 'desk'}",
        "--executor=slurm",
    ]
    environment = {**os.environ, "PATH": str(tmp_path)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 2
    assert "needs Slurm's sbatch" in done.stderr
    assert not (tmp_path / "desk").exists()


def test_ray_records_the_same(local, tmp_path):
    pytest.importorskip("ray", reason="needs the extra ray")
    record(tmp_path / "desk", "--executor=ray", "--workers=2")
    assert_same(local, tmp_path / "desk")


def test_slurm_jobs_convert_the_same(local, converted, slurm, tmp_path):
    options = ["--executor=slurm", "--workers=2", "--slurm.partition=cpu", "--slurm.shards_per_job=8"]
    convert(local, tmp_path / "out", *options, PATH=slurm)
    script = (tmp_path / "out.slurm_logs" / "work" / "launch_script.slurm").read_text()
    assert "#SBATCH --partition=cpu" in script
    assert contents(tmp_path / "out") == contents(converted)


def test_ray_converts_the_same(local, converted, tmp_path):
    pytest.importorskip("ray", reason="needs the extra ray")
    convert(local, tmp_path / "out", "--executor=ray", "--workers=2")
    assert contents(tmp_path / "out") == contents(converted)
