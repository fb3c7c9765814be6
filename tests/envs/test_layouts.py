"""Layouts: generated mazes are perfect, ASCII is read back unchanged, errors are one line."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aser.envs import layouts
from aser.errors import ConfigError

LOOP = """\
#########
#S    ###
# # # ###
#      T#
#########
"""


def decisions_on_the_way(text: str) -> int:
    """Decision points between S and T of a perfect maze, by plain search over the characters."""
    lines = text.splitlines()
    (start,) = [
        (x, y) for y, line in enumerate(lines) for x, mark in enumerate(line) if mark == "S"
    ]

    def open_sides(x, y):
        return [
            (dx, dy)
            for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1))
            if lines[y + dy][x + dx] != "#"
        ]

    def search(x, y, came):
        if lines[y][x] == "T":
            return 0
        ahead = [side for side in open_sides(x, y) if side != came]
        for dx, dy in ahead:
            count = search(x + 2 * dx, y + 2 * dy, (-dx, -dy))
            if count is not None:
                return count + (len(ahead) >= 2)
        return None

    return search(*start, None)


def equal(one: layouts.Layout, other: layouts.Layout) -> bool:
    names = ("columns", "rows", "start", "goal")
    same = all(getattr(one, name) == getattr(other, name) for name in names)
    return same and (one.passages == other.passages).all()


def test_large_is_seed_0_of_12_by_10():
    assert (
        layouts.draw(layouts.generate(0, (12, 10))) == (layouts.SHIPPED / "large.txt").read_text()
    )


def test_toy_is_the_first_6_by_5_with_exactly_5_decision_points():
    counts = (
        decisions_on_the_way(layouts.draw(layouts.generate(seed, (6, 5)))) for seed in range(1000)
    )
    first = next(seed for seed, count in enumerate(counts) if count == 5)
    assert (
        layouts.draw(layouts.generate(first, (6, 5))) == (layouts.SHIPPED / "toy.txt").read_text()
    )


def test_loading_by_name():
    assert equal(layouts.load("large"), layouts.generate(0, (12, 10)))
    assert equal(layouts.load("random", 3, (4, 7)), layouts.generate(3, (4, 7)))
    assert (layouts.load("toy").columns, layouts.load("toy").rows, layouts.load("toy").cells) == (
        6,
        5,
        30,
    )


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**64), columns=st.integers(2, 9), rows=st.integers(2, 8))
def test_generated_mazes_are_perfect_and_survive_drawing(seed, columns, rows):
    layout = layouts.generate(seed, (columns, rows))
    # The edges of a tree, each counted from both ends.
    assert layout.passages.sum() == 2 * (columns * rows - 1)
    assert (layout.start, layout.goal) == (0, columns * rows - 1)
    for cell, heading in zip(*layout.passages.nonzero(), strict=True):
        assert layout.passages[layout.neighbour(cell, heading), 3 - heading]
    text = layouts.draw(layout)
    assert (len(text.splitlines()), len(text.splitlines()[0])) == (2 * rows + 1, 2 * columns + 1)
    assert equal(layouts.parse(text, "drawn"), layout)  # parse refuses unconnected cells


def test_seeds_name_different_mazes_for_good():
    drawn = [layouts.draw(layouts.generate(seed, (12, 10))) for seed in range(9)]
    assert len(set(drawn)) == 9
    assert (
        layouts.draw(layouts.generate(2, (3, 2))) == "#######\n#S#   #\n# ### #\n#    T#\n#######\n"
    )


def test_a_file_may_have_loops_and_missing_cells(tmp_path):
    file = tmp_path / "loop.txt"
    file.write_text(LOOP)
    layout = layouts.load(str(file))
    assert (layout.columns, layout.rows, layout.cells) == (4, 2, 7)
    assert layout.passages.sum() == 2 * 8  # two edges more than a tree of 7 cells
    assert layouts.draw(layout) == LOOP
    assert equal(layouts.load(file), layout)


@pytest.mark.parametrize(
    "text, problem",
    [
        (LOOP.replace("S", " "), "0 S (start): exactly one"),
        (LOOP.replace("T", " "), "0 T (end): exactly one"),
        (LOOP.replace("# # # #", "#T# # #"), "2 T (end)"),
        (LOOP.replace("S ", " S"), "1 S (start): exactly one, in a cell"),
        (LOOP.replace("# # # ###", "#########"), "column 1, row 2 is not connected to S"),
        (LOOP.replace("T#", "T "), "the border"),
        (LOOP.replace("# # # ###", "#   # ###"), "the border and every even place"),
        (LOOP.replace("S ", "SX"), "'X' is not allowed"),
        (LOOP.replace("S    #", "S    "), "as long as the first, which has 9"),
        ("####\n#ST#\n####\n", "4 x 3 characters: both must be odd"),
        ("#\n#\n#\n", "1 x 3"),
        ("", "0 x 1"),
    ],
)
def test_improper_layouts_are_refused_in_one_line(tmp_path, text, problem):
    file = tmp_path / "improper.txt"
    file.write_text(text)
    with pytest.raises(ConfigError) as refusal:
        layouts.load(str(file))
    message = str(refusal.value)
    assert message.startswith(f"env.layout={file}: ") and problem in message and "\n" not in message


@pytest.mark.parametrize(
    "arguments, problem",
    [
        (
            {"layout": "nowhere.txt"},
            "env.layout=nowhere.txt cannot be read (No such file or directory)",
        ),
        ({"layout": "."}, "env.layout=. cannot be read (Is a directory)"),
        ({"layout": 7}, "env.layout=7 cannot be read"),
        ({"layout": None}, "env.layout=None cannot be read"),
        ({"layout": "a\0b"}, "cannot be read"),
        ({"layout": "toy", "layout_seed": -1}, "env.layout_seed=-1: a whole number of at least 0"),
        ({"layout": "random", "layout_seed": 1.5}, "env.layout_seed=1.5: "),
        ({"layout": "random", "layout_seed": True}, "env.layout_seed=True: "),
        ({"layout": "random", "size": (12,)}, "env.size=(12,): allowed are [columns, rows]"),
        ({"layout": "random", "size": (1, 5)}, "env.size=(1, 5): "),
        ({"layout": "random", "size": (5, 10**9)}, "from 2 to 100"),
        ({"layout": "random", "size": "12x10"}, "env.size=12x10: "),
        ({"layout": "random", "size": [4, "5"]}, "env.size=[4, '5']: "),
    ],
)
def test_improper_arguments_are_refused_in_one_line(arguments, problem):
    with pytest.raises(ConfigError) as refusal:
        layouts.load(**arguments)
    assert problem in str(refusal.value) and "\n" not in str(refusal.value)


def test_a_binary_file_is_refused(tmp_path):
    (tmp_path / "binary").write_bytes(b"\xff\xfe\x00#")
    with pytest.raises(ConfigError, match="not the path of an ASCII text"):
        layouts.load(tmp_path / "binary")


def test_an_opening_towards_a_missing_cell_leads_nowhere():
    assert equal(
        layouts.parse(LOOP.replace("#S    ###", "#S     ##"), "open"), layouts.parse(LOOP, "loop")
    )
