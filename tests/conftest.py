"""What several test files stand on."""

import pytest

import train
from aser.study.statistics import estimates


@pytest.fixture
def house(tmp_path, monkeypatch):
    """A checkout whose results are its own."""
    (tmp_path / "conf").symlink_to(train.CONF)
    monkeypatch.setattr(train, "CONF", tmp_path / "conf")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def few_resamples():
    """Tables of scores in a moment, where nobody looks at their intervals."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(estimates, "RESAMPLES", 20)
        yield
