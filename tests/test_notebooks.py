"""The notebooks as committed. Pytest runs them too, by nbmake."""

import ast
import json
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
LARGEST = 200_000  # bytes
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


def cells(path: Path, kind: str) -> list[dict]:
    return [cell for cell in json.loads(path.read_text())["cells"] if cell["cell_type"] == kind]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_links_lead_somewhere(path):
    for cell in cells(path, "markdown"):
        for target in re.findall(r"\]\(([^)#\s]+)", "".join(cell["source"])):
            assert (path.parent / target).exists(), target


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_outputs_name_no_place_of_the_machine_and_no_error(path):
    for cell in cells(path, "code"):
        for output in cell["outputs"]:
            assert output["output_type"] != "error"
            data = output.get("data", {})
            texts = [output.get("text", ""), *(v for k, v in data.items() if k.startswith("text/"))]
            for text in map("".join, texts):
                found = re.search(r"(?<![\w/<.])/(?:tmp|home|root|work|usr|Users|var)\b\S*", text)
                assert not found, found


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_readers_on_github_see_what_it_gives(path):
    """It is committed as it was run, from top to bottom."""
    code = cells(path, "code")
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1))
    for cell in code:
        source = "".join(cell["source"])
        last = ast.parse(re.sub(r"(?m)^%.*$", "", source)).body[-1]
        shows = isinstance(last, ast.Expr) and not isinstance(last.value, ast.Call)
        assert cell["outputs"] or not shows or source.startswith("%%capture"), source
    kinds = {kind for cell in code for output in cell["outputs"] for kind in output.get("data", {})}
    assert kinds & {"image/png", "text/html"} and path.stat().st_size < LARGEST


def test_the_first_run_shows_its_curve_and_an_episode():
    (path,) = [path for path in NOTEBOOKS if path.stem == "first_run"]
    outputs = [output for cell in cells(path, "code") for output in cell["outputs"]]
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 2


def test_the_criterion_is_that_of_the_readme():
    (example,) = re.findall(
        r"<!-- example: my_criteria.py -->\n```python\n(.*?)```",
        (ROOT / "README.md").read_text(),
        re.DOTALL,
    )
    sources = ["".join(cell["source"]) for cell in cells(NOTEBOOKS[-1], "code")]
    assert NOTEBOOKS[-1].stem == "own_criterion"
    assert f"%%writefile my_criteria.py\n{example.strip()}" in sources
