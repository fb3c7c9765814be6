"""The notebooks as committed. Pytest runs them too, by nbmake."""

import json
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
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


def test_the_criterion_is_that_of_the_readme():
    (example,) = re.findall(
        r"<!-- example: my_criteria.py -->\n```python\n(.*?)```",
        (ROOT / "README.md").read_text(),
        re.DOTALL,
    )
    sources = ["".join(cell["source"]) for cell in cells(NOTEBOOKS[-1], "code")]
    assert NOTEBOOKS[-1].stem == "own_criterion"
    assert f"%%writefile my_criteria.py\n{example.strip()}" in sources
