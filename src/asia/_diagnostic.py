"""The boundary around diagnostics, pictures and evidence: an exception there ends no search."""

from collections.abc import Generator
from contextlib import contextmanager

from asia._text import one_line
from asia.errors import AsiaError

_LONGEST = 300


@contextmanager
def diagnostic(name: str, failed: list[str]) -> Generator[None, None, None]:
    """Run the block; where it raises, append "check <name> failed: ..." to `failed` and go on.

    Errors raised on purpose pass: they speak of the candidate, the sandbox, the user's files or
    the integrity of the evaluator. No score is computed inside this boundary.
    """
    try:
        yield
    except AsiaError:
        raise
    except Exception as error:  # noqa: BLE001 - the boundary itself
        failed.append(f"check {name} failed: {error_sentence(error)}")


def error_sentence(error: BaseException) -> str:
    """Describe an error in one line: its message, with the type of an unexpected error."""
    text = one_line(str(error), _LONGEST)
    if isinstance(error, AsiaError) and text:
        return text
    return f"{type(error).__name__}: {text}" if text else type(error).__name__
