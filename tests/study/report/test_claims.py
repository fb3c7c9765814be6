"""Claims with known answers, from made-up tables to verdicts and to the lines of the ledger."""

import numpy as np
import pandas as pd
import pytest
import yaml

import train
from aser.errors import ConfigError
from aser.study.report import claims, ledger
from aser.study.report.claims import Claim, Scope
from aser.study.statistics.comparisons import NOT_REPRODUCED, REPRODUCED, UNDECIDED

STEPS = (100, 200, 300, 400, 500)
THIRD = {"share": "pretrained", "from": "uniform", "to": "oracle", "statistic": "area"}
BETTER = {"better": "pretrained", "than": "uniform", "statistic": "area"}
ONLINE = BETTER | {"better": "aser"}


def a_claim(name, figure, rule=BETTER, **more):
    optional = dict.fromkeys(("section", "again", "shown", "found", "family")) | more
    return Claim(name=name, says=f"Claim {name}.", figure=figure, rule=rule, **optional)


def a_table(path, panels, levels, seeds=16, mazes=(0,), env="maze large"):
    """Runs that have about the level of their label in every evaluation, and at most 0."""
    rows = []
    for panel in panels:
        for label, level in levels.items():
            for maze in mazes:
                for seed in range(seeds):
                    noise = np.random.default_rng([seed, maze]).normal(size=len(STEPS)) * 0.05
                    returns = dict(zip(STEPS, np.minimum(level + noise, 0.0), strict=True))
                    where = {"panel": panel, "maze": maze, "label": label, "sampler": label}
                    rows.append({**where, "env": env, "seed": seed, **returns})
    path.parent.mkdir(exist_ok=True)
    pd.DataFrame(rows).to_csv(path, index=False)


@pytest.fixture
def tables(tmp_path):
    references = {
        "env": ["maze large", "pendulum"],
        "random": [-10.0, -1200.0],
        "best": [0.0, -150.0],
        "worst": [-100.0, -3000.0],
        "solvable": [True, False],
    }
    pd.DataFrame(references).to_csv(tmp_path / "references.csv", index=False)
    prior = {"uniform": -3.0, "oracle": 0.2, "pretrained": -2.0}
    a_table(tmp_path / "fig04.csv", ["tuned", "thesis"], prior)
    online = {"uniform": -3.0, "aser": -1.0, "per": -3.1}
    a_table(tmp_path / "fig05.csv", ["tuned", "thesis"], online)
    swing = {"uniform": -300.0, "aser": -301.0, "pretrained": -200.0}
    a_table(tmp_path / "fig12.csv", ["tuned"], swing, env="pendulum")
    mazes = {"uniform": -3.0, "oracle": 0.2, "pretrained": -3.0}
    path = tmp_path / "beyond" / "nine_mazes.csv"
    a_table(path, ["tuned", "at_aser"], mazes, seeds=5, mazes=range(3))
    return claims.Tables(train.CONF, tmp_path)


@pytest.mark.parametrize(
    ("figure", "rule", "verdict"),
    [
        ("fig04", {"better": "oracle", "than": "uniform"}, REPRODUCED),
        ("fig04", {"better": "uniform", "than": "oracle"}, NOT_REPRODUCED),
        ("fig05", {"better": "aser", "than": "fig04:pretrained"}, REPRODUCED),
        # The margin is a tenth of about 3: 0.1 is within it, 2 is not.
        ("fig05", {"no_worse": "per", "than": "uniform", "oracle": "fig04:oracle"}, REPRODUCED),
        ("fig05", {"about_equal": "per", "than": "aser", "oracle": "fig04:oracle"}, NOT_REPRODUCED),
        # Without an oracle it is a tenth of the way from -1200 to -150, which is 105.
        ("fig12", {"no_worse": "aser", "than": "uniform"}, REPRODUCED),
        ("fig12", {"about_equal": "pretrained", "than": "uniform"}, REPRODUCED),
        # Gains as shares of the way: 2 of 10 in the maze, 100 of 1050 in Pendulum.
        (
            "fig05",
            {
                "larger_gain": "aser",
                "than": "uniform",
                "gain_of": "fig12:pretrained",
                "gain_than": "fig12:uniform",
            },
            REPRODUCED,
        ),
        # From -3 to 0, -2 is a third of the way.
        ("fig04", THIRD | {"least": 0.3}, REPRODUCED),
        ("fig04", THIRD | {"least": 0.4}, NOT_REPRODUCED),
        ("fig04", {"always": "oracle"}, REPRODUCED),
        ("fig04", {"not_always": "uniform"}, REPRODUCED),
        ("fig04", {"always": "uniform", "step": 300}, NOT_REPRODUCED),
        ("fig04", {"all": [{"always": "oracle"}, {"always": "uniform"}]}, NOT_REPRODUCED),
        ("fig04", {"all": [{"always": "oracle"}, {"not_always": "uniform"}]}, REPRODUCED),
    ],
)
def test_a_claim_with_a_known_answer(tables, figure, rule, verdict):
    rule = {"statistic": "area", **rule} if "than" in rule else rule
    assert claims.decide(rule, Scope(tables, figure, "tuned")).verdict == verdict


