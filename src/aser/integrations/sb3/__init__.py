"""The samplers of this project for Stable Baselines3's SAC. docs/sb3.md says how to use them."""

try:
    import stable_baselines3  # noqa: F401
except ModuleNotFoundError as error:
    if error.name != "stable_baselines3":
        raise
    raise ModuleNotFoundError(
        "aser.integrations.sb3 needs Stable Baselines3: pip install 'stable-baselines3>=2.9,<2.10'",
        name=error.name,
    ) from None

from aser.integrations.sb3.buffer import ReplayBuffer
from aser.integrations.sb3.sac import SAC

__all__ = ["SAC", "ReplayBuffer"]
