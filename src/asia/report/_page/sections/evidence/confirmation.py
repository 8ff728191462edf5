"""Section of the confirmation: significance of the winner over repeated fits."""

from __future__ import annotations

from asia.ledger import Confirmed
from asia.report._page.html import Html, join, table, tag
from asia.report._page.section import Section, used_no_test
from asia.report._page.subject import Subject


def _write(subject: Subject) -> Html | None:
    found = subject.view.confirmed
    if found is None:
        return None
    text = tag(
        "p",
        "After the search the candidates with the lowest V were refitted on every fold, with ",
        subject.number(found, "seeds", "count"),
        " seeds chosen by the evaluator; once if their fits do not depend on the seed.",
    )
    after = used_no_test(found.after_unsealing)
    return join((text, _candidates(subject, found), _pairs(subject, found),
                 _expected(subject, found), after))  # fmt: skip


def _candidates(subject: Subject, found: Confirmed) -> Html | None:
    if not found.candidates:
        return tag("p", "None of them has a score with another seed.")
    rows: list[list[str | None]] = []
    for k, one in enumerate(found.candidates):
        at = f"candidates.{k}"
        ranks = [subject.number(found, f"{at}.best_rank", "count")]
        if one.worst_rank != one.best_rank:
            ranks += [Html(" to "), subject.number(found, f"{at}.worst_rank", "count")]
        spread = None if one.spread is None else subject.number(found, f"{at}.spread", "sig2")
        rows.append([
            subject.number(found, f"{at}.experiment", "number"),
            join(ranks),
            _interval(subject, found, f"{at}.value", "error"),
            subject.number(found, f"{at}.first", "error"),
            "fits do not depend on the seed" if one.deterministic else spread,
            subject.number(found, f"{at}.failed", "count"),
        ])  # fmt: skip
    name = subject.view.v_name
    head = ["experiment", "rank", f"{name} over the seeds", f"{name} in the search",
            "standard deviation over the seeds", "failed seeds"]  # fmt: skip
    return table(head, rows, "Refitted candidates")


def _pairs(subject: Subject, found: Confirmed) -> Html | None:
    if not found.pairs:
        return None
    rows: list[list[str | None]] = []
    for k, pair in enumerate(found.pairs):
        at = f"pairs.{k}"
        names = [subject.number(found, f"{at}.{side}", "number") for side in ("first", "second")]
        text = "is better" if pair.apart else "statistically equal"
        gap = _interval(subject, found, f"{at}.difference", "signed_error")
        rows.append([join(names, " and "), gap, text])
    note = tag(
        "p",
        "The intervals hold simultaneously at ",
        subject.number(found, "level", "share"),
        ", corrected for the selection among ",
        subject.number(found, "tried", "count"),
        " candidates.",
    )
    return join((table(["pair", "difference of V", "verdict"], rows, "Pairwise differences"), note))


def _expected(subject: Subject, found: Confirmed) -> Html:
    noise = None
    if found.noise is not None:
        noise = join(
            (
                "The noise floor, the standard deviation of V from seed to seed, is ",
                subject.number(found, "noise", "sig2"),
                ". ",
            )
        )
    if found.expected is None:
        return tag("p", noise, "The expected error of the winner is unknown: its repeats failed.")
    ensemble = None
    if found.ensemble is not None:
        ensemble = join(
            ("; their ensemble one of ", _interval(subject, found, "ensemble", "error"))
        )
    return tag(
        "p",
        noise,
        "On a new record of the same kind, as long as a fold, one of its fold models is expected "
        "to have an error of ",
        _interval(subject, found, "expected", "error"),
        ", at a level of ",
        subject.number(found, "expected_level", "share"),
        ensemble,
        "; of this ",
        subject.number(found, "expected.optimism", "sig2"),
        " corrects for the selection of the best.",
    )


def _interval(subject: Subject, found: Confirmed, at: str, form: str) -> Html:
    value, low, high = (
        subject.number(found, f"{at}.{end}", form) for end in ("value", "low", "high")
    )
    return join((value, " (", low, " to ", high, ")"))


SECTION = Section("confirmation", "Significance", _write)