def test_a_claim_in_every_scope(tables):
    known = [a_claim("one", "fig04", again="nine_mazes"), a_claim("two", "fig09", ONLINE)]
    outcomes = claims.outcomes(known, tables)
    here = outcomes[(outcomes["claim"] == "one") & (outcomes["figure"] == "fig04")]
    assert list(here["panel"]) == ["tuned", "thesis"] and set(here["verdict"]) == {REPRODUCED}
    again = outcomes[(outcomes["claim"] == "one") & (outcomes["figure"] == "nine_mazes")]
    assert list(again["maze"]) == [claims.POOLED, 0, 1, 2] and set(again["panel"]) == {"tuned"}
    assert set(again["verdict"]) == {UNDECIDED}  # the same numbers: the interval is 0 to 0
    assert list(outcomes.loc[outcomes["claim"] == "two", "verdict"]) == ["not run"]


def test_a_rule_that_does_not_exist_is_an_error_and_not_a_claim_without_runs(tables):
    with pytest.raises(ConfigError, match="must have one of better, no_worse"):
        claims.outcomes([a_claim("one", "fig04", {"bettr": "aser", "than": "uniform"})], tables)
    with pytest.raises(ConfigError, match="did you mean fig04"):
        claims.outcomes([a_claim("one", "fig4")], tables)


def test_a_run_that_the_figure_does_not_have_is_an_error_and_not_a_claim_without_runs(tables):
    for figure in ("fig05", "fig09"):  # run, and not run
        with pytest.raises(ConfigError) as caught:
            rule = {"better": "aser", "than": "unifrom", "statistic": "area"}
            claims.outcomes([a_claim("one", figure, rule)], tables)
        line = f"claims.one.rule=unifrom: {figure} has the runs uniform, per, "
        assert str(caught.value).startswith(line)


@pytest.mark.parametrize(
    ("rule", "line"),
    [
        (
            BETTER | {"statistic": "mean"},
            "rule.statistic=mean: must be one of area, final, iqm, solved, spread, steps_to_90",
        ),
        (BETTER | {"statistic": "IQM"}, "rule.statistic=IQM: must be one of"),
        ({"better": "aser", "than": "uniform"}, "rule.statistic is missing"),
        ({"better": "aser", "statistic": "area"}, "rule.than is missing"),
        (BETTER | {"step": 3}, "rule.step=3: there is no such key"),
        ({"positive": "auc", "of": "aser"}, "rule.positive=auc: must be one of"),
        ({"positive": "decision_auc"}, "rule.of is missing"),
        ({"always": ["aser"]}, 'rule.always=["aser"]: must be a text'),
        ({"all": "better"}, "rule.all=better: must be a list of rules"),
        ({"all": [{"always": "aser"}, {}]}, "rule={}: must have one of better"),
        ("better", "rule=better: must be a rule"),
        (BETTER | {"resample": "maze"}, "rule.resample=maze: must be one of mazes; did you mean m"),
        (BETTER | {"least": 0.5}, "rule.least=0.5: there is no such key"),
        (THIRD, "rule.least is missing"),
        (THIRD | {"least": "half"}, "rule.least=half: must be a finite number in [0, 1]"),
        (THIRD | {"least": 50}, "rule.least=50: must be a finite number in [0, 1]"),
        (THIRD | {"least": 0.5, "from": 3}, "rule.from=3: must be a text"),
    ],
)
def test_an_improper_rule_is_one_line_before_any_table_is_read(rule, line, tmp_path):
    for part in ("thesis", "beyond"):
        (tmp_path / f"{part}.yaml").write_text(
            yaml.safe_dump({"one": {"says": "x", "figure": "fig04", "rule": rule}})
        )
    with pytest.raises(ConfigError) as caught:
        claims.load(tmp_path)
    assert str(caught.value).startswith(f"claims.thesis.one.{line}")
    assert "\n" not in str(caught.value)


