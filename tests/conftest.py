"""What several test files stand on."""

import pytest

import train


@pytest.fixture
def house(tmp_path, monkeypatch):
    """A checkout whose results are its own."""
    (tmp_path / "conf").symlink_to(train.CONF)
    monkeypatch.setattr(train, "CONF", tmp_path / "conf")
    monkeypatch.chdir(tmp_path)
    return tmp_path
