"""The settings of a sampler: a drawing criterion, a prioritisation and a bootstrap rule."""

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Any

from aser.errors import ConfigError
from aser.settings import checks
from aser.settings.agent import AGENTS, facts

LARGEST_THRESHOLD = 1e38  # what float32 holds
PER_ITEM = ("td_error", "reducible_loss")  # criteria of drawn items, measured by their update
BINARY = {"oracle"}  # criteria that are 0 or 1
# These can tell their decision points, and these cannot. The build asks all others.
CAN_TELL, CANNOT_TELL = "maze, maze_sparse, corridor", {"pendulum"}
SPREAD_DEFAULTS = {  # as in its yaml
    "of": "both",
    "width": 0.1,
    "rate": 0.05,
    "buckets": 4096,
    "noise": "subtract",
    "tilings": 0,
}
MODEL_DEFAULTS = {"of": "both", "hidden": 24, "lr": 0.001}
COUNT_DEFAULTS = {"width": 0.1, "buckets": 4096}  # as in their yamls
LEARNED: dict[str, dict[str, Any]] = {  # the criteria that learn, with their parameters
    "outcome_spread": SPREAD_DEFAULTS,
    "outcome_spread_shuffled": SPREAD_DEFAULTS,
    "outcome_model": MODEL_DEFAULTS,
    "outcome_model_shuffled": MODEL_DEFAULTS,
    "visit_count": COUNT_DEFAULTS,
    "successor_count": COUNT_DEFAULTS,
}
LEARNED_KEYS = ("width", "rate", "buckets", "noise", "tilings", "hidden", "lr")
NOT_FUNCTIONS = {
    "auto",
    "uniform",
    *PER_ITEM,
    "oracle",
    "pretrained",
    "shuffled",
    *LEARNED,
}  # of an agent and a state
OUTCOMES = ("state", "value", "both")
NOISE = ("subtract", "keep")
MOST_TILINGS = 32
MOST_HIDDEN = 1024
MOST_BUCKETS = 2**16  # more would cost memory: a lane has a table for each tiling
CRITERION_KEYS = ("of", "checkpoint", "squashed", *LEARNED_KEYS)
PRIORITISATIONS: dict[str, dict[str, Callable[[str, Any], float]]] = {  # by a criterion
    "proportional": {},
    "lap": {"alpha": partial(checks.number, low=0.0)},
    "rank": {"alpha": partial(checks.number, low=0.0)},
    "la3p": {
        "alpha": partial(checks.number, low=0.0),
        "fraction": partial(checks.number, low=0.0, high=1.0, above=True),
    },
    "reaper": {
        "alpha": partial(checks.number, low=0.0),
        "omega": partial(checks.number, low=0.0),
    },
    "relo": {
        "alpha": partial(checks.number, low=0.0),
        "epsilon": partial(checks.number, low=0.0),
    },
}
MOST_RANKED = 10**5  # items of a buffer that is sorted or summed up at each step
MOST_LARGE = 1000  # times a batch: more is beyond any memory
MOST_COUNT = 2**31 - 1  # of items or steps: what int32 holds
WAYS: dict[str, dict[str, Callable[[str, Any], float]]] = {  # by no criterion: their parameters
    "uniform": {},
    "recent": {"q": partial(checks.number, low=0.0, high=1.0, above=True)},
    "cer": {},
    "ere": {
        "eta": partial(checks.number, low=0.0, high=1.0, above=True),
        "least": partial(checks.whole, most=MOST_COUNT),
        "cycle": partial(checks.whole, most=MOST_COUNT),
    },
    "laber": {"large": partial(checks.whole, least=2, most=MOST_LARGE)},
}
BOOTSTRAP_KEYS = {  # rule: its keys beside the name
    "one_step": ("window",),
    "fixed": ("path_entropy", "window"),
    "geometric": ("path_entropy", "window"),
    "threshold": ("criterion", "threshold", "batch", "path_entropy", "window"),
    "threshold_or_zero": ("criterion", "threshold", "batch", "path_entropy", "window"),
    "cumulative": ("criterion", "path_entropy", "window"),
    "averaged": ("path_entropy", "window"),
    "preferential": ("criterion", "path_entropy", "window"),
}
MIXTURES = ("averaged", "preferential")  # rules that bootstrap at several states
CORRECTIONS = ("none", "retrace", "clipped")  # of multi-step targets, by a stored log mu(a|s)


