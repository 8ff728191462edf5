from pathlib import Path

import pytest

from asia.ledger.chain import Chain, read_lines
from asia.ledger.events import Event
from asia.ledger.view import replay
from asia.testing import check_ledger


class Trusting:
    """A ledger that reads only the records that verify, and says nothing of the others."""

    def __init__(self, path: Path) -> None:
        self._chain = Chain(path)
        self.lines, self.append = self._chain.lines, self._chain.append

    @property
    def view(self):
        return replay(line.event for line in self.lines)

    def __enter__(self):
        return self

    def __exit__(self, *error: object) -> None:
        self._chain.__exit__(None, None, None)


class Unlocked(Trusting):
    """A ledger that two may write."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._chain.__exit__(None, None, None)
        self.append = self._reopened

    def _reopened(self, event: Event) -> None:
        with Chain(self._chain._path) as chain:
            chain.append(event)
        self.lines[:] = list(read_lines(self._chain._path))

    def __exit__(self, *error: object) -> None: ...


def test_the_chain_conforms() -> None:
    check_ledger(Chain)


def test_the_suite_refuses_a_ledger_without_a_lock() -> None:
    with pytest.raises(AssertionError, match="two writers at once"):
        check_ledger(Unlocked)


def test_the_suite_refuses_a_ledger_that_forgets() -> None:
    class Forgetful(Trusting):
        def __init__(self, path: Path) -> None:
            path.unlink(missing_ok=True)
            super().__init__(path)

    with pytest.raises(AssertionError, match="changed in reading"):
        check_ledger(Forgetful)
