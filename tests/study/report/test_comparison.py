"""Finished runs beside each other: what is compared, and what is said of it."""

import numpy as np
import pandas as pd
import pytest

from aser.errors import ConfigError
from aser.study.report import latex
from aser.study.report.comparison import begun, comparison, differences
from aser.study.runs import Run

STEPS = (100, 200, 300)


def a_run(sampler="aser", env="maze", seeds=5, best=0.0, steps=STEPS, hyper=None, **summary):
    """A finished run in which seed s has the return best - s - 1 / step."""
    rows = [(seed, step, best - seed - 1 / step) for step in steps for seed in range(seeds)]
    returns = pd.DataFrame(rows, columns=["seed", "step", "return"])
    config = {"sampler": sampler, "env": {"name": env}}
    if hyper is not None:
        config["hyper"] = {"set": hyper.partition("/")[0], "source": hyper}
    return Run(None, config, returns, pd.DataFrame(), summary)


def test_finished_runs_beside_each_other():
    lines = comparison([a_run(solved=5), a_run("per", seeds=1, best=7.0)])
    assert lines[0] == "| sampler | runs | IQM at the end | mean area | solved |"
    # The IQM of the seeds 0 to 4 is that of seed 2.
    assert lines[2].startswith("| aser | 5 | -2.00 [") and lines[2].endswith("| 5/5 [48%, 100%] |")
    assert lines[3] == "| per | 1 | 7.00 | 6.99 | - |"  # a single run has no interval
    assert len(lines) == 4


def test_few_seeds_are_said():
    few = "Intervals of 3 seeds are too narrow; at least 5 are needed, better 16."
    assert comparison([a_run(), a_run("per", seeds=3)])[-1] == few
    assert comparison([a_run(seeds=5)])[-1].startswith("| aser |")


def test_runs_of_other_code_and_lanes_that_have_diverged_are_said():
    known = {"code": "c1", "versions": {"torch": "2.6"}}
    one, two = a_run(**known), a_run("per", **known)
    assert comparison([one, two])[-1].startswith("| per |")
    other = a_run("per", code="c2", versions={"torch": "2.7"}, diverged=[{"seed": 1, "step": 70}])
    one.config["sources"] = {"mine": "a", "env": "x"}
    other.config["sources"] = {"mine": "b", "theirs": "c", "env": "x"}
    lines = comparison([one, other])
    said = "maze: these runs differ in the code of this project, version of torch, mine."
    assert said in lines
    assert lines[-1].startswith("per: 1 of 5 lanes have diverged, and count as the worst return")


def test_the_environment_is_named_where_there_are_two():
    lines = comparison([a_run(), a_run(env="pendulum")])
    assert lines[0].startswith("| environment | sampler |")
    assert lines[3].startswith("| pendulum | aser |")
    assert {line.count("|") for line in lines} == {7}


def test_runs_with_other_evaluations_are_compared_on_those_that_they_share():
    """At 100 and 300, seed 2 of 0 to 4 has -2 - 1/100 and -2 - 1/300."""
    lines = comparison([a_run(solved=5), a_run("per", steps=(100, 300, 600), solved=4)])
    assert lines[2].startswith("| aser | 5 | -2.00 [") and " | -2.01 [" in lines[2]
    assert lines[3].startswith("| per | 5 | -2.00 [") and " | -2.01 [" in lines[3]
    assert lines[2].endswith("| 5/5 [48%, 100%] |")
    assert lines[3].endswith("| - |")  # who has solved it at step 300 is not known
    assert lines[4:] == [
        "",
        "maze: aser is evaluated at 100, 200, 300 (3), per at 100, 300, 600 (3). "
        "The table compares them on the evaluations that they share, 100, 300 (2).",
    ]


def test_the_last_shared_step_is_the_one_that_counts():
    far = a_run("per", steps=range(100, 5001, 100))
    lines = comparison([a_run(), far, a_run("nstep", steps=range(100, 5001, 100))])
    falling = far.returns["return"] - far.returns["step"]
    worse = Run(None, far.config, far.returns.assign(**{"return": falling}), far.diagnostics, {})
    assert "at 100, 200, ..., 5,000 (50)" in lines[-1] and "per, nstep at" in lines[-1]
    assert comparison([a_run(), worse])[3].startswith("| per | 5 | -302 [")


