"""Fixtures of the converter's tests."""

import pytest
from fake_calvin import write_calvin


@pytest.fixture(autouse=True)
def _offline(tmp_path_factory, monkeypatch):
    home = tmp_path_factory.mktemp("hf")  # not in tmp_path, which tests look into
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setenv("HF_HOME", str(home))


@pytest.fixture
def calvin(tmp_path):
    """Four windows in scene D without pictures."""
    return write_calvin(tmp_path / "calvin")
