"""Layouts of the maze: read from ASCII, drawn as ASCII, or generated.

A maze of C columns and R rows of square cells is drawn with 2C + 1 times 2R + 1 characters. Cells stand at
the odd places, the walls between them at the even ones; `#` is wall, a blank is open, S the start, T the end:

    #######
    #S    #
    ### # #
    #   #T#
    #######

A cell that is itself drawn as `#` does not exist. A cell's number is row * C + column, rows from the top.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from aser.errors import ConfigError

# East, north, south, west as (columns, rows) on the page. The opposite of heading k is heading 3 - k.
PAGE_MOVES = ((1, 0), (0, -1), (0, 1), (-1, 0))
SHIPPED = Path(__file__).parent / "layouts"
LARGEST_SIDE = 100


@dataclass(frozen=True)
class Layout:
    """Square cells and the open ways between them."""

    columns: int
    rows: int
    start: int
    goal: int
    passages: np.ndarray  # (columns * rows, 4) bool: is the way out of the cell, by heading, open?

    @property
    def cells(self) -> int:
        """How many cells exist (all of them have a way out)."""
        return int(self.passages.any(axis=1).sum())

    def neighbour(self, cell: int, heading: int) -> int:
        """The number of the cell that lies there on the page, wall or not."""
        dx, dy = PAGE_MOVES[heading]
        return cell + dx + dy * self.columns


def load(layout: str | Path, layout_seed: int = 0, size: tuple[int, int] = (12, 10)) -> Layout:
    """The layout that the maze's arguments name.

    `layout` is large, toy, random (by `layout_seed` and `size` = columns, rows) or an ASCII file's path.
    Raises ConfigError where there is no such file, or where it shows no proper maze.
    """
    layout_seed, size = _checked_seed(layout_seed), _checked_size(size)
    if layout == "random":
        return generate(layout_seed, size)
    path = SHIPPED / f"{layout}.txt" if layout in ("large", "toy") else layout
    try:
        text = Path(path).read_text(encoding="ascii")
    except (OSError, TypeError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "not the path of an ASCII text"
        allowed = "large, toy, random or the path of an ASCII layout"
        raise ConfigError(
            f"env.layout={layout} cannot be read ({reason}): allowed are {allowed}"
        ) from error
    return parse(text, name=str(layout))


def generate(seed: int, size: tuple[int, int]) -> Layout:
    """A perfect maze by a recursive backtracker; S is the upper left corner and T the lower right one.

    It draws from PCG64's raw stream, which numpy promises not to change: a seed names a maze for good.
    """
    columns, rows = size
    passages = np.zeros((columns * rows, 4), dtype=bool)
    stream = np.random.PCG64(seed)
    visited, way = {0}, [0]
    while way:
        cell = way[-1]
        column, row = cell % columns, cell // columns
        options = [
            (heading, (row + dy) * columns + column + dx)
            for heading, (dx, dy) in enumerate(PAGE_MOVES)
            if 0 <= column + dx < columns and 0 <= row + dy < rows
        ]
        options = [(heading, other) for heading, other in options if other not in visited]
        if not options:
            way.pop()
            continue
        heading, other = options[int(stream.random_raw()) % len(options)]
        passages[cell, heading] = passages[other, 3 - heading] = True
        visited.add(other)
        way.append(other)
    return Layout(columns, rows, start=0, goal=columns * rows - 1, passages=passages)


def draw(layout: Layout, agent: int | None = None) -> str:
    """The ASCII text that `parse` reads; `agent` marks a cell with @, which `parse` does not read."""
    page = np.full((2 * layout.rows + 1, 2 * layout.columns + 1), "#")
    for cell in np.flatnonzero(layout.passages.any(axis=1)).tolist():
        y, x = 2 * (cell // layout.columns) + 1, 2 * (cell % layout.columns) + 1
        page[y, x] = {layout.start: "S", layout.goal: "T"}.get(cell, " ")
        for heading in np.flatnonzero(layout.passages[cell]):
            dx, dy = PAGE_MOVES[heading]
            page[y + dy, x + dx] = " "
        if cell == agent:
            page[y, x] = "@"
    return "\n".join("".join(line) for line in page) + "\n"


def parse(text: str, name: str) -> Layout:
    """Read a layout; `name` is what errors call it. Raises ConfigError, one line, for anything improper."""

    def refuse(problem: str) -> ConfigError:
        return ConfigError(f"env.layout={name}: {problem}")

    lines = text.rstrip("\n").split("\n")
    height, width = len(lines), len(lines[0])
    if any(len(line) != width for line in lines):
        raise refuse(f"every line must be as long as the first, which has {width} characters")
    if height < 3 or width < 3 or height % 2 == 0 or width % 2 == 0:
        raise refuse(f"it is {width} x {height} characters: both must be odd and at least 3")
    strange = sorted(set("".join(lines)) - set("# ST"))
    if strange:
        raise refuse(f"character {strange[0]!r} is not allowed: only '#', ' ', 'S' and 'T' are")

    page = np.array([list(line) for line in lines])  # (height, width)
    border = np.concatenate([page[0], page[-1], page[:, 0], page[:, -1]])
    if (border != "#").any() or (page[::2, ::2] != "#").any():
        raise refuse("the border and every even place of an even line must be '#'")
    places = {}
    for mark, word in (("S", "start"), ("T", "end")):
        found = np.argwhere(page == mark)
        if len(found) != 1 or (found % 2 == 0).any():
            raise refuse(
                f"it shows {len(found)} {mark} ({word}): exactly one, in a cell, is needed"
            )
        places[mark] = int((found[0, 0] // 2) * (width // 2) + found[0, 1] // 2)

    open_page = page != "#"
    cells = open_page[1::2, 1::2]  # (rows, columns)
    eastward = open_page[1::2, 2:-1:2] & cells[:, :-1] & cells[:, 1:]
    southward = open_page[2:-1:2, 1::2] & cells[:-1] & cells[1:]
    passages = np.zeros((*cells.shape, 4), dtype=bool)
    passages[:, :-1, 0] = passages[:, 1:, 3] = eastward
    passages[:-1, :, 2] = passages[1:, :, 1] = southward
    layout = Layout(width // 2, height // 2, places["S"], places["T"], passages.reshape(-1, 4))

    lost = sorted(set(np.flatnonzero(cells).tolist()) - _reached(layout))
    if lost:
        row, column = divmod(lost[0], layout.columns)
        raise refuse(f"column {column + 1}, row {row + 1} is not connected to S: all cells must be")
    return layout


def _reached(layout: Layout) -> set[int]:
    reached, border = {layout.start}, [layout.start]
    while border:
        cell = border.pop()
        ways = np.flatnonzero(layout.passages[cell])
        new = {layout.neighbour(cell, heading) for heading in ways.tolist()} - reached
        reached |= new
        border.extend(new)
    return reached


def _is_whole(value: object) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def _checked_seed(seed: int) -> int:
    if not _is_whole(seed) or seed < 0:
        raise ConfigError(f"env.layout_seed={seed}: a whole number of at least 0 is allowed")
    return int(seed)


def _checked_size(size: tuple[int, int]) -> tuple[int, int]:
    sides = list(size) if isinstance(size, list | tuple) else []
    if len(sides) != 2 or not all(_is_whole(side) and 2 <= side <= LARGEST_SIDE for side in sides):
        allowed = f"[columns, rows], whole numbers from 2 to {LARGEST_SIDE}"
        raise ConfigError(f"env.size={size}: allowed are {allowed}")
    return int(sides[0]), int(sides[1])
