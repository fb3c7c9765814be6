"""conf/ as it composes: all samplers in all environments, what `auto` means, a file and back."""

import dataclasses
import inspect
import itertools
import math
import shutil
from pathlib import Path

import pytest
import yaml

import aser.envs
import train
from aser.errors import ConfigError
from aser.settings import keys
from aser.settings.config import names, parse
from aser.settings.sampler import CriterionConfig
from train import CONF, settings

GYM = ["env=gym", "env.id=MountainCarContinuous-v0"]
SAMPLERS = names(CONF, "sampler")
ENVS = names(CONF, "env")
STANDARD = {  # env=gym with other defaults
    "mujoco": ["env=mujoco", "env.id=Hopper-v5"],
    "box2d": ["env=box2d", "env.id=BipedalWalker-v3"],
    "dmc": ["env=dmc", "env.id=cheetah-run"],
}


def composed(*overrides):
    return settings(list(overrides))


def everywhere():
    """Of the standard tasks' environments, which are env=gym with other defaults, few are quick."""
    for env, sampler in itertools.product(ENVS, SAMPLERS):
        quick = env not in STANDARD or sampler in ("aser", "per", "outcome_spread")
        yield pytest.param(sampler, env, marks=[] if quick else pytest.mark.slow)


@pytest.mark.parametrize(("sampler", "env"), [*everywhere()])
def test_every_sampler_in_every_environment(sampler, env):
    words = {"gym": GYM, **STANDARD}.get(env, [f"env={env}"])
    overrides, env = [f"sampler={sampler}", *words], "gym" if env in STANDARD else env
    if env == "pendulum" and sampler.startswith("oracle"):
        with pytest.raises(ConfigError, match="env=pendulum .*maze, maze_sparse, corridor"):
            composed(*overrides)
        return
    config = composed(*overrides)
    assert config.sampler == sampler and config.env.name == env
    tuned = (CONF / "hyper" / "tuned" / env / f"{sampler}.yaml").is_file()
    assert config.hyper.set in (
        ("tuned",) if tuned else ("sb3",) if env == "gym" else ("tuned", "thesis")
    )
    assert all(value is None or math.isfinite(value) for value in config.hyper.values.values())
    assert parse(yaml.safe_load(yaml.safe_dump(config.to_dict()))) == config


@pytest.mark.parametrize(
    ("sampler", "criterion", "prioritisation", "weights", "bootstrap", "threshold"),
    [
        ("uniform", "uniform", "uniform", False, "one_step", None),
        ("per", "td_error", "proportional", True, "one_step", None),
        ("rank", "td_error", "rank", True, "one_step", None),
        ("relo", "reducible_loss", "relo", True, "one_step", None),
        ("laber", "uniform", "laber", False, "one_step", None),
        ("lap", "td_error", "lap", False, "one_step", None),
        ("la3p", "td_error", "la3p", False, "one_step", None),
        ("reaper", "td_error", "reaper", True, "one_step", None),
        ("pal", "uniform", "uniform", False, "one_step", None),
        ("recent", "uniform", "recent", False, "one_step", None),
        ("cer", "uniform", "cer", False, "one_step", None),
        ("ere", "uniform", "ere", False, "one_step", None),
        ("nstep", "uniform", "uniform", False, "fixed", None),
        ("nstep_geometric", "uniform", "uniform", False, "geometric", None),
        ("cvs", "q_range", "uniform", False, "cumulative", None),
        ("mmddpg", "uniform", "uniform", False, "averaged", None),
        ("preferential", "q_range", "proportional", False, "preferential", None),
        ("aser", "mode_log_prob", "proportional", False, "threshold", "quantile"),
        ("aser_no_prioritisation", "mode_log_prob", "uniform", False, "threshold", "quantile"),
        ("aser_no_bootstrap", "mode_log_prob", "proportional", False, "one_step", None),
        ("pretrained", "pretrained", "proportional", False, "threshold", "quantile"),
        ("oracle", "oracle", "proportional", False, "threshold", 0.5),
        ("oracle_no_prioritisation", "oracle", "uniform", False, "threshold", 0.5),
        ("oracle_no_bootstrap", "oracle", "proportional", False, "one_step", None),
        ("aser_shuffled", "shuffled", "proportional", False, "threshold", "quantile"),
        ("aser_q", "q_range", "proportional", False, "threshold", "quantile"),
        *(
            (name, name, "proportional", False, "threshold_or_zero", "quantile")
            for name in (
                "outcome_spread",
                "outcome_spread_shuffled",
                "outcome_model",
                "outcome_model_shuffled",
            )
        ),
    ],
)
def test_what_each_sampler_is_made_of(
    sampler, criterion, prioritisation, weights, bootstrap, threshold
):
    config = composed(f"sampler={sampler}")
    assert config.criterion.name == criterion
    assert (config.prioritisation.name, config.prioritisation.weights) == (prioritisation, weights)
    assert config.bootstrap.name == bootstrap
    if bootstrap.startswith("threshold"):
        assert (config.bootstrap.criterion, config.bootstrap.threshold) == (
            config.criterion,
            threshold,
        )


