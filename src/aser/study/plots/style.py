"""How samplers and criteria look in every picture, and the look of the pictures themselves.

Colours are Okabe and Ito's, safe for colour-blind readers. A sampler has the same colour, line and
marker in every picture. The line and the marker alone tell samplers apart in black and white.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from math import isnan
from typing import Any, NamedTuple
from zlib import crc32

BLACK, ORANGE, SKY, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
BLUE, VERMILLION, PURPLE = "#0072B2", "#D55E00", "#CC79A7"
BROWN = "#7A4A12"  # not of that set, but darker, so that it differs in black and white too

SOLID, DASHED, DOTTED = (), (4.5, 1.8), (1, 1.4)
DASH_DOT, DASH_DOT_DOT, LONG_DASH = (5, 1.6, 1, 1.6), (4, 1.4, 1, 1.4, 1, 1.4), (9, 2.2)

LOOK: Any = {
    "font.size": 8.5,
    "font.family": "sans-serif",
    "axes.titlesize": 9.5,
    "axes.labelsize": 9,
    "axes.linewidth": 0.7,
    "axes.edgecolor": "0.25",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "0.91",
    "grid.linewidth": 0.6,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "xtick.color": "0.25",
    "ytick.color": "0.25",
    "xtick.major.width": 0.7,
    "ytick.major.width": 0.7,
    "legend.fontsize": 8,
    "legend.frameon": False,
    "legend.handlelength": 3.4,
    "lines.linewidth": 1.6,
    "lines.markersize": 4.2,
    "lines.solid_capstyle": "round",
    "figure.dpi": 150,
    "savefig.dpi": 150,
    "pdf.fonttype": 42,  # text stays text in the pdf
}


class Style(NamedTuple):
    """How a sampler is drawn: `dashes` () is a solid line, `marker` "" is none."""

    name: str
    colour: str
    dashes: tuple[float, ...]
    marker: str


STYLES = {
    "uniform": Style("SAC, uniform", BLACK, DASHED, ""),
    "per": Style("PER", ORANGE, DASH_DOT, ""),
    "per_unweighted": Style("PER, no weights", BROWN, DOTTED, "X"),
    "rank": Style("PER, rank", VERMILLION, DASHED, "H"),
    "lap": Style("LAP", ORANGE, SOLID, "H"),
    "relo": Style("ReLo", VERMILLION, SOLID, "H"),
    "laber": Style("LaBER", BLUE, DASHED, "H"),
    "la3p": Style("LA3P", PURPLE, DOTTED, "H"),
    "reaper": Style("ReaPER", BLUE, DASH_DOT, "H"),
    "pal": Style("PAL", BROWN, DOTTED, "H"),
    "recent": Style("Recent items", GREEN, DASHED, "H"),
    "cer": Style("CER", SKY, SOLID, "H"),
    "ere": Style("ERE", PURPLE, DASH_DOT, "H"),
    "cvs": Style("CVS", SKY, LONG_DASH, "<"),
    "mmddpg": Style("MMDDPG's mean of n-step", BLACK, DASH_DOT, "<"),
    "preferential": Style("Preferential TD", PURPLE, LONG_DASH, "<"),
    "nstep": Style("n-step SAC", SKY, DOTTED, ""),
    "aser": Style("ASER", BLUE, SOLID, ""),
    "dqn": Style("DQN, uniform", VERMILLION, DASH_DOT, ""),
    "dqn_per": Style("DQN, PER", ORANGE, DASH_DOT, "d"),
    "dqn_aser": Style("DQN, ASER", BLUE, LONG_DASH, "D"),
    "dqn_oracle": Style("DQN, oracle", PURPLE, SOLID, "o"),
    "aser_mode_prob": Style("ASER, mode probability", SKY, LONG_DASH, "P"),
    "pretrained_mode_prob": Style("ASER, pretrained, mode prob.", PURPLE, DASHED, "^"),
    "pretrained": Style("ASER, pretrained", GREEN, SOLID, "^"),
    "oracle": Style("ASER, oracle", VERMILLION, SOLID, "o"),
    "aser_no_prioritisation": Style("ASER, no prioritisation", SKY, DASHED, "<"),
    "aser_no_bootstrap": Style("ASER, no bootstrap rule", GREEN, DASH_DOT, "D"),
    "oracle_no_prioritisation": Style("Oracle, no prioritisation", SKY, DASHED, "o"),
    "oracle_no_bootstrap": Style("Oracle, no bootstrap rule", PURPLE, DASH_DOT, "o"),
    "aser_shuffled": Style("ASER, shuffled", PURPLE, DASH_DOT_DOT, "v"),
    "aser_shuffled_draws": Style("ASER, shuffled draws", PURPLE, DASHED, ">"),
    "aser_shuffled_threshold": Style("ASER, shuffled threshold", GREEN, DOTTED, "d"),
    "nstep_geometric": Style("Geometric n", ORANGE, DOTTED, "s"),
    "aser_q": Style("ASER, Q range", BROWN, LONG_DASH, "s"),
    "outcome_spread": Style("ASER, outcome spread", GREEN, SOLID, "p"),
    "outcome_spread_shuffled": Style("ASER, outcome spread, shuffled", SKY, DASH_DOT_DOT, "p"),
    "outcome_spread_no_prioritisation": Style(
        "Outcome spread, no prioritisation", ORANGE, DASHED, "p"
    ),
    "outcome_spread_no_bootstrap": Style("Outcome spread, no bootstrap rule", BROWN, DASH_DOT, "p"),
    "outcome_spread_tilings": Style("ASER, outcome spread, tilings", BLUE, LONG_DASH, "h"),
    "outcome_model": Style("ASER, outcome model", PURPLE, SOLID, "h"),
    "outcome_model_shuffled": Style("ASER, outcome model, shuffled", ORANGE, DASH_DOT_DOT, "h"),
    "nstep (retrace)": Style("n-step SAC, Retrace", SKY, DOTTED, "^"),
    "nstep (clipped)": Style("n-step SAC, clipped", SKY, DOTTED, "D"),
    "mmddpg (clipped)": Style("SACn", BLACK, DASH_DOT, "D"),
    "aser (retrace)": Style("ASER, Retrace", BLUE, SOLID, "^"),
    "aser (clipped)": Style("ASER, clipped", BLUE, SOLID, "D"),
    "outcome_spread (retrace)": Style("Outcome spread, Retrace", GREEN, DOTTED, "^"),
    "outcome_spread (clipped)": Style("Outcome spread, clipped", GREEN, DOTTED, "D"),
    "visit_count": Style("ASER, visit count", PURPLE, DOTTED, "X"),
    "successor_count": Style("ASER, successor count", VERMILLION, LONG_DASH, "d"),
}

CRITERIA = {  # those that pictures of criteria show
    "mode_log_prob": Style("mode log-probability", BLUE, SOLID, ""),
    "mode_log_prob_unsquashed": Style("mode log-probability, unsquashed", SKY, DASHED, ""),
    "entropy": Style("entropy", GREEN, DOTTED, ""),
    "curvature": Style("curvature", ORANGE, DASH_DOT, ""),
    "q_range": Style("Q range", BROWN, LONG_DASH, ""),
    "q_std": Style("Q standard deviation", PURPLE, DASH_DOT_DOT, ""),
}

# For samplers that a user adds, and for a second run of one sampler in a picture.
_SPARE = [
    Style("", colour, dashes, marker)
    for marker, dashes, colour in product(
        "X*Pd", (SOLID, DASHED, DASH_DOT), (VERMILLION, BLUE, GREEN, ORANGE, PURPLE)
    )
]


def in_print(look: Style, h: float | None) -> str:
    """The name of a sampler; `10-step SAC` where the n of `n-step SAC` is known."""
    return look.name if h is None or isnan(h) else look.name.replace("n-step", f"{h:.0f}-step")


def style(sampler: str) -> Style:
    """The style of a sampler; one that is not ours gets a spare style, chosen by its name."""
    if sampler in STYLES:
        return STYLES[sampler]
    words, bracket, own = sampler.partition(" (")  # a criterion of one's own
    name = STYLES[words].name if words in STYLES else words.replace("_", " ")
    name += bracket + own
    return _SPARE[crc32(sampler.encode()) % len(_SPARE)]._replace(name=name)


def for_picture(samplers: Sequence[str]) -> list[Style]:
    """The styles of one picture's curves, no two alike.

    Samplers that are not ours, and a sampler's second run, get a spare style, in a colour that the
    picture lacks while there is any.
    """
    chosen: dict[int, Style] = {
        samplers.index(sampler): style(sampler) for sampler in samplers if sampler in STYLES
    }
    for i, sampler in enumerate(samplers):
        if i not in chosen:
            chosen[i] = _least_like(list(chosen.values()), sampler)._replace(
                name=style(sampler).name
            )
    return [chosen[i] for i in range(len(samplers))]


def _least_like(taken: list[Style], sampler: str) -> Style:
    """The spare style that shares the least with those taken; the name decides where to begin."""
    start = crc32(sampler.encode()) % len(_SPARE)
    return min(
        _SPARE[start:] + _SPARE[:start],
        key=lambda spare: (
            any(spare[1:] == other[1:] for other in taken),
            sum(spare.colour == other.colour for other in taken),
            sum((spare.dashes, spare.marker) == (other.dashes, other.marker) for other in taken),
        ),
    )
