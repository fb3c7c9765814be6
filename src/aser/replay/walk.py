"""Unrolls that pay only for the states they pass, for one lane.

The plain lines of `unroll.py` ask the policy at every state of every window. The operator of
`native.walk` takes the states of a window one after the other, for many items side by side. It asks
the policy at a state only when the unroll comes to it, and compares p with the threshold there.
Both give the same numbers, bit for bit, where the rest of the step is compiled too.
"""

from __future__ import annotations

from torch import Tensor

from aser import native
from aser.compiled import tracing
from aser.replay import bootstrap
from aser.replay.kinds import Lane


def serves(lane: Lane) -> bool:
    """Whether the operator can unroll: with a narrow policy, in a compiled step on a CPU.

    A step that is not compiled shows what the operator should give, by the plain lines.
    """
    layers, rows = getattr(lane.agent, "policy_layers", None), lane.memory.rows
    return (
        tracing()
        and layers is not None
        and native.fits(layers(lane.state), rows)
        and native.serves(rows)
    )


def unroll(
    lane: Lane,
    index: Tensor,
    limit: Tensor,
    epsilon: Tensor,
    gamma: Tensor,
    steps: int,
    b: Tensor,
    criterion: str | None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Unroll the items at `index` (B,), over at most `limit` (B,) of `steps` steps.

    An unroll ends before that at the end of an episode, at the newest item and, with a criterion
    of native.CRITERIA, at a state where p is not below b (). `epsilon` (A, B) draws the actions
    whose entropy is added on the way. Returns n, and the reward, the discount and the item of s_n
    as `bootstrap.fold` does, each (B,).
    """
    (w1, b1), (w2, b2) = lane.agent.policy_layers(lane.state)  # type: ignore[attr-defined]
    given = native.Walk(
        w1,
        b1,
        w2,
        b2,
        rows=lane.memory.rows,
        newest=lane.memory.clock.newest,
        index=index,
        limit=limit,
        epsilon=epsilon,
        powers=bootstrap.powers(gamma, steps),
        temperature=lane.agent.temperature(lane.state),
        b=b,
    )
    facts = ("reward", "terminated", "truncated", "next_obs")
    return native.walk(given, [lane.layout.columns[fact].start for fact in facts], criterion)
