"""A fuzz of other people's environments: each trains, or is refused in one clear line."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import wild
from bits import differing, results
from hypothesis import strategies as st
from search import failures, unclear

from aser import checkpoint
from aser.replay.storage import Layout

SECONDS = 60  # of one command; most take about one
TINY = "debug=smoke env=gym env.id=wild:Wild-v0 steps=60 learning_starts=20 batch=8 eval.every=30"
TINY = f"{TINY} eval.episodes=2 network.hidden=[8] compile=false run_dir=run".split()

ODDITIES = {
    "observation": st.sampled_from(list(wild.OBSERVATIONS)),
    "action": st.sampled_from(list(wild.ACTIONS)),
    "observed": st.sampled_from(list(wild.OBSERVED)),
    "reused": st.just(True),
    "reward": st.sampled_from(list(wild.REWARDS)),
    "info": st.sampled_from(list(wild.INFOS)),
    "ends": st.sampled_from(list(wild.ENDS)),
    "fails": st.tuples(st.sampled_from(wild.PLACES), st.sampled_from(list(wild.ERRORS))),
    "length": st.sampled_from(wild.LENGTHS),
    "clash": st.sampled_from(list(wild.CLASHES)),
    "seeds": st.sampled_from(["none", "ignored"]),
    "slow": st.just(True),
}
BESIDE = {
    "limit": st.sampled_from([None, 1, 7]),  # steps; None has no limit
    "late": st.just(True),  # proper observations at first
    "one lane": st.just(True),  # the other lane is proper
}
# One to three oddities: of an environment that is refused for its spaces, one sees nothing else.
ENVIRONMENTS = st.lists(
    st.sampled_from(list(ODDITIES)), min_size=1, max_size=3, unique=True
).flatmap(
    lambda names: st.fixed_dictionaries({name: ODDITIES[name] for name in names}, optional=BESIDE)
)
SAMPLERS = ["uniform", "per", "nstep", "aser", "aser_shuffled"]


def trained(warm, folder: Path, asked: dict, *words: str):
    """Train two lanes in the environment that is `asked` for, which is told by JSON."""
    environ = {"TRUST_ENVIRONMENT": json.dumps(asked)}
    return warm.run([*TINY, *words], folder, SECONDS, environ)


@pytest.mark.parametrize(
    ("part", "count"),
    [(0, 6), *(pytest.param(n, 125, marks=pytest.mark.slow) for n in range(1, 5))],
)
def test_an_environment_trains_or_is_refused_in_one_clear_line(part, count, warm, tmp_path):
    number = iter(range(10**9))

    def complaint(asked: dict) -> str | None:
        folder = tmp_path / f"{next(number)}"
        sampler = SAMPLERS[len(json.dumps(asked)) % len(SAMPLERS)]
        ended = trained(warm, folder, asked, f"sampler={sampler}")
        run = folder / "run"
        finished = (run / "summary.json").exists()
        shutil.rmtree(folder)
        if (said := unclear(ended)) is not None:
            return said
        if ended.status == 0:
            return None if finished else "status 0 without results"
        if finished:
            return "status 1 with results"
        about = ("env", "Wild-v0", "observ", "action", "reward", "episode")
        return None if any(word in ended.err for word in about) else f"blames another: {ended.err}"

    found = failures(ENVIRONMENTS, complaint, count, part)
    assert not found, "\n".join(["", *sorted(found)])


def outcome(warm, folder: Path, asked: dict, *words: str) -> dict:
    """All that a finished run wrote that does not depend on time."""
    ended = trained(warm, folder, asked, *words)
    assert (ended.status, ended.err) == (0, ""), (asked, ended.err[-500:])
    return results(folder / "run")


@pytest.fixture(scope="module")
def plain(warm, tmp_path_factory):
    """What a run in the plain environment comes to."""
    return outcome(warm, tmp_path_factory.mktemp("plain"), {}, "sampler=aser")


def facts(content: dict) -> dict[str, np.ndarray]:
    """The stored transitions in the order of their steps, each (L, T, ...)."""
    rows = content["training"]["buffer"]["storage"]["rows"].numpy()
    return {name: rows[..., place] for name, place in Layout(3, 2).columns.items()}


def test_an_array_that_is_handed_out_again_and_again_changes_nothing(warm, plain, tmp_path):
    assert differing(outcome(warm, tmp_path, {"reused": True}, "sampler=aser"), plain) == []


@pytest.mark.parametrize("asked", [{}, {"reused": True}], ids=["copies", "reused"])
@pytest.mark.parametrize("limit", [20, 3], ids=["own ends", "time limit"])
def test_the_last_next_state_of_an_episode_is_its_own(asked, limit, warm, tmp_path):
    stored = facts(outcome(warm, tmp_path, {**asked, "limit": limit}, "sampler=nstep"))
    (episode, step, _), (next_episode, next_step, _) = (
        stored[name].transpose(2, 0, 1) for name in ("obs", "next_obs")
    )
    np.testing.assert_array_equal(next_episode, episode)
    np.testing.assert_allclose(next_step - step, 0.1, atol=1e-6)
    ends = (stored["terminated"] + stored["truncated"])[..., 0] > 0
    assert ends.sum() >= 20 and stored["truncated"].sum() >= 4
    assert (step[:, 1:][ends[:, :-1]] == 0).all()  # after an end, a new episode begins
    np.testing.assert_array_equal(
        stored["obs"][:, 1:][~ends[:, :-1]], stored["next_obs"][:, :-1][~ends[:, :-1]]
    )


@pytest.mark.parametrize(
    "info",
    ["all in turn", "None", "final_obs array", "_final_obs number"]
    + [pytest.param(info, marks=pytest.mark.slow) for info in wild.INFOS],
)
def test_infos_that_nobody_reads_change_nothing(info, warm, plain, tmp_path):
    assert differing(outcome(warm, tmp_path, {"info": info}, "sampler=aser"), plain) == []


ONE_LANE = ["reward nan", "observed huge", "ends at once", "info all in turn"]
MORE = ["reward -inf", "reward huge", "observed nan", "observed inf"]


@pytest.mark.parametrize(
    "odd", [*ONE_LANE, *(pytest.param(odd, marks=pytest.mark.slow) for odd in MORE)]
)
@pytest.mark.parametrize("sampler", ["aser", pytest.param("per", marks=pytest.mark.slow)])
def test_the_other_lane_does_not_notice(odd, sampler, warm, tmp_path):
    words = [f"sampler={sampler}", "seeds=[4,3]", "eval.every=null"]  # 3 is odd, in both senses
    found = []
    what, how = odd.split(" ", 1)
    for name, asked in {"plain": {}, "odd": {what: how, "one lane": True}}.items():
        ended = trained(warm, tmp_path / name, asked, *words)
        if name == "odd" and ended.status == 1:  # a refusal is an answer, too
            assert unclear(ended) is None and "Wild-v0" in ended.err
            return
        assert ended.status == 0, ended.err
        content = checkpoint.load(tmp_path / name / "run" / checkpoint.NAME)["training"]
        lanes = [content["agent"], content["actions"], content["buffer"]["storage"]["rows"]]
        found.append([[leaf[0] for leaf in lanes[0]], lanes[1][0], lanes[2][0]])
    assert differing(*found) == []