@dataclass(frozen=True)
class CriterionConfig:
    name: str
    # What `pretrained` takes of a frozen agent and `shuffled` of another state; what counts as
    # outcome for `outcome_spread` and `outcome_model`.
    of: str | None = None
    checkpoint: str | None = None  # run folder of the frozen agent; None: the shipped one
    squashed: bool | None = None  # mode_log_prob, mode_prob: the density after the tanh
    width: float | None = None  # outcome_spread, counts: side of a cell, in deviations
    rate: float | None = None  # outcome_spread: of the running mean and variance
    buckets: int | None = None  # outcome_spread, counts: of their tables
    noise: str | None = None  # outcome_spread: the spread of like actions: subtract, keep
    tilings: int | None = None  # outcome_spread: of a random projection of the state; 0: none
    hidden: int | None = None  # outcome_model: units of the hidden layer of its networks
    lr: float | None = None  # outcome_model: learning rate of its networks

    def to_dict(self) -> dict[str, Any]:
        """As in its yaml, without the parameters of learned criteria that it does not have."""
        others = set(LEARNED_KEYS) - set(LEARNED.get(self.name, ()))
        return {key: value for key, value in asdict(self).items() if key not in others}


@dataclass(frozen=True)
class PrioritisationConfig:
    name: str  # one of WAYS or PRIORITISATIONS, or module.function
    weights: bool = False  # importance weights
    new: str = "current_max"  # a new item's priority: current_max, ever_max
    parameters: Mapping[str, float] = field(default_factory=dict)  # that its yaml adds
    over: str = "buffer"  # or batch: whose largest importance weight is 1

    @property
    def by_criterion(self) -> bool:
        """Whether items have priorities, which are made of a criterion."""
        return self.name not in WAYS

    @property
    def hyper(self) -> tuple[str, ...]:
        """The hyper-parameters that it reads."""
        if not self.by_criterion:
            return ()
        shape = () if "alpha" in self.parameters else ("alpha", "epsilon")
        return (*shape, "beta") if self.weights else shape

    @property
    def large(self) -> int:
        """How many times as large as a batch that is which is drawn."""
        return int(self.parameters.get("large", 1))

    def parts(self, batch: int) -> tuple[int, ...]:
        """The numbers of items that are drawn for the updates of a step; most have one."""
        if (fraction := self.parameters.get("fraction")) is None:
            return (batch * self.large,)
        second = round(batch * fraction)
        return batch - second, second

    def to_dict(self) -> dict[str, Any]:
        """As in its yaml."""
        shared = {"weights": self.weights, "new": self.new} if self.by_criterion else {}
        other = {} if self.over == "buffer" else {"over": self.over}
        return {"name": self.name, **shared, **other, **self.parameters}


@dataclass(frozen=True)
class BootstrapConfig:
    name: str  # a file of conf/bootstrap, or module.function
    criterion: CriterionConfig  # the drawing one where none is named
    reads_criterion: bool  # whether the rule decides by it
    threshold: str | float | None = "quantile"  # or the number itself; None: it has none
    batch: str = "uniform"  # that sets the threshold: uniform, prioritised
    path_entropy: str = "none"  # fresh, stored, none
    window: int | None = None  # steps read for an item; None: h
    correction: str = "none"  # one of CORRECTIONS

    @property
    def keys(self) -> tuple[str, ...]:
        """The keys that the rule has in its yaml, beside the name.

        The correction is among them where there is one, so that other runs keep their names.
        """
        corrected = () if self.correction == "none" else ("correction",)
        return (*_keys_of_rule(self.name, self.reads_criterion), *corrected)


# The files of conf/criterion and the name that each holds; None where they are not to be looked up.
Known = Mapping[str, str] | None


