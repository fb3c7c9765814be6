"""Pictures of a finished run: its curve, maps of its states, and an episode of one seed."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from PIL import Image

from aser import envs
from aser.envs.wrappers import reason
from aser.errors import ConfigError
from aser.files import replacing
from aser.policy import Policy, arguments
from aser.settings.agent import DEFAULT
from aser.study.plots import axes, maps
from aser.study.plots.runs import run_page
from aser.study.runs import Run
from aser.study.specs import OWN, Spec
from aser.study.tables import agents
from aser.training.evaluation import EVALUATION_SEED, LONGEST

MOST_FRAMES = 300  # of a gif; of a longer episode every second step is shown, or every third, ...
SIDE = 400  # pixels; a smaller picture is enlarged by a whole number, up to about this side
HOLD = 1000  # milliseconds that the last frame stays
MAPS: dict[str, Any] = {
    "aser/Maze-v0": (agents.maze, maps.value_and_log_prob),
    "aser/Pendulum-v0": (agents.pendulum, maps.pendulum_log_prob),
}


def pictures(run: Run, policy: Policy, folder: Path) -> list[Path]:
    """Write the pictures of a run into a folder: curve, maps where there are any, an episode.

    The maps are of the last agents of all seeds, the episode is of the policy. Raises ConfigError
    where a picture cannot be made; those before it are there then.
    """
    made = [axes.save(run_page(run), folder / "learning_curve.png")]
    env = run.config["env"]["id"]
    if env in MAPS and run.config["agent"]["name"] == DEFAULT:
        table, draw = MAPS[env]
        rows = table(run, names=()).assign(panel="", label=run.sampler, maze=0)
        seeds = len(run.config["seeds"])
        title = f"What the agents have learned: {run.environment}"
        spec = Spec("show", OWN, (), title, "", "", seeds, (0,), False, (), "")
        made.append(axes.save(draw(spec, rows), folder / "maps.png"))
    return [*made, video(run, policy, folder / f"episode_seed{policy.seed}.gif")]


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
    pauses = [max(20, round(pause * every))] * (len(kept) - 1) + [HOLD]
    try:
        with replacing(path) as draft:
            more: Any = {"append_images": kept[1:], "duration": pauses, "loop": 0}
            kept[0].save(draft, format="GIF", save_all=True, **more)
    except OSError as error:
        raise ConfigError(f"video {path}: cannot be written ({error.strerror or error})") from None
    return path


def frames(run: Run, policy: Policy) -> tuple[list[np.ndarray], float]:
    """The pictures (height, width, 3) of an episode's states, and the milliseconds between two."""
    id, most = run.config["env"]["id"], run.config["eval"].get("max_steps") or LONGEST
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # gymnasium's hints are meant for authors
            env = envs.make_single(id, render_mode="rgb_array", **arguments(run))
            obs, _ = env.reset(seed=EVALUATION_SEED + 1000 * policy.seed)
            shown, over = [_picture(env)], False
            while not over and len(shown) <= most:
                action = policy.act(obs).astype(env.action_space.dtype)
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
