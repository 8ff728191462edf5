"""Text of a confirmation (repeated fits)."""

from __future__ import annotations

from collections.abc import Iterator

from asia.ledger import Confirmed, ConfirmedCandidate, ConfirmedPair, error_value
from asia.scoring import Interval


def confirmation_lines(found: Confirmed, v_name: str = "V") -> Iterator[str]:
    """Yield a line per candidate and per pair, the noise floor, the expected error, the verdict."""
    for candidate in found.candidates:
        yield _candidate_line(candidate, v_name)
    for number in found.failed:
        yield f"#{number:02d} failed with every seed: not ranked"
    for pair in found.pairs:
        yield pair_words(pair)
    if found.pairs:
        yield (
            f"simultaneous level {found.level:.0%}".replace("%", " %")
            + f", corrected for the {found.tried} candidates of the search"
        )
    yield f"noise floor: {noise_words(found)}"
    yield from expected_lines(found, v_name)
    yield verdict(found)
    if found.after_unsealing:
        yield "computed after the sealed test was opened; it was not used"


def lines_about(found: Confirmed, experiment: int, v_name: str) -> Iterator[str]:
    """Yield the lines about one experiment; none if it was not repeated."""
    for candidate in found.candidates:
        if candidate.experiment == experiment:
            yield _candidate_line(candidate, v_name)
    for pair in found.pairs:
        if experiment in (pair.first, pair.second):
            yield pair_words(pair)
    if experiment == found.winner:
        yield from expected_lines(found, v_name)


def verdict(found: Confirmed) -> str:
    """Return the verdict on the winner in one sentence."""
    winner = f"#{found.winner:02d}"
    if not found.candidates or found.winner in found.failed:
        return f"{winner} is not confirmed: it failed with every other seed"
    if all(one.experiment != found.winner for one in found.candidates):
        return f"{winner} is not confirmed: it was not repeated"
    alike = _not_apart(found)
    if not alike and found.candidates[0].experiment == found.winner:
        if len(found.candidates) == 1:
            return f"{winner} was the only candidate repeated: there is no comparison"
        return f"{winner} is confirmed: it is better than all other repeated candidates"
    better = [p.first for p in found.pairs if p.second == found.winner and p.apart]
    if better:
        names = " and ".join(f"#{number:02d}" for number in better)
        return f"{winner} is not confirmed: {names} {'is' if len(better) == 1 else 'are'} better"
    names = " and ".join(f"#{number:02d}" for number in alike)
    return f"{winner} and {names} are statistically equal: prefer the simplest of them"


def pair_words(pair: ConfirmedPair) -> str:
    """`#12 and #09 are statistically equal: they differ by 0.0012 (-0.0031 to 0.0055)`."""
    names = f"#{pair.first:02d}", f"#{pair.second:02d}"
    gap = pair.difference
    figures = f"{gap.value:.4g} ({gap.low:.3g} to {gap.high:.3g})"
    if pair.apart:
        return f"{names[0]} is better than {names[1]} by {figures}"
    return f"{names[0]} and {names[1]} are statistically equal: they differ by {figures}"


def noise_words(found: Confirmed) -> str:
    """Return the noise floor."""
    if found.noise is None:
        return "not known: needs two seeds with a score"
    if found.noise == 0.0:
        return "0, the fits do not depend on the seed"
    return f"{found.noise:.2g}, standard deviation of V from seed to seed"


def expected_lines(found: Confirmed, v_name: str) -> Iterator[str]:
    """Yield the expected error of the winner, and its assumptions."""
    expected = found.expected
    if expected is None:
        return
    level = f"{found.expected_level:.0%}".replace("%", " %")
    yield (
        f"expected of #{found.winner:02d} on a new record, as {v_name}: "
        f"{error_value(expected.value)}, {level} between {error_value(expected.low)} and "
        f"{error_value(expected.high)}"
    )
    if found.ensemble is not None:
        yield (
            f"    of the ensemble: {error_value(found.ensemble.value)}, between "
            f"{error_value(found.ensemble.low)} and {error_value(found.ensemble.high)}"
        )
    yield (
        f"    of that {expected.optimism:.2g} for being the best of {found.tried}; it assumes a "
        "record of the same kind, as long as a fold, and is of a fold model as the search fitted it"
    )


def _candidate_line(candidate: ConfirmedCandidate, v_name: str) -> str:
    """`1 to 2  #12  V=0.1034 (0.0981 to 0.1087)  in the search 0.1002  5 seeds ...`."""
    low, high = candidate.best_rank, candidate.worst_rank
    rank = f"rank {low}" if low == high else f"rank {low} to {high}"
    seeds = f"{candidate.repeats} seeds"
    if candidate.deterministic:
        seeds = "does not depend on the seed: one repeat gave the same V"
    elif candidate.spread is not None:
        seeds += f", s.d. {candidate.spread:.2g}"
    if candidate.failed:
        seeds += f", {candidate.failed} failed"
    return (
        f"{rank:<12} #{candidate.experiment:02d}  {v_name}={_interval(candidate.value)}  in the "
        f"search {error_value(candidate.first)}  {seeds}"
    )


def _interval(value: Interval) -> str:
    return f"{error_value(value.value)} ({error_value(value.low)} to {error_value(value.high)})"


def _not_apart(found: Confirmed) -> list[int]:
    """Return the experiments that do not differ significantly from the winner."""
    open_pairs = [(p.first, p.second) for p in found.pairs if not p.apart]
    return [a if b == found.winner else b for a, b in open_pairs if found.winner in (a, b)]
