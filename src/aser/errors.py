"""The error that users see."""


class ConfigError(ValueError):
    """A wrong input. The message is one line with the key, the value and what is allowed."""
