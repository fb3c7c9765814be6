"""The one error that users see."""


class ConfigError(ValueError):
    """A wrong input. Its message is one line: the key, the value and what is allowed."""
