"""The tests of trust: a warm process for all of them."""

import pytest
from warm import Warm


@pytest.fixture(scope="session")
def warm():
    warm = Warm()
    yield warm
    warm.close()
