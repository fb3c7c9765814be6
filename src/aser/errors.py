"""The error that users see, and what it tells of others."""

LONGEST = 900  # characters of a message


class ConfigError(ValueError):
    """A wrong input. The message is one line with the key, the value and what is allowed.

    Texts of users and of other programs may be in it. So line ends become blanks, other control
    characters are shown as question marks, and a very long message is cut in its middle.
    """

    def __init__(self, message: str):
        line = " ".join(message.split())
        line = "".join(letter if letter.isprintable() else "?" for letter in line)
        if len(line) > LONGEST:
            line = f"{line[: LONGEST // 2]} ... {line[-LONGEST // 2 :]}"
        super().__init__(line)


def reason(error: BaseException) -> str:
    """The kind of an error and the first line of its message."""
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0]}" if lines else type(error).__name__


def one_line(text: str) -> str:
    """The first line of a message, cut to 150 characters."""
    line = " ".join(text.strip().partition("\n")[0].split())
    return line if len(line) <= 150 else line[:147] + "..."
