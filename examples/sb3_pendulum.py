"""One sampler in Stable Baselines3 and in this project: the mean return after 5,000 steps."""

import sys

import numpy as np
from stable_baselines3.common.evaluation import evaluate_policy

import train
from aser.integrations.sb3 import SAC
from aser.study.runs import load

sampler = sys.argv[1] if len(sys.argv) > 1 else "aser"
steps, seeds, folder = 5000, 4, f"results/runs/sb3-pendulum-{sampler}"
small = {"learning_rate": 1e-3, "policy_kwargs": {"net_arch": [24]}}  # network=small, hyper=sb3
theirs = []
for seed in range(seeds):
    model = SAC("MlpPolicy", "Pendulum-v1", sampler=sampler, seed=seed, **small).learn(steps)
    theirs.append(evaluate_policy(model, model.get_env(), n_eval_episodes=10)[0])
numbers = [f"seeds={seeds}", f"steps={steps}", "hyper=sb3", f"run_dir={folder}"]
if train.main(["env=pendulum", f"sampler={sampler}", *numbers]):
    sys.exit(1)  # it has said why
returns = load(folder).returns
ours = returns[returns["step"] == steps]["return"]
print(f"in Stable Baselines3 {np.mean(theirs):.0f}, in this project {ours.mean():.0f}")
