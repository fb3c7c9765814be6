"""What several test files stand on, and the slow tests, which must be asked for."""

import pytest
import torch

import train
from aser.study.statistics import estimates


def pytest_collection_modifyitems(config, items):
    if "slow" not in config.option.markexpr:
        wait = pytest.mark.skip(reason="takes long: pytest -m slow tests")
        for item in items:
            if "slow" in item.keywords:
                item.add_marker(wait)


@pytest.fixture(autouse=True)
def seeded():
    """A test's numbers do not depend on the tests before it."""
    torch.manual_seed(0)


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