def read_criterion(key: str, value: Any, env: str, agent: str, known: Known) -> CriterionConfig:
    block = checks.block(key, value, ("name",), CRITERION_KEYS)
    name, of, checkpoint, squashed, *_ = block.values()
    name = _function_name(key, facts(agent).criterion if name == "auto" else name, agent, known)
    if name in ("pretrained", "shuffled"):
        of = _function_name(
            f"{key}.of", facts(agent).criterion if of is None else of, agent, known, NOT_FUNCTIONS
        )
    elif "of" not in LEARNED.get(name, ()) and of is not None:
        checks.refuse(
            f"{key}.of",
            of,
            f"{name} takes none; only pretrained, shuffled, outcome_spread and outcome_model do",
        )
    if checkpoint is not None:
        checks.text(f"{key}.checkpoint", checkpoint)
        if name != "pretrained":
            checks.refuse(
                f"{key}.checkpoint", checkpoint, f"{name} takes none; only pretrained does"
            )
    learned = _read_learned(key, name, block)
    if (of or name) in ("mode_log_prob", "mode_prob"):
        squashed = True if squashed is None else checks.flag(f"{key}.squashed", squashed)
    elif squashed is not None:
        checks.refuse(
            f"{key}.squashed",
            squashed,
            f"{of or name} takes none; only mode_log_prob and mode_prob do",
        )
    if name == "oracle" and env in CANNOT_TELL:
        checks.refuse(
            key, name, f"env={env} cannot tell its decision points; these can: {CAN_TELL}"
        )
    return CriterionConfig(**(block | {"name": name, "of": of, "squashed": squashed} | learned))


def _read_learned(key: str, name: str, block: Mapping[str, Any]) -> dict[str, Any]:
    """The parameters of a criterion that learns; where it has none of a name, that is refused."""
    defaults = LEARNED.get(name, {})
    for parameter in LEARNED_KEYS:
        if parameter not in defaults and block[parameter] is not None:
            able = ", ".join(other for other, known in LEARNED.items() if parameter in known)
            allowed = f"{name} takes none; only {able} do"
            checks.refuse(f"{key}.{parameter}", block[parameter], allowed)
    readers: dict[str, Callable[..., Any]] = {
        "of": partial(checks.choice, options=OUTCOMES),
        "width": partial(checks.number, low=0.0, above=True),
        "rate": partial(checks.number, low=0.0, high=1.0, above=True),
        "buckets": partial(checks.whole, most=MOST_BUCKETS),
        "noise": partial(checks.choice, options=NOISE),
        "tilings": partial(checks.whole, least=0, most=MOST_TILINGS),
        "hidden": partial(checks.whole, most=MOST_HIDDEN),
        "lr": partial(checks.number, low=0.0, high=1.0, above=True),
    }
    return {
        parameter: readers[parameter](
            f"{key}.{parameter}", default if block[parameter] is None else block[parameter]
        )
        for parameter, default in defaults.items()
    }


def _function_name(
    key: str, value: Any, agent: str, known: Known, refused: Collection[str] = ()
) -> str:
    """What a criterion's file names; module.function, of your own, may also be named directly."""
    checks.text(key, value)
    name = (known or {}).get(value, value)
    every = {criterion for shipped in AGENTS.values() for criterion in shipped.criteria}
    others = every - set(facts(agent).criteria)
    if name in others:
        able = {file for file, block in (known or {}).items() if block not in others} - set(refused)
        checks.refuse(key, value, f"is not for agent={agent}; {checks.one_of(able, '')}")
    if value in refused or (known is not None and value not in known and "." not in value):
        checks.choice(key, value, set(known or ()) - set(refused) - others)
    return name


def read_prioritisation(value: Any, criterion: CriterionConfig) -> PrioritisationConfig:
    name = _rule_name("prioritisation", value, (*WAYS, *PRIORITISATIONS))
    if name in WAYS:
        block = checks.block("prioritisation", value, ("name", *WAYS[name]))
        parameters = {
            key: read(f"prioritisation.{key}", block[key]) for key, read in WAYS[name].items()
        }
        return PrioritisationConfig(name, parameters=parameters)
    own = PRIORITISATIONS.get(name, {})
    if name not in PRIORITISATIONS:  # of one's own, which may be named alone
        value = {"weights": "auto", "new": "current_max", **value}
    block = checks.block("prioritisation", value, ("name", "weights", "new", *own), ("over",))
    weights = criterion.name in PER_ITEM if block["weights"] == "auto" else block["weights"]
    weights = checks.flag("prioritisation.weights", weights, or_else="auto")
    over = checks.choice("prioritisation.over", block["over"] or "buffer", ["buffer", "batch"])
    if over == "batch" and not weights:
        checks.refuse("prioritisation.over", over, "needs prioritisation.weights=true")
    return PrioritisationConfig(
        name=name,
        weights=weights,
        over=over,
        new=checks.choice("prioritisation.new", block["new"], ["current_max", "ever_max"]),
        parameters={key: read(f"prioritisation.{key}", block[key]) for key, read in own.items()},
    )


