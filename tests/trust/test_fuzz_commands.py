"""A fuzz of command lines: each is a run or one clear line, and leaves nothing half-written."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest
import yaml
from hypothesis import strategies as st
from search import failures, unclear

import train
from aser.files import is_draft
from aser.settings.keys import flat

SECONDS = 60  # of one command; most take less than one
TINY = "debug=smoke steps=40 env.steps=110 learning_starts=20 batch=8 eval.every=20 eval.episodes=1"
TINY += " network.hidden=[8] compile=false"
PLACES = [  # an environment and an agent
    ["env=maze", "env.layout=toy"],
    ["env=corridor"],
    ["env=corridor", "agent=dqn"],
    ["env=pendulum"],
    ["env=gym", "env.id=wild:Wild-v0"],
]
GROUPS = ["agent", "network", "env", "criterion", "prioritisation", "bootstrap", "sampler"]
GROUPS += ["hyper", "debug"]
CHOICES = {group: train.names(train.CONF, group) for group in GROUPS}
EXAMPLES = ["sampler=aser", "sampler=per", "sampler=nstep_geometric", "sampler=pretrained"]
EXAMPLES += ["env=corridor", "env=corridor agent=dqn", "env=gym env.id=Pendulum-v1"]
KEYS = {key for line in EXAMPLES for key, _ in flat(train.settings(line.split()).to_dict())}
KEYS |= {"hyper.from", "env.layout_seed", "env.size", "env.goal", "env.kwargs", "hydra.run.dir"}
KEYS |= {"hydra.job.name", "hydra.job.chdir", "hydra.sweep.dir", "bootstrap.criterion", "eval"}
KEYS |= {"agent.exploration", "env", "hyper", "checkpoint", "network", "criterion"}
THEIRS = ["a_file", "strangers/thesis.tex", "unfinished/thesis.tex", "conf/train.yaml"]

FEW = ["1", "2", "3", "7", "2.5", ".3", "3e1", "1_2", "0x10", "1.", "+1", "007", "[3]", "[3,7]"]
HUGE = ["1" + "0" * 17, str(2**31), str(2**63), "1e17", "-" + str(2**63)]
TOO_LONG = {
    "steps": HUGE,
    "env.steps": HUGE,
    "compile": ["true", "auto"],
}  # right, but it takes long
WRONG_NUMBERS = ["9" * 400, "-" + "9" * 400, "1e400", "1e-400", "0", "-1", "-0.0", "nan", "inf"]
WRONG_NUMBERS += [
    "-inf",
    "1e308",
    "[nan]",
    "[" + "9" * 400 + "]",
    "[-1]",
    "[1,1]",
    "[1.5]",
    "[[1]]",
]
WORDS = ["null", "true", "false", "auto", "none", "yes", "~", "cuda:99", "cuda", "cpu", "quantile"]
SHAPES = ["[]", "{}", "[null]", "[[]]", "{a:1}", "{a:{b:[1,{c:2}]}}", "{name:x}", "[a,b]", "{1:2}"]
SHAPES += [
    "[[.4,.3,.7]]",
    "[[.4,a,.7]]",
    "[a",
    "{a",
    "a]",
    "(",
    ")",
    "[1,,2]",
    "{a:1,a:2}",
    "[true]",
]
TEXTS = ["", " ", "''", '""', "' '", "a b", "ä", "'ä'", '"', "'", "a'b", "#", "a#b", "=", "a=b"]
TEXTS += ["日本", "\u202e", "\x01", "a\tb", "a\nb", "'a\nb'", "\udcff", "\\", "a\\", "a:b", "a: b"]
TEXTS += [
    "%s",
    "{0}",
    "*",
    "a" * 300,
    "'" + "x y" * 2000 + "'",
    "-",
    "--",
    "_",
    "???",
    "!!int 3",
    "@",
]
GRAMMAR = ["a,b", "1,2", "choice(1,2)", "range(1,3)", "glob(*)", "interval(1,2)", "sort(2,1)"]
GRAMMAR += [
    "int(x)",
    "str(1)",
    "float(1)",
    "json_str([1])",
    "extend_list(3)",
    "${steps}",
    "${nope}",
]
GRAMMAR += [
    "${",
    "${}",
    "$",
    "$x",
    "${oc.env:NOPE}",
    "${oc.env:HOME}",
    "${now:%Y}",
    "${hydra:job.name}",
]
GRAMMAR += [
    "${sampler}",
    "${run_dir}",
    "${oc.decode:x}",
    "${oc.create:{a:1}}",
    "${env.layout}",
    "${..x}",
]
PATHS = ["/", ".", "..", "../..", "/proc/1/below", "/dev/null", "/dev/null/x", "a_file", "a_file/x"]
PATHS += [
    "strangers",
    "unfinished",
    "finished",
    "empty",
    "runs/a/b",
    "conf",
    "link",
    "broken",
    "no/x",
]
NAMES = [
    "math.sqrt",
    "json.dumps",
    "torch.relu",
    "nosuch.module",
    "aser",
    "os",
    ".",
    "a.",
    ".a",
    "a..b",
]
NAMES += [
    "CartPole-v1",
    "Pendulum-v1",
    "nosuch:X-v0",
    "os:X-v0",
    ":",
    "aser/Maze-v0",
    "torch.nn.ReLU",
]
VALUES = [*FEW, *HUGE, *WRONG_NUMBERS, *WORDS, *SHAPES, *TEXTS, *GRAMMAR, *PATHS, *NAMES]
VALUES += [choice for choices in CHOICES.values() for choice in choices]
FLAGS = ["--cfg", "-m", "--multirun", "-h", "--help", "-x", "--steps=3", "--", "-", "---", "-mm"]
FLAGS += [
    "--cfg=job",
    "-c",
    "--config-dir=conf",
    "",
    " ",
    "steps",
    "=",
    "==",
    "=3",
    "steps=",
    "ä=3",
]
FLAGS += [
    "~steps",
    "~steps=40",
    "~env.layout",
    "~sampler",
    "~hyper",
    "~nope",
    "~",
    "+",
    "++",
    "+=3",
]
FLAGS += [
    "+debug=smoke",
    "sampler@x=aser",
    "env@env2=maze",
    "+criterion@other=oracle",
    "env/x=maze",
]
FLAGS += [
    "hydra/launcher=nope",
    "hydra/launcher=basic",
    "hydra/sweeper=basic",
    "+hydra.x=1",
    "@file",
]
FLAGS += [
    "sampler=uniform,per",
    "seeds=1,2",
    "hyper.gamma=.9,2",
    "env=maze,corridor",
    "resume=true",
]
FLAGS += ["force=true", "sampler='aser'", "sampler=[aser,per]", "hyper.lr=choice(.1,.2)", "a.b.c=3"]


def _pair(key: str) -> st.SearchStrategy[str]:
    mean, all = (
        st.sampled_from([value for value in values if value not in TOO_LONG.get(key, ())])
        for values in ([*HUGE, *WRONG_NUMBERS, *SHAPES], VALUES)
    )
    return (mean | all).map(lambda value: f"{key}={value}")


def _misspelled(word: str, place: int, letter: str) -> str:
    return word[: place % len(word)] + letter + word[place % len(word) + 1 :]


KEY = st.sampled_from(sorted(KEYS))
GROUP = st.sampled_from(GROUPS)
CHOICE = GROUP.flatmap(lambda group: st.sampled_from(CHOICES[group]).map(lambda c: f"{group}={c}"))
ODD = KEY.map(lambda key: f"{key}=3") | CHOICE
TEXT = st.text(max_size=20).map(lambda text: text.replace("/", ""))  # never an absolute path
PAIR = KEY.flatmap(_pair)
WORD = st.one_of(
    PAIR,
    CHOICE,
    st.builds(lambda sign, word: sign + word, st.sampled_from(["+", "++", "~"]), PAIR),
    st.builds(lambda group, value: f"{group}={value}", GROUP, st.sampled_from(VALUES)),
    st.builds(_misspelled, ODD, st.integers(0, 99), st.sampled_from(["", "x", "=", ".", "ä", " "])),
    st.builds(lambda key, text: f"{key}={text}", st.sampled_from(["run_dir", "env.layout"]), TEXT),
    st.sampled_from(["-m", "--cfg", "resume=true", "force=true", "sampler=uniform,per"]),
    st.sampled_from(FLAGS),
).filter(lambda word: "\0" not in word)
# Mostly one odd word: of several, one sees the first that is refused.
WORDS = st.one_of(
    st.lists(PAIR, min_size=1, max_size=1),
    st.lists(WORD, min_size=1, max_size=1),
    st.lists(PAIR, min_size=1, max_size=2),
    st.lists(WORD, max_size=4),
)
LINES = st.builds(
    lambda place, sampler, words: [*place, f"sampler={sampler}", *words],
    st.sampled_from(PLACES),
    st.sampled_from(CHOICES["sampler"]),
    WORDS,
)


@pytest.fixture(scope="module")
def town(warm, tmp_path_factory):
    """A folder with a few things in the way: a finished run, an unfinished one, others' files."""
    town = tmp_path_factory.mktemp("town") / "here"
    ended = warm.run(
        [*TINY.split(), *PLACES[0], "sampler=uniform", "run_dir=finished"], town, SECONDS
    )
    assert ended.status == 0, ended.err
    (town / "a_file").write_text("not a folder")
    for folder in ("empty", "strangers", "unfinished"):
        (town / folder).mkdir()
        (town / folder / "thesis.tex").write_text("somebody's")
    (town / "empty" / "thesis.tex").unlink()
    shutil.copy(town / "finished" / "config.yaml", town / "unfinished")
    (town / "link").symlink_to("strangers")
    shutil.copytree(town / "finished", town / "broken")
    (town / "broken" / "summary.json").write_text('{"iqm_fin')
    return town