def test_the_iqm_is_a_statistic_of_claims(tables, tmp_path):
    """A quarter of bad runs moves the mean area and not the IQM."""
    rows = pd.read_csv(tmp_path / "fig04.csv")
    bad = (rows["label"] == "uniform") & (rows["seed"] < 4)
    rows.loc[bad, [str(step) for step in STEPS]] = -50.0
    good = rows["label"] == "pretrained"
    rows.loc[good, [str(step) for step in STEPS]] = -3.5
    rows.to_csv(tmp_path / "fig04.csv", index=False)
    verdicts = {}
    for statistic in ("area", "iqm"):
        claim = a_claim("one", "fig04", BETTER | {"statistic": statistic})
        found = claims.outcomes([claim], tables).iloc[0]
        verdicts[statistic] = found.verdict
    assert verdicts["area"] == REPRODUCED  # -3.5 against about -15
    assert found.estimate == pytest.approx(-0.5, abs=0.05)  # -3.5 against about -3
    assert verdicts["iqm"] != REPRODUCED
    parts = {"thesis": [claim], "beyond": []}
    outcomes = {"thesis": claims.outcomes([claim], tables), "beyond": claims.outcomes([], tables)}
    ledger.write(parts, outcomes, tables, tmp_path / "claims.md")
    assert "| IQM of the areas |" in (tmp_path / "claims.md").read_text()


def test_the_ledger_shows_every_claim(tables, tmp_path):
    parts = {
        "thesis": [
            a_claim("one", "fig04", section="4.2", again="nine_mazes", found="It is so."),
            a_claim("two", "fig09", ONLINE, section="4.3"),
            a_claim("three", "fig12", {**BETTER, "better": "uniform", "than": "pretrained"}),
        ],
        "beyond": [a_claim("four", "nine_mazes"), a_claim("five", "fig05", {"always": "aser"})],
    }
    outcomes = {part: claims.outcomes(known, tables) for part, known in parts.items()}
    ledger.write(parts, outcomes, tables, tmp_path / "claims.md")
    lines = (tmp_path / "claims.md").read_text().splitlines()
    count = "Of {}, by the first set of hyper-parameters of each: {}."
    assert count.format(3, "1 reproduced, 1 not reproduced, 1 not run") in lines
    assert count.format(2, "1 no, 1 undecided") in lines
    same = "undecided: 0.000 [0.000, 0.000]"
    gain = "mean area | 1.00 [1.00, 1.00] | reproduced | reproduced"
    one = f"| 4.2 | Claim one. | {gain} | {same} | 2 undecided | {same} |"
    assert f"{one} [fig04](figures/fig04.png) |" in lines
    assert "| 4.3 | Claim two. | mean area | - | not run | - | - | - | - | " in "\n".join(lines)
    assert "- *Claim one.* It is so." in lines
    four = "0.000 [0.000, 0.000] | undecided | 3 undecided | [nine_mazes](figures/beyond/nine_mazes"
    titles = tables.spec("nine_mazes").titles
    assert f"| Claim four. | {titles['tuned']} | {four}.png) |" in lines
    assert f"|  | {titles['at_aser']} | {four}.png) |" in lines
    assert f"| Claim four. | {titles['tuned']} | ? 0.00 | ? 0.00 | ? 0.00 |" in lines


