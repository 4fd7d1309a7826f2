"""What all tests share: an offline LeRobot, and where the recordings of the original simulator are."""

import os
import sys
from pathlib import Path

import pytest

os.environ.setdefault("HF_HUB_OFFLINE", "1")
os.environ.setdefault("WANDB_MODE", "disabled")
if "PYTEST_XDIST_WORKER" in os.environ:  # each has a core of its own
    os.environ.setdefault("OMP_NUM_THREADS", "1")


LONGEST = (
    "test_demonstrator.py",
    "test_commands.py",
    "test_takeovers.py",
    "test_readme.py",
    "test_learning.py",
    "test_peers.py",
    "test_lansar_eval.py",
    "test_training.py",
    "test_thesis.py",
    "test_hub.py",
    "test_peers_commands.py",
    "test_jobs.py",
    "test_record.py",
    "test_play.py",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest files first: workers take whole files in this order, and the short ones fill up the end."""
    items.sort(key=lambda item: LONGEST.index(item.path.name) if item.path.name in LONGEST else len(LONGEST))


SHARED = Path(__file__).resolve().parents[2] / "shared"


def _shared(name: str) -> Path:
    folder = SHARED / name
    if not folder.is_dir():
        pytest.skip(f"needs {name}/ of the developers' shared folder, which a user's clone does not have")
    return folder


@pytest.fixture(scope="session")
def golden() -> Path:
    """Recordings of the original simulator."""
    return _shared("golden")


@pytest.fixture(scope="session")
def spec() -> Path:
    """The thesis and notes on CALVIN, as text."""
    return _shared("spec")


@pytest.fixture(scope="session")
def original_assets() -> Path:
    """The original CALVIN asset files."""
    return _shared("calvin_assets")


SBATCH = """#!/usr/bin/env python3
import os, re, subprocess, sys
script = open(sys.argv[-1]).read()
if "merge_stats" in script:  # datatrove's own summary, which nobody reads
    print("Submitted batch job 42")
    sys.exit()
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


@pytest.fixture
def slurm(tmp_path):
    """A PATH on which scripts stand in for Slurm's commands; they run the arrays that datatrove submits, job scripts
    and all, here."""
    for name, text in (("sbatch", SBATCH), ("srun", SRUN), ("scontrol", "#!/bin/sh\necho here\n")):
        (tmp_path / name).write_text(text)
        (tmp_path / name).chmod(0o755)
    return f"{tmp_path}:{Path(sys.executable).parent}:{os.environ['PATH']}"
