"""Bad input: the exception that every command turns into one line, and how it is raised."""

from typing import Any


def one_line(text: object) -> str:
    """Return a text as one printable line: line breaks and control characters become escape
    sequences such as \\n.
    """
    return "".join(
        letter
        if letter.isprintable()
        else letter.encode("unicode_escape", "surrogatepass").decode()
        for letter in str(text)
    )


class InputError(ValueError):
    """Bad input. The message is one line that names the file or setting, the problem, and what
    to do.
    """

    def __str__(self) -> str:
        return one_line(super().__str__())  # file names may hold any character

    def _render_traceback_(self) -> list[str]:
        """Let IPython show only the message, without a traceback."""
        return [f"InputError: {self}"]


def need(name: str, value: object, kind: Any) -> None:
    """Raise InputError unless an argument of a public function is of a kind: a type, or "A | B"."""
    if not isinstance(value, kind):
        raise InputError(
            f"{name}: must be {getattr(kind, '__name__', kind)}, not {type(value).__name__}"
        )