def test_runs_without_a_common_evaluation_are_refused():
    with pytest.raises(ConfigError) as caught:
        comparison([a_run(), a_run("per", steps=(150, 250))])
    said = "maze: aser is evaluated at 100, 200, 300 (3), per at 150, 250 (2); they share no"
    assert said in str(caught.value) and "\n" not in str(caught.value)
    # Runs of other environments are not compared with each other.
    assert len(comparison([a_run(), a_run(env="pendulum", steps=(150, 250))])) == 4
    with pytest.raises(ConfigError, match="per has no evaluations"):
        comparison([a_run(), a_run("per", steps=())])


def test_different_sets_of_hyper_parameters_are_said():
    tuned, sb3 = a_run(hyper="tuned/maze/aser"), a_run("per", hyper="sb3/any/any, lr given")
    lines = comparison([tuned, sb3, a_run(env="pendulum", hyper="sb3/any/any")])
    assert lines[0] == (
        "| environment | sampler | hyper | runs | IQM at the end | mean area | solved |"
    )
    assert lines[2].startswith("| maze | aser | tuned | 5 |")
    assert lines[-1] == (
        "maze: hyper-parameters of different sets: "
        "aser from tuned/maze/aser; per from sb3/any/any, lr given."
    )
    alike = comparison([tuned, a_run("per", hyper="tuned/maze/per")])
    assert "hyper" not in alike[0] and len(alike) == 4


def test_a_return_that_is_no_number_counts_as_the_worst():
    run = a_run()
    run.returns.loc[run.returns["seed"] == 4, "return"] = np.nan
    (row,) = comparison([run])[2:]
    assert row.startswith("| aser | 5 | -2 [-inf, -1] | -inf [-inf, ")


def test_differences_are_to_the_first_run_of_an_environment():
    lines = differences([a_run(), a_run("per", best=1.0), a_run("nstep", seeds=3)])
    assert lines[0] == "| difference | mean area | P(improvement) |"
    # The same seeds are resampled together, so a constant lead has no spread. Of 25 pairs, 15 are
    # won and 4 are ties.
    assert lines[2].startswith("| per - aser | 1.00 [1.00, 1.00] | 0.68 [")
    assert lines[3].startswith("| nstep - aser | 1.00 [") and "1.00 [1.00" not in lines[3]
    assert len(lines) == 4 and differences([a_run()]) == []
    other = [a_run(env="pendulum"), a_run("per", env="pendulum")]
    lines = differences([a_run(), *other])
    assert lines[0].startswith("| environment | difference |") and len(lines) == 3
    assert lines[2].startswith("| pendulum | per - aser | 0.000 [0.000, 0.000] | 0.50 [")


def test_a_diverged_seed_makes_a_difference_of_minus_infinity():
    run = a_run("per")
    run.returns.loc[run.returns["seed"] == 4, "return"] = np.nan
    (row,) = differences([a_run(), run])[2:]
    assert row.startswith("| per - aser | -inf [-inf, 0] | 0.48 [")


def test_runs_going_on_are_said_and_compared_on_the_common_part(tmp_path):
    done, going = a_run(solved=5), a_run("per", steps=(100, 200))
    going.config["steps"] = 5000
    kept, lines = begun([done, going, a_run("nstep", steps=())])
    assert kept == [done, going]
    assert lines == [
        "None is not finished: evaluated up to 200 of 5,000.",
        "None is left out: it is not evaluated yet.",
    ]
    assert "on the evaluations that they share, 100, 200 (2)." in comparison(kept)[-1]
    with pytest.raises(ConfigError, match="not evaluated yet. allowed: a run with an evaluation"):
        begun([a_run("nstep", steps=())])


def test_a_table_for_a_paper():
    runs = [a_run(hyper="tuned/a_b"), a_run("aser_q", steps=(100, 300), hyper="sb3/50%")]
    lines = comparison(runs, paper=True)
    assert lines[:4] == [
        r"\begin{tabular}{llrrrr}",
        r"\toprule",
        r"sampler & hyper & runs & IQM at the end & mean area & solved \\",
        r"\midrule",
    ]
    assert lines[5].startswith(r"aser\_q & sb3 & 5 & $-$2.00 [$-$")
    assert lines[6:8] == [r"\bottomrule", r"\end{tabular}"]
    assert [line[:2] for line in lines[8:]] == ["", "% ", "", "% "]
    assert latex.escaped(r"50% of a_b^c~\d {x} #1 & $5 -3 a-4") == (
        r"50\% of a\_b\textasciicircum{}c\textasciitilde{}\textbackslash{}d \{x\} \#1 \& \$5 "
        r"$-$3 a-4"
    )