def test_what_only_the_nine_mazes_decide_is_not_run_in_the_large_one(tables, tmp_path):
    (tmp_path / "fig04.csv").unlink()
    found = claims.Tables(train.CONF, tmp_path)
    known = [a_claim("one", "fig04", again="nine_mazes")]
    outcomes = claims.outcomes(known, found)
    assert set(outcomes["figure"]) == {"nine_mazes"}
    parts, outcomes = {"thesis": known, "beyond": []}, {"thesis": outcomes, "beyond": outcomes[:0]}
    ledger.write(parts, outcomes, found, tmp_path / "claims.md")
    text = (tmp_path / "claims.md").read_text()
    assert "| Claim one. | mean area | - | not run | - | undecided: 0.000 [0" in text
    assert "of each: 1 not run." in text


def test_the_best_return_must_be_the_same_in_all_mazes(tables, tmp_path):
    path = tmp_path / "beyond" / "nine_mazes.csv"
    rows = pd.read_csv(path)
    rows["env"] = rows["env"].where(rows["maze"] < 2, "maze other")
    rows.to_csv(path, index=False)
    references = pd.read_csv(tmp_path / "references.csv")
    for best in (0.0, 0.7):
        more = {"env": "maze other", "random": -9, "best": best, "worst": -100, "solvable": True}
        both = pd.concat([references, pd.DataFrame([more])])
        both.to_csv(tmp_path / "references.csv", index=False)
        scope = Scope(claims.Tables(train.CONF, tmp_path), "nine_mazes", "tuned", claims.POOLED)
        if best:
            with pytest.raises(ConfigError, match=r"best returns of its mazes differ \(0, 0.7\)"):
                scope.runs("oracle")
        else:
            assert scope.runs("oracle").best == 0.0


def test_a_claim_with_an_unknown_key_is_refused(tmp_path):
    block = {"says": "x", "figure": "fig04", "rule": BETTER}
    for part in ("thesis", "beyond"):
        (tmp_path / f"{part}.yaml").write_text(yaml.safe_dump({"one": block}))
    assert [claim.name for claim in claims.load(tmp_path)["beyond"]] == ["one"]
    (tmp_path / "beyond.yaml").write_text(yaml.safe_dump({"one": block | {"again_in": "x"}}))
    with pytest.raises(ConfigError, match=r"claims\.beyond\.one\.again_in"):
        claims.load(tmp_path)


def test_a_family_needs_a_rule_with_a_p_value(tmp_path):
    block = {"says": "x", "figure": "fig04", "rule": {"always": "aser"}, "family": "one"}
    for part in ("thesis", "beyond"):
        (tmp_path / f"{part}.yaml").write_text(yaml.safe_dump({"first": block}))
    with pytest.raises(ConfigError) as caught:
        claims.load(tmp_path)
    allowed = "its rule has no p-value; allowed: better or share with area, final, solved"
    assert str(caught.value) == f"claims.thesis.first.family=one: {allowed}"


def test_resampled_mazes_are_decided_over_all_mazes_alone(tables):
    rule = {"better": "oracle", "than": "uniform", "statistic": "area", "resample": "mazes"}
    outcomes = claims.outcomes([a_claim("one", "nine_mazes", rule)], tables)
    assert list(outcomes["panel"]) == ["tuned", "at_aser"]
    assert list(outcomes["maze"]) == [claims.POOLED] * 2
    assert list(outcomes["verdict"]) == [REPRODUCED] * 2
    with pytest.raises(ConfigError, match="resample=mazes: these runs have one maze"):
        claims.outcomes([a_claim("one", "fig04", rule)], tables)


@pytest.fixture
def spread(tables, tmp_path):
    """Seeds of `aser` that are ahead of uniform, but a few bad ones make it less sure."""
    path = tmp_path / "beyond" / "outcome_spread.csv"
    mazes = (101, 102, 116)
    a_table(path, ["at_thesis"], {"uniform": -3.0, "aser": -2.0, "nstep": -1.0}, mazes=mazes)
    rows = pd.read_csv(path)
    bad = (rows["label"] == "aser") & (rows["seed"] < 4)
    rows.loc[bad, [str(step) for step in STEPS]] = -4.5
    rows.to_csv(path, index=False)
    return tables


