"""Each layer of the sandbox matters: what comes back when it is left out."""

import pytest

from asia.redteam import ATTACKS, CandidateAttack, each_layer, why_no_outer, without_layers
from asia.sandbox import Isolation, Layer, why_not

REASON = why_no_outer(nested=True) or why_not(Isolation.LANDLOCK)
pytestmark = pytest.mark.skipif(REASON is not None, reason=str(REASON))
LEVELS = (Isolation.NAMESPACE, Isolation.LANDLOCK)
BOTH = (Layer.LANDLOCK, Layer.SECCOMP)


@pytest.fixture(scope="module")
def back() -> dict[tuple[str, tuple[str, ...]], set[int]]:
    """Attacks that succeed, by level and layers left out; run in an outer sandbox."""
    settings = (*each_layer(LEVELS), (Isolation.NAMESPACE, BOTH))
    found = without_layers(settings, ATTACKS)
    result: dict[tuple[str, tuple[str, ...]], set[int]] = {}
    for finding in found:
        result.setdefault((finding.level, finding.without), set())
        if finding.through:
            result[finding.level, finding.without].add(finding.number)
    return result


@pytest.mark.parametrize(
    ("level", "without", "numbers"),
    [
        ("namespace", ("landlock",), {4, 15, 36}),
        ("namespace", ("seccomp",), {13, 22}),
        ("namespace", ("rlimits",), {16}),
        ("landlock", ("landlock",), {2, 4, 5, 12, 14, 15, 24, 36}),
        ("landlock", ("seccomp",), {6, 12, 13, 18, 19, 22, 24}),
        ("landlock", ("rlimits",), {16}),
    ],
)
def test_exactly_these_attacks_come_back_without_a_layer(back, level, without, numbers):
    assert back[level, without] == numbers


def test_namespaces_alone_keep_what_lies_outside_them(back):
    assert not back["namespace", ("landlock", "seccomp")] & {2, 5, 6, 12, 14, 18, 19, 24}


def test_every_layer_has_an_attack_that_only_it_stops(back):
    assert all(back.values())
    walled = {a.number for a in ATTACKS if isinstance(a, CandidateAttack) and a.walled}
    assert set.union(*back.values()) <= walled
