"""A run goes on with the layers it began with."""

from dataclasses import replace

import pytest

from asia.errors import UserError
from asia.ledger import SearchView, Started
from asia.search._search import check_same_search

ALL = Started(
    run="toy",
    problem="toy",
    agent="expert",
    seed=0,
    experiments=3,
    hours=None,
    outputs=("y",),
    lock_digest="",
    protocol_digest="",
    test_digest=None,
    isolation="namespace",
    isolation_notes=(),
    environment={},
)
FEWER = replace(ALL, isolation_notes=("namespace without landlock: this kernel has none of it",))


def test_a_run_that_would_go_on_with_fewer_layers_is_refused() -> None:
    with pytest.raises(UserError, match=r"'toy' began .*\(namespace without landlock\): go on"):
        check_same_search(SearchView(ALL, 3, None), FEWER)
    for began in (ALL, FEWER):
        check_same_search(SearchView(began, 3, None), ALL)
    other = replace(FEWER, isolation_notes=("namespace without landlock: another reason",))
    check_same_search(SearchView(FEWER, 3, None), other)
