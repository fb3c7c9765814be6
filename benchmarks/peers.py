"""What is measured of other libraries. `measure.py` runs each worker in its own process.

    python benchmarks/peers.py WORKER '{"argument": value, ...}'

They are imported late: they come with `pip install -e '.[bench]'`.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
import time
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Discrete
from gymnasium.wrappers import TransformAction

import aser.envs  # noqa: F401  (registers the maze and the corridor)

FIRST_UPDATE, BUFFER = 101, 5000
ACTIONS = 21  # of DQN, as in conf/agent/dqn.yaml


def sb3(warm: int, seconds: float = 6.0) -> dict[str, float]:
    """Steps per second of Stable Baselines3's SAC in the maze."""
    return speed(sac("stable_baselines3", seed=0), warm, seconds)


def sbx(warm: int, seconds: float = 6.0) -> dict[str, float]:
    """Steps per second of SBX's SAC in the maze, after JAX has compiled."""
    return speed(sac("sbx", seed=0), warm, seconds)


def sb3_dqn(warm: int, seconds: float = 6.0) -> dict[str, float]:
    """Steps per second of Stable Baselines3's DQN in the corridor, with an update per step."""
    from stable_baselines3 import DQN

    torch.set_num_threads(1)
    grid = np.linspace(-1.0, 1.0, ACTIONS, dtype=np.float32)
    corridor = gymnasium.make("aser/Corridor-v0")
    model = DQN(
        "MlpPolicy",
        TransformAction(corridor, lambda k: grid[[k]], Discrete(ACTIONS)),
        policy_kwargs={"net_arch": [24]},
        buffer_size=BUFFER,
        batch_size=256,
        train_freq=1,
        learning_starts=FIRST_UPDATE - 1,
        target_update_interval=200,
        seed=0,
    )
    return speed(model, warm, seconds)


def rejax(hidden: Sequence[int], lanes: int, steps: int) -> dict[str, float]:
    """Lane-steps per second of rejax's SAC in Pendulum, after JAX has compiled.

    All seeds are one program: its `train` under `vmap`. `steps` are those with an update. The
    steps before them cost little and are timed with them. XLA's flags do not keep it to one thread,
    so the process is kept to one core.
    """
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    import jax
    from rejax import SAC

    before = FIRST_UPDATE - 1
    sac = SAC.create(
        env="Pendulum-v1",
        hidden_layer_sizes=hidden,
        buffer_size=BUFFER,
        batch_size=256,
        learning_rate=1e-3,
        fill_buffer=before,
        total_timesteps=before + steps,
        eval_freq=before + steps,
        skip_initial_evaluation=True,
    ).replace(eval_callback=lambda *_: ())
    train = jax.jit(jax.vmap(lambda key: sac.train(key)[0].actor_ts.params))
    keys = jax.random.split(jax.random.PRNGKey(0), lanes)
    jax.block_until_ready(train(keys))
    began = time.perf_counter()
    jax.block_until_ready(train(keys))
    return {"per_second": lanes * steps / (time.perf_counter() - began)}


def sb3_bytes() -> dict[str, float]:
    """Bytes of one item in Stable Baselines3's replay buffer."""
    arrays = vars(sac("stable_baselines3", seed=0).replay_buffer).values()
    return {"bytes_per_item": sum(getattr(array, "nbytes", 0) for array in arrays) / BUFFER}


def sb3_process(seed: int, started: float, steps: int = 5000) -> dict[str, float]:
    """Seconds from `started`, the time before this process began, to the end of one SAC run.

    The run has an evaluation every 100 steps.
    """
    from stable_baselines3.common.callbacks import EvalCallback
    from stable_baselines3.common.monitor import Monitor

    evaluation_env = Monitor(gymnasium.make("aser/Maze-v0"))
    evaluation = EvalCallback(evaluation_env, n_eval_episodes=1, eval_freq=100, verbose=0)
    sac("stable_baselines3", seed).learn(steps, callback=evaluation)
    return {"seconds": time.time() - started}


def sac(package: str, seed: int) -> Any:
    """SAC of a package in the maze, with its own defaults but for 24 neurons and the buffer."""
    torch.set_num_threads(1)
    return importlib.import_module(package).SAC(
        "MlpPolicy",
        gymnasium.make("aser/Maze-v0"),
        policy_kwargs={"net_arch": [24]},
        buffer_size=BUFFER,
        seed=seed,
    )


def speed(model: Any, warm: int, seconds: float) -> dict[str, float]:
    """Steps per second over `seconds`, from `warm` steps past the first update on."""
    first_step, began, per_second = FIRST_UPDATE + warm, 0.0, 0.0

    def measure(caller: dict, _: dict) -> bool:
        """Called after every step of the model; False stops it."""
        nonlocal began, per_second
        step, now = caller["self"].num_timesteps, time.perf_counter()
        if step == first_step:
            began = now
        elif step > first_step and now - began > seconds:
            per_second = (step - first_step) / (now - began)
        return per_second == 0.0

    model.learn(10**6, callback=measure)
    return {"per_second": per_second}


if __name__ == "__main__":
    worker, arguments = sys.argv[1:]
    print(json.dumps(globals()[worker](**json.loads(arguments))))
