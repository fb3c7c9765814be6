"""Pictures of the corridor and of the pendulum, as arrays of pixels; the maze is drawn by marks.

A picture is uint8 (height, width, 3). Points are (x, y) in pixels from the upper left.
"""

from __future__ import annotations

import numpy as np

DARK, WHITE, GREY = (40, 40, 40), (255, 255, 255), (215, 215, 215)
BLUE, GREEN, RED = (0, 114, 178), (0, 158, 115), (213, 94, 0)

Colour = tuple[int, int, int]
Point = tuple[float, float]


def page(height: int, width: int) -> np.ndarray:
    """A white picture."""
    return np.full((height, width, 3), WHITE, np.uint8)


def rod(picture: np.ndarray, start: Point, end: Point, radius: float, colour: Colour) -> None:
    """Draw a line with round ends; `start` = `end` is a disc. Its edge is smooth."""
    height, width = picture.shape[:2]
    y, x = np.mgrid[:height, :width]
    along = np.subtract(end, start)
    away = np.stack([x - start[0], y - start[1]], axis=-1)  # (height, width, 2)
    share = (away @ along / max(float(along @ along), 1e-9)).clip(0, 1)[..., None]
    distance = np.linalg.norm(away - share * along, axis=-1)
    cover = (radius + 0.5 - distance).clip(0, 1)[..., None]
    picture[:] = np.rint(picture + cover * (np.array(colour) - picture)).astype(np.uint8)


def corridor(lowest: np.ndarray, highest: np.ndarray, place: int, action: float) -> np.ndarray:
    """The corridor from left to right, actions from -1 (below) to 1 (above).

    `lowest` and `highest` (S + 1,) are the actions that pass at each of the places 0 ... S. A gate
    is a wall with a gap. The disc is the agent at `place`, as high as its last action. It is green
    at the end, and red where the action was stopped.
    """
    steps, edge, middle, half = len(lowest) - 1, 14, 60, 42
    space = min(18.0, 1200 / steps)
    picture = page(2 * middle, 2 * edge + round(space * steps))

    def at(place: float, action: float) -> Point:
        return edge + space * place, middle - half * action

    for height in (-1.0, 1.0):
        rod(picture, at(0, height), at(steps, height), 1, DARK)
    rod(picture, at(0, 0), at(steps, 0), 0.5, GREY)
    for gate in np.flatnonzero((lowest > -1) | (highest < 1)).tolist():
        for low, high in ((-1.0, lowest[gate]), (highest[gate], 1.0)):
            if low < high:
                rod(picture, at(gate, low), at(gate, high), 2, DARK)
    # A step moves the agent whatever its action, so the gate that stopped it lies one place back.
    before = max(place - 1, 0)
    stopped = place > 0 and not lowest[before] <= action <= highest[before]
    colour = RED if stopped else GREEN if place == steps else BLUE
    centre = at(before if stopped else place, action)
    rod(picture, centre, centre, 5, colour)
    return picture


def pendulum(angle: float, torque: float) -> np.ndarray:
    """A rod at `angle` in radians (0 is upright), and the torque as a bar of its sign below."""
    picture, centre = page(300, 300), (150.0, 135.0)
    end = (centre[0] + 105 * np.sin(angle), centre[1] - 105 * np.cos(angle))
    rod(picture, (45, 280), (255, 280), 0.5, GREY)
    rod(picture, (150, 280), (150 + 50 * torque, 280), 4, RED)
    rod(picture, centre, end, 10, BLUE)
    rod(picture, centre, centre, 6, DARK)
    return picture
