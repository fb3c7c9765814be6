"""Pictures of a finished run: its curve, maps of its states, and an episode of one seed."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pandas as pd
import torch
from PIL import Image

from aser import checkpoint, envs
from aser.build import build
from aser.command import command
from aser.errors import ConfigError, reason
from aser.files import replacing
from aser.policy import Policy, arguments
from aser.settings.agent import DEFAULT
from aser.settings.config import parse
from aser.settle import settled
from aser.study.plots import axes, maps
from aser.study.plots.runs import run_page
from aser.study.runs import Run
from aser.study.specs import OWN, Spec
from aser.study.tables import agents, marks
from aser.training.evaluation import EVALUATION_SEED, LONGEST

MOST_FRAMES = 300  # of a gif; of a longer episode every second step is shown, or every third, ...
SIDE = 400  # pixels; a smaller picture is enlarged by a whole number, up to about this side
HOLD = 1000  # milliseconds that the last frame stays
SLOWEST = 100  # milliseconds that another frame stays at most, also where render_fps asks for more
MAZE = "aser/Maze-v0"
# SAC's critics hold the entropy that is to come, beside the reward.
SOFT_VALUE = "soft value: min Q, with entropy"
MAPS: dict[str, Any] = {
    MAZE: (agents.maze, partial(maps.value_and_log_prob, value=SOFT_VALUE)),
    "aser/Pendulum-v0": (agents.pendulum, maps.pendulum_log_prob),
}


def pictures(run: Run, policy: Policy, folder: Path) -> Iterator[str]:
    """Write the pictures of a run into a folder: curve, maps where there are any, an episode.

    Yields a line for each when it is there: where it is or, of a map of p and of an episode, why
    there is none. The maps are of the last agents of all seeds, the episode is of the policy.
    Raises ConfigError where the run's folder lacks what a map needs.
    """
    yield _said(axes.save(run_page(run), folder / "learning_curve.png"))
    env = run.config["env"]["id"]
    if env in MAPS and run.config["agent"]["name"] == DEFAULT:
        table, draw = MAPS[env]
        page = _page(run, "What the agents have learned", table(run, names=()), draw)
        yield _said(axes.save(page, folder / "maps.png"))
    if env == MAZE:
        try:
            rows = marks.ranked(run, p_of(run))
        except ConfigError as error:
            yield f"no map of p: {error}"
        else:
            page = _page(run, "The criterion p", rows, maps.criterion)
            yield _said(axes.save(page, folder / "criterion.png"))
    try:
        yield _said(video(run, policy, folder / f"episode_seed{policy.seed}.gif"))
    except ConfigError as error:
        yield f"no episode: {error}"


def _page(run: Run, title: str, rows: pd.DataFrame, draw: Any) -> Any:
    """The maps of one run as a page."""
    seeds = len(run.config["seeds"])
    title = f"{title}: {run.environment}"
    spec = Spec("show", OWN, (), title, "", "", seeds, (0,), False, (), "")
    return draw(spec, rows.assign(panel="", label=run.method, maze=0))


def _said(path: Path) -> str:
    return f"picture in {path}"


def p_of(run: Run) -> np.ndarray:
    """p (L, n) in all n states of a run's maze, by the criterion that its sampler uses.

    The run is built again, and its checkpoint loaded, so any criterion serves, also one of one's
    own. Raises ConfigError where p is not known at states, or where a module has changed since.
    """
    # Where its agents began is of no account, as those of the checkpoint take their place.
    config = replace(parse(run.config), compile=False, device="cpu", init_from=None, log="none")
    now = settled(config).sources
    for name, digest in config.sources.items():
        if name != "init_from" and now.get(name) != digest:
            raise ConfigError(f"{name} has changed since the run; allowed: as it was then")
    training = build(config, command.CONF, command.CONF.parent / "results")
    training.load_state_dict(checkpoint.load(run.folder / checkpoint.NAME)["training"])
    obs = torch.from_numpy(training.setup.envs.states.observation.T)  # type: ignore[attr-defined]
    with torch.no_grad():
        p = marks.criterion(training, obs)
    if p is None:
        name = training.setup.buffer.sampler.diagnosed.key
        if name == "uniform":
            raise ConfigError(f"sampler={run.sampler} uses no criterion")
        raise ConfigError(f"the criterion {name} is known for drawn items, and for no state")
    return p


def video(run: Run, policy: Policy, path: str | Path) -> Path:
    """Write an episode of the policy as a gif; returns its path.

    The episode begins where the first one of each evaluation begins. Raises ConfigError where the
    environment cannot be drawn, or where the file cannot be written.
    """
    path = Path(path)
    if path.suffix != ".gif":
        raise ConfigError(f"video {path}: allowed is a name that ends in .gif")
    shown, pause = frames(run, policy)
    every = -(-len(shown) // MOST_FRAMES)
    times = max(1, SIDE // max(shown[0].shape))
    kept = [
        Image.fromarray(frame.repeat(times, axis=0).repeat(times, axis=1))
        for frame in [*shown[:-1:every], shown[-1]]
    ]
    pauses = [max(20, round(min(pause * every, SLOWEST)))] * (len(kept) - 1) + [HOLD]
    try:
        with replacing(path) as draft:
            more: Any = {"append_images": kept[1:], "duration": pauses, "loop": 0}
            kept[0].save(draft, format="GIF", save_all=True, **more)
    except OSError as error:
        raise ConfigError(f"video {path}: cannot be written ({error.strerror or error})") from None
    return path


def frames(run: Run, policy: Policy) -> tuple[list[np.ndarray], float]:
    """The pictures (height, width, 3) of an episode's states, and the milliseconds between two."""
    id = run.config["env"]["id"]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # gymnasium's hints are meant for authors
            env = envs.make_single(id, **{**arguments(run), "render_mode": "rgb_array"})
            lane: Any = getattr(env.unwrapped, "lane", None)  # of an environment that ships
            most = run.config["eval"].get("max_steps") or getattr(lane, "time_limit", LONGEST)
            obs, _ = env.reset(seed=EVALUATION_SEED + 1000 * policy.seed)
            shown, over = [_picture(env)], False
            while not over and len(shown) <= most:
                action = np.asarray(policy.act(obs), env.action_space.dtype)
                obs, _, terminated, truncated, _ = env.step(action)
                shown.append(_picture(env))
                over = bool(terminated or truncated)
            env.close()
    except ConfigError:
        raise
    except Exception as error:  # a foreign environment may raise anything
        raise ConfigError(
            f"env.id={id} cannot be drawn: {reason(error)}; allowed: an environment with "
            "render_mode=rgb_array and what it needs to draw"
        ) from None
    return shown, 1000 / env.metadata.get("render_fps", 20)


def _picture(env: gymnasium.Env) -> np.ndarray:
    picture = env.render()
    if not isinstance(picture, np.ndarray) or picture.shape[2:] != (3,):
        raise TypeError("it renders no picture (height, width, 3)")
    return picture.astype(np.uint8)
