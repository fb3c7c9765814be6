"""Claims with known answers: each rule gets each of its verdicts, and the statistics are those that a loop finds."""

import numpy as np
import pandas as pd
import pytest
from arch.bootstrap import IIDBootstrap

from aser.errors import ConfigError
from aser.study.report import claims
from aser.study.statistics import comparisons as rules
from aser.study.statistics import measures
from aser.study.statistics.comparisons import NOT_REPRODUCED, REPRODUCED, UNDECIDED, Runs

STEPS = np.array([100, 200, 300, 400, 500])


def runs(mean, noise=0.1, seeds=16, mazes=1, seed=0, best=0.0):
    returns = mean + noise * np.random.default_rng(seed).normal(size=(seeds, mazes, len(STEPS)))
    return Runs(returns, STEPS, best)


def share(solved, seeds=16):
    """Runs of which `solved` are at the best return from the third evaluation on."""
    returns = np.full((seeds, 1, len(STEPS)), -1.0)
    returns[:solved, 0, 2:] = 0.0
    return Runs(returns, STEPS, 0.0)


def test_better_has_three_verdicts():
    good, bad = runs(-1.0), runs(-2.0, seed=1)
    assert rules.better(good, bad, "area").verdict == REPRODUCED
    assert rules.better(bad, good, "area").verdict == NOT_REPRODUCED
    noisy, other = runs(-1.0, noise=3.0), runs(-1.0, noise=3.0, seed=1)
    assert rules.better(noisy, other, "area").verdict == UNDECIDED
    assert rules.better(good, bad, "area").estimate == pytest.approx(1.0, abs=0.1)


def test_no_worse_has_three_verdicts():
    one, same, worse = runs(-1.0), runs(-1.02, seed=1), runs(-2.0, seed=2)
    assert rules.no_worse(same, one, "area", margin=0.3).verdict == REPRODUCED
    assert (
        rules.no_worse(one, worse, "area", margin=0.3).verdict == REPRODUCED
    )  # better is no worse
    assert rules.no_worse(worse, one, "area", margin=0.3).verdict == NOT_REPRODUCED
    assert (
        rules.no_worse(runs(-1.0, 9.0), runs(-1.0, 9.0, seed=3), "area", margin=0.3).verdict
        == UNDECIDED
    )


def test_about_equal_has_three_verdicts():
    one, same, better = runs(-1.0), runs(-1.02, seed=1), runs(-0.2, seed=2)
    assert rules.about_equal(same, one, "area", margin=0.3).verdict == REPRODUCED
    assert rules.about_equal(better, one, "area", margin=0.3).verdict == NOT_REPRODUCED
    assert rules.about_equal(one, better, "area", margin=0.3).verdict == NOT_REPRODUCED
    assert (
        rules.about_equal(runs(-1.0, 9.0), runs(-1.0, 9.0, seed=3), "area", margin=0.3).verdict
        == UNDECIDED
    )


@pytest.mark.parametrize(
    ("solved", "seeds", "verdict"),
    [
        (16, 16, REPRODUCED),
        (15, 16, UNDECIDED),
        (8, 16, UNDECIDED),
        (6, 16, NOT_REPRODUCED),
        (56, 64, REPRODUCED),
    ],
)
def test_always_by_the_interval_of_clopper_and_pearson(solved, seeds, verdict):
    outcome = rules.always(share(solved, seeds))
    assert outcome.verdict == verdict and outcome.estimate == solved / seeds
    if (solved, seeds) == (16, 16):
        assert outcome.low == pytest.approx(0.025 ** (1 / 16))  # .794: by hand, of 16 of 16
    contrary = rules.contrary(outcome).verdict
    expected = {REPRODUCED: NOT_REPRODUCED, NOT_REPRODUCED: REPRODUCED, UNDECIDED: UNDECIDED}
    assert contrary == expected[verdict]


def test_always_at_a_step():
    assert rules.always(share(16), 200).verdict == NOT_REPRODUCED
    assert rules.always(share(16), 300).verdict == REPRODUCED
    with pytest.raises(ConfigError, match="step=250"):
        rules.always(share(16), 250)


def test_positive_has_three_verdicts():
    numbers = np.random.default_rng(0).normal(size=(16, 1))
    assert rules.positive(numbers + 3.0).verdict == REPRODUCED
    assert rules.positive(numbers - 3.0).verdict == NOT_REPRODUCED
    assert rules.positive(numbers - numbers.mean()).verdict == UNDECIDED
    assert rules.positive(np.full((3, 1), np.nan)).verdict == UNDECIDED
    assert rules.positive(np.array([[1.0], [2.0], [np.nan], [3.0]])).estimate == 2.0


