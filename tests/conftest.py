"""What all tests share: an offline LeRobot, and where the recordings of the original simulator are."""

import os
from pathlib import Path

import pytest

os.environ.setdefault("HF_HUB_OFFLINE", "1")
os.environ.setdefault("WANDB_MODE", "disabled")
if "PYTEST_XDIST_WORKER" in os.environ:  # each has a core of its own
    os.environ.setdefault("OMP_NUM_THREADS", "1")

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
def original_assets() -> Path:
    """The original CALVIN asset files."""
    return _shared("calvin_assets")