@pytest.mark.parametrize(
    ("part", "count"),
    [(0, 30), *(pytest.param(n, 250, marks=pytest.mark.slow) for n in range(1, 9))],
)
def test_a_command_is_a_run_or_one_clear_line(part, count, warm, town, tmp_path):
    number = iter(range(10**9))

    def complaint(words: list[str]) -> str | None:
        folder = tmp_path / f"{next(number)}" / "a" / "here"
        shutil.copytree(town, folder, symlinks=True)
        try:
            return judged(words, folder)
        finally:
            shutil.rmtree(folder.parent.parent)

    def judged(words: list[str], folder: Path) -> str | None:
        many = bool({"-m", "--multirun"} & set(words))
        line = [*TINY.split(), *(["hydra.launcher.n_jobs=1"] if many else []), *words]
        ended = warm.run(line, folder, SECONDS, {"HOME": str(folder / "home")})
        return unclear(ended, 9 if many else 1) or left(ended, words, town, folder)

    found = failures(LINES, complaint, count, part)
    assert not found, "\n".join(["", *sorted(found)])


def left(ended, words: list[str], town: Path, folder: Path) -> str | None:
    """What is wrong with what a command left behind, or printed."""
    for file in THEIRS:
        if not (folder / file).exists():
            return "somebody's file is gone"
    before, after = (
        {str(path.relative_to(base)) for path in base.rglob("*")} for base in (town, folder)
    )
    new = {path for path in after - before if "lock" not in path and "pretrained" not in path}
    if any(is_draft(Path(path)) for path in new):
        return "a leftover draft"
    runs = {path.parent for path in folder.rglob("config.yaml")} - {folder / "unfinished"}
    if not all((run / "summary.json").exists() for run in runs):
        return "a half-written run"
    many, quiet = (
        {*flags} & {*words} for flags in (("-m", "--multirun"), ("--cfg", "-h", "--help"))
    )
    if ended.status == 1 and new and not many:
        return f"leaves {min(new)}"
    if ended.status == 0 and "--cfg" in words and not many and not {"-h", "--help"} & {*words}:
        return None if isinstance(yaml.safe_load(ended.out), dict) else "prints no settings"
    if ended.status == 0 and not many and not quiet:
        said = re.search(r"results in (.+)\nnext: [^\n]*\n?\Z", ended.out, re.DOTALL)
        if said is None or not (folder / said[1].rstrip("\n") / "summary.json").exists():
            return "no results"
    return None