def test_positive_resamples_the_seeds_of_each_maze_by_themselves():
    """Two mazes of one constant each: however the seeds are drawn, the mean is that of the two."""
    outcome = rules.positive(np.tile([1.0, 5.0], (7, 1)))
    assert (outcome.estimate, outcome.low, outcome.high) == (3.0, 3.0, 3.0)


def test_statistics_against_a_loop():
    own = runs(-0.2, noise=0.3, seeds=7, mazes=3)
    own = Runs(np.minimum(own.returns, 0.0), STEPS, 0.0)
    R, M, E = own.returns.shape
    area = np.mean([own.returns[r, m].mean() for r in range(R) for m in range(M)])
    assert rules.value(own, "area") == pytest.approx(area)
    assert rules.value(own, "final") == pytest.approx(np.mean(own.returns[:, :, -1]))
    solved = np.mean([own.returns[r, m, -1] >= 0.0 for r in range(R) for m in range(M)])
    assert rules.value(own, "solved") == pytest.approx(solved)
    spread = np.mean(
        [np.std([own.returns[r, m, e] for r in range(R)]) for m in range(M) for e in range(E)]
    )
    assert rules.value(own, "spread") == pytest.approx(spread)


def test_steps_to_90_counts_a_goal_never_reached_as_one_more_step():
    assert rules.value(share(16), "steps_to_90") == 300
    assert rules.value(share(15), "steps_to_90") == 300  # 15 of 16 are 94%
    assert rules.value(share(14), "steps_to_90") == 501  # 88%
    assert (
        rules.better(share(16), share(3), "steps_to_90").estimate == 201
    )  # fewer steps are better
    assert (
        rules.better(runs(-1.0, 0.1), runs(-1.0, 0.9, seed=1), "spread").verdict == REPRODUCED
    )  # so is less spread


def test_replicates_against_a_loop():
    own, index = (
        runs(-1.0, 1.0, seeds=5, mazes=2),
        np.random.default_rng(1).integers(5, size=(3, 5, 2)),
    )
    for statistic in ("area", "spread", "steps_to_90"):
        found = rules.replicates(own, statistic, index)
        for s in range(3):
            drawn = np.stack([own.returns[index[s, :, m], m] for m in range(2)], axis=1)
            assert found[s] == pytest.approx(rules.value(Runs(drawn, STEPS, 0.0), statistic))


def test_the_interval_covers_as_often_as_it_says():
    covered = 0
    for trial in range(200):
        one, two = (
            runs(0.0, 1.0, seeds=30, seed=2 * trial),
            runs(0.0, 1.0, seeds=30, seed=2 * trial + 1),
        )
        outcome = rules.better(one, two, "area")
        covered += outcome.low < 0 < outcome.high
    assert (
        0.88 < covered / 200 < 0.99
    )  # 95% but for the percentile bootstrap's small-sample shortfall


def test_runs_of_other_seeds_are_not_compared():
    with pytest.raises(ConfigError, match="seeds and mazes differ"):
        rules.better(runs(0.0), runs(0.0, seeds=5), "area")


# From tables to the ledger.


def a_table(path, figure, panels, values, seeds=16, mazes=(0,), env="maze large"):
    rows = []
    for panel in panels:
        for label, level in values.items():
            for maze in mazes:
                for seed in range(seeds):
                    noise = np.random.default_rng([seed, maze]).normal(size=len(STEPS)) * 0.05
                    place = {
                        "panel": panel,
                        "maze": maze,
                        "label": label,
                        "sampler": label,
                        "env": env,
                        "seed": seed,
                    }
                    rows.append(
                        place
                        | dict(zip(map(str, STEPS), np.minimum(level + noise, 0.0), strict=True))
                    )
    pd.DataFrame(rows).to_csv(path / f"{figure}.csv", index=False)


@pytest.fixture
def tables(tmp_path):
    pd.DataFrame(
        {
            "env": ["maze large", "pendulum"],
            "random": [-10.0, -1200.0],
            "best": [0.0, -150.0],
            "worst": [-100.0, -3000.0],
            "solvable": [True, False],
        }
    ).to_csv(tmp_path / "references.csv", index=False)
    a_table(
        tmp_path, "fig04", ["tuned", "thesis"], {"uniform": -3.0, "oracle": 0.2, "pretrained": -2.0}
    )
    a_table(tmp_path, "fig05", ["tuned", "thesis"], {"uniform": -3.0, "aser": -1.0, "per": -3.1})
    a_table(
        tmp_path,
        "fig12",
        ["tuned"],
        {"uniform": -300.0, "aser": -301.0, "pretrained": -200.0},
        env="pendulum",
    )
    a_table(
        tmp_path,
        "mazes",
        ["own", "at"],
        {"uniform": -3.0, "oracle": 0.2, "pretrained": -3.0},
        seeds=5,
        mazes=range(3),
    )
    return claims.Tables(tmp_path)


