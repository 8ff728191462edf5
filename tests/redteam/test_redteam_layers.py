"""Each layer of the sandbox matters: what comes back when it is left out."""

import fcntl
from collections.abc import Sequence

import numpy as np
import pytest

from asia.judge.sandbox.availability import why_not
from asia.judge.sandbox.types import Isolation, Layer
from tests.redteam.attacks.table import ATTACKS
from tests.redteam.outside.outer_sandbox import why_no_outer
from tests.redteam.suite import each_layer, without_layers
from tests.redteam.types import Attack

from .conftest import BY_CHANCE, page_tables

REASON = why_no_outer(nested=True) or why_not(Isolation.LANDLOCK)
pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(REASON is not None, reason=str(REASON)),
]
LEVELS = (Isolation.NAMESPACE, Isolation.LANDLOCK)
BOTH = (Layer.LANDLOCK, Layer.SECCOMP)


Settings = Sequence[tuple[Isolation, tuple[Layer, ...]]]


def come_back(
    settings: Settings, attacks: Sequence[Attack]
) -> dict[tuple[str, tuple[str, ...]], set[int]]:
    """Attacks that succeed, by level and layers left out; run in an outer sandbox."""
    result: dict[tuple[str, tuple[str, ...]], set[int]] = {}
    for finding in without_layers(settings, attacks):
        result.setdefault((finding.level, finding.without), set())
        if finding.through:
            result[finding.level, finding.without].add(finding.number)
    return result


def test_exactly_the_attacks_of_the_page_come_back_without_a_layer():
    """Also while another program locks a file that candidates have open."""
    shown = {
        (row["level"], (row["without"],)): {*map(int, row["comes back"].split(", "))}
        for row in page_tables()["level", "without", "comes back"]
    }
    assert all(shown.values())
    with open(np.__file__, "rb") as file:
        fcntl.lockf(file, fcntl.LOCK_SH)
        found = come_back(each_layer(LEVELS), ATTACKS)
    assert found.keys() == shown.keys()
    for setting, numbers in found.items():
        assert numbers <= shown[setting]
        assert shown[setting] - numbers <= BY_CHANCE


def test_namespaces_alone_protect_the_outside():
    outside = [attack for attack in ATTACKS if attack.number in (2, 3, 5, 6, 12, 14, 18, 19)]
    found = come_back([(Isolation.NAMESPACE, BOTH)], outside)
    assert found == {("namespace", ("landlock", "seccomp")): set()}