def read_bootstrap(
    value: Any, drawing: CriterionConfig, env: str, agent: str, known: Known
) -> BootstrapConfig:
    rule = _rule_name("bootstrap", value, BOOTSTRAP_KEYS)
    reads_criterion = "criterion" in _keys_of_rule(rule, "criterion" in value)
    if rule not in BOOTSTRAP_KEYS:  # of one's own, which may be named alone
        threshold = {"threshold": "auto", "batch": "uniform"} if reads_criterion else {}
        value = {"path_entropy": "auto", "window": None, **threshold, **value}
    keys = ("name", *_keys_of_rule(rule, reads_criterion))
    block = checks.block("bootstrap", value, keys, ("correction",))
    block["correction"] = _correction(block["correction"], rule, agent)
    block["criterion"] = _bootstrap_criterion(block.get("criterion"), drawing, env, agent, known)
    if block["window"] is not None:
        block["window"] = checks.whole(
            "bootstrap.window", block["window"], or_else="null for hyper.h"
        )
    if rule != "one_step":
        block["path_entropy"] = _path_entropy(block["path_entropy"], agent)
    if reads_criterion:
        if "threshold" in block:
            checks.choice("bootstrap.batch", block["batch"], ["uniform", "prioritised"])
            block["threshold"] = _threshold(block["threshold"], block["criterion"])
        else:
            block["threshold"] = None
        if block["criterion"].name == "uniform":
            raise ConfigError(
                f"bootstrap={rule} with the criterion uniform: it is the same everywhere; "
                "name one with bootstrap.criterion=..."
            )
    return BootstrapConfig(reads_criterion=reads_criterion, **block)


def _rule_name(key: str, value: Any, shipped: Iterable[str]) -> str:
    """The name of a prioritisation or bootstrap rule: a shipped one, or module.function."""
    name: Any = value.get("name") if isinstance(value, Mapping) else value
    if isinstance(name, str) and isinstance(value, Mapping) and "." in name:
        return name
    return checks.choice(key, name, shipped)


def _keys_of_rule(rule: str, reads_criterion: bool) -> tuple[str, ...]:
    """The keys of a rule, beside its name.

    A function of your own has the keys of `threshold` where its yaml has a criterion, and those of
    `fixed` where it has none.
    """
    return BOOTSTRAP_KEYS.get(rule, BOOTSTRAP_KEYS["threshold" if reads_criterion else "fixed"])


def _path_entropy(value: Any, agent: str) -> str:
    has_entropy = facts(agent).entropy
    allowed = ["auto", "fresh", "stored", "none"] if has_entropy else ["auto", "none"]
    if value in ("fresh", "stored") and not has_entropy:
        reason = f"agent={agent} has no entropy; {checks.one_of(allowed, '')}"
        checks.refuse("bootstrap.path_entropy", value, reason)
    checks.choice("bootstrap.path_entropy", value, allowed)
    return ("fresh" if has_entropy else "none") if value == "auto" else value


def _correction(value: Any, rule: str, agent: str) -> str:
    name = checks.choice("bootstrap.correction", value or "none", CORRECTIONS)
    if name == "none":
        return name
    if rule == "one_step":
        able = ", ".join(other for other in BOOTSTRAP_KEYS if other != rule)
        allowed = f"bootstrap=one_step has nothing to correct; these unroll: {able}"
        checks.refuse("bootstrap.correction", name, allowed)
    if agent != "sac":
        allowed = f"needs the density of actions, so agent=sac; agent={agent} allows none"
        checks.refuse("bootstrap.correction", name, allowed)
    return name


def _bootstrap_criterion(
    value: Any, drawing: CriterionConfig, env: str, agent: str, known: Known
) -> CriterionConfig:
    if value is None:
        return drawing
    block = checks.block("bootstrap.criterion", value, ("name",), CRITERION_KEYS)
    if block["name"] is not None:
        return read_criterion("bootstrap.criterion", block, env, agent, known)
    for key, item in block.items():
        if item is not None:
            checks.refuse(
                f"bootstrap.criterion.{key}", item, "needs a bootstrap.criterion=... of its own"
            )
    return drawing


def _threshold(value: Any, criterion: CriterionConfig) -> str | float:
    if value == "auto":
        return 0.5 if criterion.name in BINARY else "quantile"
    if value == "quantile":
        return "quantile"
    if isinstance(value, str):
        checks.refuse("bootstrap.threshold", value, "must be auto, quantile or a finite number")
    return checks.number("bootstrap.threshold", value, -LARGEST_THRESHOLD, LARGEST_THRESHOLD)
