"""Experience-replay prioritisation in off-policy continuous control, many runs at once."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from aser.api import Run, load, train
    from aser.errors import ConfigError
    from aser.policy import Policy

__all__ = ["ConfigError", "Policy", "Run", "load", "train"]

_HOMES = {"ConfigError": "errors", "Policy": "policy", "Run": "api", "load": "api", "train": "api"}


def __getattr__(name: str) -> Any:
    """A public name, loaded when it is first asked for: `import aser` itself stays fast."""
    if name not in _HOMES:
        raise AttributeError(f"module 'aser' has no attribute {name!r}")
    return getattr(import_module(f"aser.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