def test_the_table_of_samplers_above_is_whole():
    marks = test_what_each_sampler_is_made_of.pytestmark[0].args[1]
    assert sorted(row[0] for row in marks) == SAMPLERS
    assert sorted(keys.SAMPLERS) == SAMPLERS


@pytest.mark.parametrize("group", ["criterion", "env", "network", "prioritisation", "bootstrap"])
def test_a_file_and_what_it_names_are_called_the_same(group):
    for name in names(CONF, group):
        content = yaml.safe_load((CONF / group / f"{name}.yaml").read_text())
        assert content.get(group, content)["name"] == name


def test_the_defaults_where_the_thesis_leaves_a_choice():
    config = composed("env=maze", "sampler=aser")
    assert (config.bootstrap.batch, config.bootstrap.path_entropy) == ("uniform", "fresh")
    assert config.prioritisation.new == "current_max"
    assert config.agent == dataclasses.replace(
        config.agent, actor_batch="prioritised", td_error="min"
    )
    assert config.criterion.squashed is True
    assert config.hyper.values["epsilon"] == 0.01
    assert config.network.hidden == (24,)
    assert (config.seeds, config.steps, config.buffer) == (tuple(range(16)), 5000, 5000)
    assert (config.batch, config.learning_starts) == (256, 100)
    assert (config.eval_every, config.eval_episodes) == (100, 1)


def test_what_importance_weights_are_divided_by_is_named_where_it_is_not_the_usual():
    batch = composed("sampler=per", "prioritisation.over=batch")
    assert batch.prioritisation.over == "batch" and parse(batch.to_dict()) == batch
    assert batch.to_dict()["prioritisation"]["over"] == "batch"
    usual = composed("sampler=per")
    assert usual.prioritisation.over == "buffer"
    assert usual.to_dict()["prioritisation"] == {
        "name": "proportional",
        "weights": True,
        "new": "current_max",
    }
    assert list(usual.to_dict()["agent"]) == ["name", "actor_batch", "td_error"]


def test_auto_follows_what_it_depends_on():
    assert composed("env=corridor").steps == 2000
    assert composed("env=corridor", "steps=700").buffer == 700
    assert composed("steps=3000000").buffer == 1_000_000
    assert composed("env=pendulum").eval_episodes == 10
    assert composed("env=pendulum", "eval.episodes=3").eval_episodes == 3
    assert composed(*GYM).network.hidden == (256, 256)
    assert composed(*GYM, "network=small").network.hidden == (24,)
    assert composed("eval.every=null").eval_every is None


def test_the_command_line_wins_over_a_sampler_and_a_debug_file():
    config = composed("bootstrap=fixed", "sampler=aser", "debug=smoke", "seeds=[7,3]")
    assert (config.bootstrap.name, config.criterion.name) == ("fixed", "mode_log_prob")
    assert (config.seeds, config.steps, config.compile) == ((7, 3), 300, False)


