"""Layouts of the maze, which are read from ASCII, written as ASCII, or generated.

A maze of C columns and R rows of square cells is drawn with 2C + 1 times 2R + 1 characters. Cells
have odd line and character numbers, counted from 0; the walls between them have an even one. `#` is
wall, a blank is open, S is the start and T is the end:

    #######
    #S    #
    ### # #
    #   #T#
    #######

A cell that is drawn as `#` does not exist. The number of a cell is row * C + column, from the top.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from aser.errors import ConfigError

# East, north, south, west as (columns, rows) in the text. The opposite of heading k is 3 - k.
PAGE_MOVES = ((1, 0), (0, -1), (0, 1), (-1, 0))
SHIPPED = Path(__file__).parent / "layouts"
LARGEST_SIDE = 100


@dataclass(frozen=True)
class Layout:
    """Square cells and the passages between them."""

    columns: int
    rows: int
    start: int
    goal: int
    passages: np.ndarray  # (columns * rows, 4) bool: whether the cell is open towards a heading

    @property
    def cells(self) -> int:
        """The number of cells that exist, which all have a passage."""
        return int(self.passages.any(axis=1).sum())

    def neighbour(self, cell: int, heading: int) -> int:
        """Return the number of the next cell towards a heading, even behind a wall."""
        dx, dy = PAGE_MOVES[heading]
        return cell + dx + dy * self.columns


def load(layout: str | Path, layout_seed: int = 0, size: tuple[int, int] = (12, 10)) -> Layout:
    """Return the layout that the arguments of a maze name.

    `layout` is large, toy, random, or the path of an ASCII file. A random layout is drawn from
    `layout_seed` with `size` = (columns, rows). Raises ConfigError where the file cannot be read or
    shows no proper maze, and for an improper seed or size.
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
    """Return a perfect maze, by a recursive backtracker, of `size` = (columns, rows).

    S is the upper left corner and T is the lower right one. The maze is drawn from PCG64's raw
    stream, which numpy promises not to change, so a seed always gives the same maze.
    """
    columns, rows = size
    passages = np.zeros((columns * rows, 4), dtype=bool)
    stream = np.random.PCG64(seed)
    visited, path = {0}, [0]
    while path:
        cell = path[-1]
        column, row = cell % columns, cell // columns
        options = [
            (heading, (row + dy) * columns + column + dx)
            for heading, (dx, dy) in enumerate(PAGE_MOVES)
            if 0 <= column + dx < columns and 0 <= row + dy < rows
        ]
        options = [(heading, other) for heading, other in options if other not in visited]
        if not options:
            path.pop()
            continue
        heading, other = options[int(stream.random_raw()) % len(options)]
        passages[cell, heading] = passages[other, 3 - heading] = True
        visited.add(other)
        path.append(other)
    return Layout(columns, rows, start=0, goal=columns * rows - 1, passages=passages)


def draw(layout: Layout, agent: int | None = None) -> str:
    """Return the ASCII text that `parse` reads; with @ at the cell `agent`, `parse` refuses it."""
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
    """Return the layout that an ASCII text shows. Raises ConfigError, which calls it `name`."""

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
    ends = []
    for mark, word in (("S", "start"), ("T", "end")):
        marked = np.argwhere(page == mark)  # (how many, 2)
        if len(marked) != 1 or (marked % 2 == 0).any():
            raise refuse(
                f"it shows {len(marked)} {mark} ({word}): exactly one, in a cell, is needed"
            )
        row, column = marked[0].tolist()
        ends.append((row // 2) * (width // 2) + column // 2)

    open_page = page != "#"
    cells = open_page[1::2, 1::2]  # (rows, columns)
    eastward = open_page[1::2, 2:-1:2] & cells[:, :-1] & cells[:, 1:]
    southward = open_page[2:-1:2, 1::2] & cells[:-1] & cells[1:]
    passages = np.zeros((*cells.shape, 4), dtype=bool)
    passages[:, :-1, 0] = passages[:, 1:, 3] = eastward
    passages[:-1, :, 2] = passages[1:, :, 1] = southward
    layout = Layout(width // 2, height // 2, ends[0], ends[1], passages.reshape(-1, 4))

    lost = sorted(set(np.flatnonzero(cells).tolist()) - _reached(layout))
    if lost:
        row, column = divmod(lost[0], layout.columns)
        raise refuse(f"column {column + 1}, row {row + 1} is not connected to S: all cells must be")
    return layout


def _reached(layout: Layout) -> set[int]:
    """Return the cells that are connected to the start."""
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
