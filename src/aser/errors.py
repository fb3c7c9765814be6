"""The error that users see."""

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
