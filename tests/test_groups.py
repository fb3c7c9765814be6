"""Tests of a group go to one worker, which makes once what they share."""

import pytest


@pytest.mark.xdist_group("a group")
def test_the_scheduler_is_told_of_a_group(request):
    if not request.config.getoption("loadgroup", False):
        pytest.skip("no worker of --dist loadgroup runs this")
    assert request.node.nodeid.endswith("@a group")
