"""Settings as flat keys, as the command line writes them; which of them change no result."""

from collections.abc import Iterator, Mapping
from typing import Any

# They say where a run lies and how it is carried out. They are not part of its identity.
INCIDENTAL = ("run_dir", "resume", "force", "threads", "checkpoint", "log")
# They say on which machine it runs. Results differ by rounding only.
MACHINE = ("device", "compile")
# The samplers of conf/sampler. Their names stand for criteria, which settings may replace.
SAMPLERS = {
    "aser",
    "aser_no_bootstrap",
    "aser_no_prioritisation",
    "aser_q",
    "aser_shuffled",
    "cer",
    "cvs",
    "ere",
    "la3p",
    "laber",
    "lap",
    "mmddpg",
    "nstep",
    "nstep_geometric",
    "oracle",
    "oracle_no_bootstrap",
    "oracle_no_prioritisation",
    "outcome_model",
    "outcome_model_shuffled",
    "outcome_spread",
    "outcome_spread_shuffled",
    "pal",
    "per",
    "preferential",
    "pretrained",
    "rank",
    "reaper",
    "recent",
    "relo",
    "uniform",
}


def flat(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Each value of nested mappings with its dotted key: {"a": {"b": 1}} gives ("a.b", 1)."""
    for key, value in tree.items():
        if isinstance(value, Mapping):
            yield from flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def method(settings: Mapping[str, Any]) -> str:
    """What a run is called: its sampler, and a criterion of one's own in the place of the usual.

    `settings` are those of a config.yaml. For example `aser`, `aser (my_criteria.regret)`, `aser
    (shuffled my_criteria.regret)`. A sampler of one's own has a name that its author chose, so it
    is enough.
    """
    given, sampler = dict(flat(settings)), str(settings["sampler"])
    own = []
    for before in ("", "bootstrap."):
        name, of = (str(given.get(f"{before}criterion.{key}")) for key in ("name", "of"))
        if "." in name + of:
            told = "." in name or name in sampler  # aser_shuffled tells that it is shuffled
            own.append(of if told and "." in of else name if told else f"{name} {of}")
    if not own or sampler not in SAMPLERS:
        return sampler
    return f"{sampler} ({', '.join(dict.fromkeys(own))})"