def test_the_bootstrap_rule_may_have_a_criterion_of_its_own():
    for spelling in ("bootstrap.criterion.name=oracle", "bootstrap.criterion={name: oracle}"):
        config = composed(spelling)
        assert (config.criterion.name, config.bootstrap.criterion.name) == (
            "mode_log_prob",
            "oracle",
        )
        assert config.bootstrap.threshold == 0.5
        assert not {"k_m", "k_s"} & set(config.hyper.values)
    quantile = composed("bootstrap.criterion.name=oracle", "bootstrap.threshold=quantile")
    assert {"k_m", "k_s"} <= set(quantile.hyper.values)
    assert composed("bootstrap.threshold=1.5").bootstrap.threshold == 1.5


def test_hyper_from_takes_another_samplers_row():
    config = composed("sampler=uniform", "hyper=thesis", "hyper.from=aser", "hyper.gamma=.5")
    assert config.hyper.values == {
        "lr": 2.356e-2,
        "gamma": 0.5,
        "tau": 2.025e-2,
        "target_entropy": None,
    }


def test_hyper_from_is_refused_beside_a_table():
    table = f"hyper={train.CONF / 'hyper' / 'thesis' / 'maze' / 'aser.yaml'}"
    assert composed("sampler=aser", table).hyper.values["lr"] == 2.356e-2
    with pytest.raises(
        ConfigError, match="hyper.from=per: not used where hyper=.*aser.yaml is a t"
    ):
        composed("sampler=aser", table, "hyper.from=per")


def test_criteria_of_criteria():
    config = composed(
        "criterion=pretrained", "criterion.of=entropy", "criterion.checkpoint=some/run"
    )
    assert config.criterion == CriterionConfig("pretrained", "entropy", "some/run")
    shuffled = composed("criterion=shuffled").criterion
    assert shuffled == CriterionConfig("shuffled", "mode_log_prob", None, True)


def test_a_criterion_of_ones_own_is_a_file_that_names_its_function(tmp_path, monkeypatch):
    conf = tmp_path / "conf"
    shutil.copytree(CONF, conf)
    monkeypatch.setattr(train, "CONF", conf)
    (conf / "criterion/mine.yaml").write_text(
        "name: my_module.mine\nof: null\ncheckpoint: null\nsquashed: null\n"
    )
    assert composed("criterion=mine").criterion.name == "my_module.mine"
    assert composed("bootstrap.criterion.name=mine").bootstrap.criterion.name == "my_module.mine"
    assert composed("criterion=shuffled", "criterion.of=mine").criterion.of == "my_module.mine"
    assert (
        composed("bootstrap.criterion.name=other.function").bootstrap.criterion.name
        == "other.function"
    )


def test_settings_are_frozen():
    config = composed()
    with pytest.raises(dataclasses.FrozenInstanceError):
        config.steps = 3
    with pytest.raises(dataclasses.FrozenInstanceError):
        config.env.id = "x"


@pytest.mark.parametrize("env", [name for name in ENVS if name not in ("gym", *STANDARD)])
def test_an_environments_file_makes_that_environment(env):
    config = composed(f"env={env}").env
    made = aser.envs.make(config.id, 3, **config.kwargs)
    assert made.num_envs == 3
    made.close()


def test_the_corridors_gates_are_the_classs_own():
    from aser.envs.corridor import CorridorVectorEnv

    defaults = inspect.signature(CorridorVectorEnv).parameters
    kwargs = composed("env=corridor").env.kwargs
    assert [list(gate) for gate in defaults["gates"].default] == kwargs["gates"]
    assert defaults["length"].default == kwargs["length"]


def test_a_runs_own_settings_need_no_tables_and_composed_ones_do():
    config = composed("sampler=per", "hyper=thesis")
    with pytest.raises(ConfigError, match="hyper.source is missing"):
        parse({**config.to_dict(), "hyper": {"set": "thesis"}})
    with pytest.raises(ConfigError, match="hyper is missing"):
        parse({key: value for key, value in config.to_dict().items() if key != "hyper"})
    assert parse({**config.to_dict(), "hyper": {"set": "thesis"}}, Path(CONF)).hyper == config.hyper