@pytest.mark.parametrize(
    ("figure", "rule", "verdict"),
    [
        ("fig04", {"better": "oracle", "than": "uniform", "statistic": "area"}, REPRODUCED),
        ("fig04", {"better": "uniform", "than": "oracle", "statistic": "area"}, NOT_REPRODUCED),
        ("fig05", {"better": "aser", "than": "fig04:pretrained", "statistic": "area"}, REPRODUCED),
        # The margin is a tenth of about 3: .1 is within, 2 is not.
        (
            "fig05",
            {"no_worse": "per", "than": "uniform", "statistic": "area", "oracle": "fig04:oracle"},
            REPRODUCED,
        ),
        (
            "fig05",
            {"about_equal": "per", "than": "aser", "statistic": "area", "oracle": "fig04:oracle"},
            NOT_REPRODUCED,
        ),
        # Without an oracle a tenth of the way from -1200 to -150: 105.
        ("fig12", {"no_worse": "aser", "than": "uniform", "statistic": "area"}, REPRODUCED),
        (
            "fig12",
            {"about_equal": "pretrained", "than": "uniform", "statistic": "area"},
            REPRODUCED,
        ),
        # Gains as shares of the way: 1 of 10 in the maze, 100 of 1050 in the pendulum; 2 of 10 is more.
        (
            "fig05",
            {
                "larger_gain": "aser",
                "than": "uniform",
                "gain_of": "fig12:pretrained",
                "gain_than": "fig12:uniform",
                "statistic": "area",
            },
            REPRODUCED,
        ),
        ("fig04", {"always": "oracle"}, REPRODUCED),
        ("fig04", {"not_always": "uniform"}, REPRODUCED),
        ("fig04", {"always": "uniform", "step": 300}, NOT_REPRODUCED),
        ("fig04", {"all": [{"always": "oracle"}, {"always": "uniform"}]}, NOT_REPRODUCED),
        ("fig04", {"all": [{"always": "oracle"}, {"not_always": "uniform"}]}, REPRODUCED),
    ],
)
def test_a_claim_with_a_known_answer(tables, figure, rule, verdict):
    assert claims.decide(rule, claims.Scope(tables, figure, 0)).verdict == verdict


def test_a_claim_in_every_scope(tables):
    rule = {"better": "pretrained", "than": "uniform", "statistic": "area"}
    known = {
        "one": {"says": "x", "figure": "fig04", "again": "mazes", "rule": rule},
        "two": {"says": "y", "figure": "fig09", "rule": rule},
    }
    found = claims.outcomes(known, tables)
    here = found[(found["claim"] == "one") & (found["figure"] == "fig04")]
    assert list(here["panel"]) == ["tuned", "thesis"] and set(here["verdict"]) == {REPRODUCED}
    again = found[(found["claim"] == "one") & (found["figure"] == "mazes")]
    assert set(again["maze"]) == {claims.POOLED, 0, 1, 2}  # the others are not there
    assert set(again["verdict"]) == {UNDECIDED}  # the same numbers: the interval is 0 to 0
    assert list(found.loc[found["claim"] == "two", "verdict"]) == ["not run"]


def test_the_committed_claims_are_decidable_in_form():
    from train import CONF

    for part in claims.load(CONF / "claims.yaml").values():
        for claim in part.values():
            for rule in claim["rule"].get("all", [claim["rule"]]):
                assert sum(kind in rule for kind in claims.RULES) == 1
                assert rule.get("statistic", "area") in rules.STATISTICS
                assert rule.get("positive", "decision_auc") in measures.MEASURES
            assert (CONF / "figure" / f"{claim['figure']}.yaml").is_file()


# The numbers of maps.


def test_measures_of_hand_made_maps():
    replay = pd.DataFrame(
        {
            "seed": 3,
            "maze": 0,
            "decision": [True, False, False, False],
            "terminal": False,
            "distance": [0, 3, 2, 1],
            "draws": [20, 5, 5, 10],
            "expected": 10.0,
            "unroll": [1.0, 3.0, 2.0, 1.0],
            "visited": True,
            "log_prob": [2.0, 1.0, 3.0, 0.0],
        }
    )
    assert measures.decision_draws(replay) == pytest.approx(np.log(2.0))
    assert measures.unroll_by_distance(replay) == pytest.approx(1.0)
    assert measures.decision_auc(replay) == pytest.approx(2 / 3)  # 2 is above 1 and 0, below 3
    both = pd.concat([replay, replay.assign(seed=5, draws=[5, 5, 5, 5])])
    assert measures.of("decision_draws", both) == pytest.approx(np.log([[2.0], [0.5]]))
    assert measures.of("decision_draws", both, both) == pytest.approx(np.zeros((2, 1)))
    two_mazes = pd.concat([both, both.assign(maze=1, draws=20)])
    assert measures.of("decision_draws", two_mazes) == pytest.approx(
        np.log([[2.0, 2.0], [0.5, 2.0]])
    )
    with pytest.raises(ConfigError, match="positive=draws"):
        measures.of("draws", both)


