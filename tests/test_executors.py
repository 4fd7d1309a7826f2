"""Work under Slurm and on Ray gives the same files as in local processes."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

OPTIONS = [
    "--cameras=[]", "--episodes=9", "--validation_episodes=1", "--tasks=[turn_on_led,open_drawer]", "--seed=5",
]  # fmt: skip

SBATCH = """#!/usr/bin/env python3
import os, re, subprocess, sys
script = open(sys.argv[-1]).read()
array = re.search(r"--array=(\\d+)-(\\d+)", script)
for index in range(int(array[1]), int(array[2]) + 1):
    environment = {
        **os.environ, "SLURM_ARRAY_TASK_ID": str(index), "SLURM_NODELIST": "here"
    }
    subprocess.run(["bash", sys.argv[-1]], env=environment, stdout=sys.stderr, stderr=sys.stderr)
print("Submitted batch job 42")
"""

SRUN = """#!/bin/sh
shift 3
exec "$@"
"""


def record(output, *options, **environment):
    command = [
        sys.executable,
        "-m",
        "lerobot_lansar.demos.record",
        f"--output_dir={output}",
        *OPTIONS,
        *options,
    ]
    done = subprocess.run(
        command, env={**os.environ, **environment}, capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def frames(folder):
    return {file.name: dict(np.load(file)) for file in sorted(folder.rglob("episode_*.npz"))}


def assert_same(one, other):
    a, b = frames(one), frames(other)
    assert a.keys() == b.keys()
    assert a
    for name, frame in a.items():
        for key, value in frame.items():
            np.testing.assert_array_equal(value, b[name][key])


@pytest.fixture(scope="module")
def local(tmp_path_factory):
    folder = tmp_path_factory.mktemp("local") / "desk"
    record(folder)
    return folder


def test_slurm_jobs_record_the_same(local, tmp_path):
    """Scripts stand in for Slurm's commands and run the arrays that datatrove submits, job scripts and all, here."""
    for name, text in (("sbatch", SBATCH), ("srun", SRUN), ("scontrol", "#!/bin/sh\necho here\n")):
        (tmp_path / name).write_text(text)
        (tmp_path / name).chmod(0o755)
    path = f"{tmp_path}:{Path(sys.executable).parent}:{os.environ['PATH']}"
    printed = record(tmp_path / "desk", "--executor=slurm", "--workers=2", "--slurm.partition=cpu", PATH=path)
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
