"""The page of the committed results, made once."""

from pathlib import Path

import pytest

pytest.importorskip("plotly", reason="the extra `page` is not installed")

ROOT = Path(__file__).parents[3]


@pytest.fixture(scope="session")
def site(tmp_path_factory):
    from aser.study.page import site

    out = tmp_path_factory.mktemp("page") / "site"
    assert site.write(ROOT, out) == out / "index.html"
    return out
