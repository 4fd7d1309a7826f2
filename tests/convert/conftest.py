"""Fixtures of the converter's tests."""

import pytest
from fake_calvin import write_calvin


@pytest.fixture(autouse=True)
def _offline(tmp_path, monkeypatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setenv("HF_HOME", str(tmp_path / "hf"))


@pytest.fixture
def calvin(tmp_path):
    """Four windows in scene D without pictures."""
    return write_calvin(tmp_path / "calvin")
