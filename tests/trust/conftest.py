"""The tests of trust: a warm process for all of them, and slow ones that must be asked for."""

import pytest
from warm import Warm


def pytest_collection_modifyitems(config, items):
    if "slow" not in config.option.markexpr:
        wait = pytest.mark.skip(reason="takes minutes: pytest -m slow tests/trust")
        for item in items:
            if "slow" in item.keywords:
                item.add_marker(wait)


@pytest.fixture(scope="session")
def warm():
    warm = Warm()
    yield warm
    warm.close()