def test_measures_of_maps_of_two_criteria():
    log_prob = np.arange(20.0)
    sharp = np.where(log_prob >= 18, 5.0, 0.0)
    rows = pd.DataFrame(
        {
            "seed": 2,
            "maze": 0,
            "log_prob": log_prob,
            "curvature": sharp,
            "visited": True,
            "terminal": False,
            "decision": log_prob == 19,
        }
    )
    # The two highest of twenty hold all of the curvature's mass, and 18 + 19 of the 190 of 0 + ... + 19.
    assert measures.of("curvature_sharper", rows) == pytest.approx(np.array([[1 - 37 / 190]]))
    assert measures.of("map_correlation", rows.assign(curvature=-log_prob)) == pytest.approx(
        np.array([[-1.0]])
    )
    for same in ({"curvature": 2.0}, {"log_prob": 2.0}):
        for measure in ("map_correlation", "curvature_sharper"):
            assert np.isnan(measures.of(measure, rows.assign(**same))).all()
    unseen = pd.concat([rows, rows.assign(curvature=-9.0, log_prob=99.0, visited=False)])
    for measure in ("map_correlation", "curvature_sharper"):
        assert measures.of(measure, unseen) == measures.of(measure, rows)
    assert measures.map_correlation(rows.assign(other=log_prob**3), "other") == pytest.approx(1.0)
    assert measures.of("log_prob_over_curvature_auc", rows) == pytest.approx(
        np.array([[1 - 18.5 / 19]])
    )


def test_separability_of_hand_made_dropoffs():
    drops = {
        0.0: [0, 0.1, 0.1],
        0.1: [0, 0, 0.9],
        0.2: [0, 0.2, 0.3],
    }  # weights 2 and 1: .3, .9, .7
    rows = pd.DataFrame(
        {
            "seed": 1,
            "maze": 0,
            "position": position,
            "gate": position == 0.1,
            "rank": rank,
            "drop": drop,
        }
        for position, line in drops.items()
        for rank, drop in enumerate(line, 1)
    )
    assert measures.of("dropoff_auc", rows) == pytest.approx(np.array([[1.0]]))
    assert measures.of("dropoff_auc", rows.assign(gate=rows["position"] == 0.2)) == pytest.approx(
        np.array([[0.5]])
    )
    assert measures.of("dropoff_not_separable", rows) == pytest.approx(np.array([[-0.1]]))


def test_measures_of_hand_made_separations():
    rows = pd.DataFrame(
        [
            {
                "seed": 1,
                "maze": 0,
                "step": step,
                "over": over,
                "measure": measure,
                "mode_log_prob": p,
                "q_range": q,
            }
            for step, over, measure, p, q in [
                (100, "visited", "auc", 0.9, 0.1),
                (200, "visited", "auc", 0.6, 0.75),
                (200, "visited", "spearman", 0.4, 0.5),
                (200, "path", "auc", 0.1, 0.2),
            ]
        ]
    )
    assert measures.of("auc_above_chance", rows) == pytest.approx(np.array([[0.1]]))
    assert measures.of("candidate_auc_gain", rows) == pytest.approx(np.array([[0.15]]))
    assert measures.of("path_auc_above_chance", rows) == pytest.approx(np.array([[-0.4]]))
    assert measures.of("rank_correlation", rows) == pytest.approx(np.array([[0.4]]))


def test_the_interval_of_a_paired_difference_agrees_with_arch():
    random = np.random.default_rng(8)
    one = random.normal(size=(20, 1, 1))
    two = one * 0.5 + random.normal(size=(20, 1, 1))
    outcome = rules.better(Runs(one, STEPS[:1], 0.0), Runs(two, STEPS[:1], 0.0), "area")
    low, high = (
        IIDBootstrap(one[:, 0, 0], two[:, 0, 0], seed=1)
        .conf_int(lambda a, b: a.mean() - b.mean(), reps=4000, method="percentile")
        .ravel()
    )
    assert outcome.low == pytest.approx(low, abs=0.06 * (high - low))
    assert outcome.high == pytest.approx(high, abs=0.06 * (high - low))