def test_a_family_has_p_values_and_holms_correction(spread):
    def better(label, **more):
        return {"better": label, "than": "uniform", "statistic": "area", **more}

    known = [
        a_claim("clear", "outcome_spread", better("nstep"), family="one"),
        a_claim("unsure", "outcome_spread", better("aser"), family="one"),
        a_claim("later", "outcome_spread_halves", better("aser"), family="one"),
        a_claim("other", "outcome_spread", better("aser"), family="two"),
        a_claim("alone", "outcome_spread", better("aser")),
    ]
    rows = claims.outcomes(known, spread)
    assert rows.columns.tolist()[-3:] == ["family", "p", "holm"]
    alone = rows[rows["claim"] == "alone"]
    assert len(alone) == 4 and alone[["family", "p", "holm"]].isna().all(axis=None)
    single = rows[rows["maze"] > 0]
    assert len(single) == 4 * 3 and single[["p", "holm"]].isna().all(axis=None)
    asked = rows[rows["family"].notna() & ~(rows["maze"] > 0)].set_index("claim")
    p = asked.loc["unsure", "p"]
    assert asked.loc["clear", "p"] == 0  # no seed differs from another one
    assert 0.0001 < p < 0.04 and asked.loc["unsure", "verdict"] == REPRODUCED
    # Three questions, of which one is not answered yet: 3 p, 2 p. Of its own family, it is p.
    assert asked.loc["unsure", "holm"] == pytest.approx(2 * p)
    assert asked.loc["other", "holm"] == pytest.approx(p)
    assert asked.loc["later", "verdict"] == "not run" and np.isnan(asked.loc["later", "holm"])


def test_an_answer_that_does_not_hold_in_its_family_is_undecided():
    def row(verdict, holm):
        return ledger.after_holm(pd.Series({"verdict": verdict, "holm": holm}))

    assert row(REPRODUCED, 0.05) == REPRODUCED and row(REPRODUCED, 0.051) == UNDECIDED
    assert row(NOT_REPRODUCED, 0.01) == NOT_REPRODUCED and row(NOT_REPRODUCED, 0.3) == UNDECIDED
    assert row(UNDECIDED, 0.01) == UNDECIDED and row("not run", np.nan) == "not run"


def test_the_ledger_shows_a_family_apart(spread, tmp_path):
    gain = {"better": "nstep", "than": "uniform", "statistic": "area"}
    alone = a_claim("alone", "nine_mazes", found="It is so.")
    family = [
        a_claim("clear", "outcome_spread", gain, family="spread"),
        a_claim("over mazes", "outcome_spread", gain | {"resample": "mazes"}, family="spread"),
        a_claim("later", "outcome_spread_halves", ONLINE, family="spread"),
    ]
    texts = []
    for known in ([alone], [alone, *family]):
        outcomes = {"thesis": claims.outcomes([], spread), "beyond": claims.outcomes(known, spread)}
        ledger.write({"thesis": [], "beyond": known}, outcomes, spread, tmp_path / "claims.md")
        texts.append((tmp_path / "claims.md").read_text())
    without, text = texts
    assert text.startswith(without)  # what stands alone is told as before
    lines = text[len(without) :].splitlines()
    count = "Of 3, by the first set of hyper-parameters of each: 2 yes, 1 not run."
    assert "### The family spread" in lines and count in lines
    title = spread.spec("outcome_spread").titles["at_thesis"]
    numbers = "2.00 [2.00, 2.00] | yes | <0.0001 | <0.0001 | yes"
    link = "[outcome_spread](figures/beyond/outcome_spread.png)"
    assert f"| Claim clear. | {title} | {numbers} | 3 yes | {link} |" in lines
    assert f"| Claim over mazes. | {title} | {numbers} | - | {link} |" in lines
    missing = "| Claim later. | - | - | not run | - | - | not run | - | outcome_spread_halves |"
    assert missing in lines
    assert "| claim | hyper-parameters | 101 | 102 | 116 |" in lines
    assert any("Mazes 101 to 116 are named by their generator's seeds." in line for line in lines)
    assert f"| Claim clear. | {title} | ✓ 2.00 | ✓ 2.00 | ✓ 2.00 |" in lines


def test_the_committed_claims_are_decidable_in_form():
    for part in claims.load(train.CONF / "claims").values():
        for claim in part:
            for rule in claim.rule.get("all", [claim.rule]):
                assert sum(kind in rule for kind in claims.RULES) == 1
