"""Samplers keep their looks, and no two in one picture look alike."""

from itertools import combinations

import pytest

import train
from aser.study.plots import style as styles

TOGETHER = [  # the samplers that stand in one picture
    ["uniform", "per", "nstep", "aser", "aser_shuffled", "aser_q", "oracle"],
    ["uniform", "aser", "aser_shuffled", "outcome_spread", "outcome_spread_shuffled", "oracle"],
    ["uniform", "pretrained", "oracle"],
    ["uniform", "per", "aser", "pretrained"],
    ["uniform", "oracle", "oracle_no_prioritisation", "oracle_no_bootstrap"],
    ["uniform", "aser", "aser_no_prioritisation", "aser_no_bootstrap"],
    ["uniform", "per", "per_unweighted", "nstep", "aser"],
    ["uniform", "per", "aser_mode_prob", "pretrained_mode_prob", "aser", "pretrained"],
    ["dqn", "dqn_per", "dqn_aser", "dqn_oracle"],
]


class TestStyles:
    def test_every_shipped_sampler_has_a_look_of_its_own(self):
        shipped = {path.stem for path in (train.CONF / "sampler").glob("[!_]*.yaml")}
        assert set(styles.STYLES) >= shipped  # and what figures show besides: variants, DQN's runs
        looks = list(styles.STYLES.values())
        assert len({look[1:] for look in looks}) == len(looks) == len({look.name for look in looks})

    @pytest.mark.parametrize("samplers", TOGETHER, ids=" ".join)
    def test_in_one_picture_the_colours_differ_and_so_do_the_lines_without_colour(self, samplers):
        for one, two in combinations(map(styles.style, samplers), 2):
            assert one.colour != two.colour
            assert (one.dashes, one.marker) != (two.dashes, two.marker)

    def test_an_unknown_sampler_keeps_its_look_and_its_name(self):
        """In each process: it comes from the letters of the name."""
        assert styles.style("my_own") == styles.Style(
            name="my own", colour="#0072B2", dashes=(4.5, 1.8), marker="X"
        )

    def test_a_criterion_of_ones_own_has_its_sampler_s_name_and_another_look(self):
        look = styles.style("aser (my_criteria.regret)")
        assert look.name == "ASER (my_criteria.regret)"
        assert look[1:] != styles.style("aser")[1:]

    def test_second_runs_and_unknown_samplers_get_looks_that_the_picture_lacks(self):
        looks = styles.for_picture(["my_own", "aser", "aser", "uniform", "other", "aser"])
        assert looks[1] == styles.style("aser") and looks[3] == styles.style("uniform")
        assert len({look.colour for look in looks}) == 6
        assert looks[2].name == looks[5].name == "ASER" and looks[4].name == "other"

    def test_even_thirty_runs_of_one_sampler_all_differ(self):
        assert len({look[1:] for look in styles.for_picture(["aser"] * 30)}) == 30
