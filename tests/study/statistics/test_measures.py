"""Measures of tables that were made by hand."""

import numpy as np
import pandas as pd
import pytest

from aser.errors import ConfigError
from aser.study.statistics import measures


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
    # The two highest of twenty hold all of the curvature's mass, and 18 + 19 of 0 + ... + 19 = 190.
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
