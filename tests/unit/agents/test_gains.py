"""The table of measured gains and its effect on weights."""

import csv
from dataclasses import replace

import pytest

from asia.agents.expert.moves import all_moves
from asia.agents.library import gains
from asia.agents.library.gains import evidence_of, gain_factor, name_of

from .searches import CLEAN, Proposal, trial

PLAIN = replace(trial(Proposal("", "linear", "", "", ""), 1, 0.11), diagnostics=(CLEAN,))


def test_every_row_of_the_table_is_a_move_of_the_library() -> None:
    text = gains.files("asia.agents.library").joinpath("gains.csv").read_text("utf-8")
    names = {move.name for move in all_moves()}
    rows = list(csv.DictReader(text.splitlines()))
    assert rows
    for row in rows:
        assert row["move"] in names
        assert row["evidence"] in ("overfit", "coloured", "plain")
        assert int(row["trials"]) >= 1
        assert 0.0 <= float(row["gain"]) <= 1.0


def test_gains_are_shrunk_towards_the_weight_on_the_card(monkeypatch: pytest.MonkeyPatch) -> None:
    table = {("a", "plain"): (40, 0.02), ("b", "plain"): (40, 0.1), ("c", "plain"): (6, 0.3)}
    table |= {("d", "plain"): (5, 0.3)}
    monkeypatch.setattr(gains, "_table", lambda: table)
    assert gain_factor("a", PLAIN) < 0.6 + 1e-12
    assert 1.0 < gain_factor("b", PLAIN) < 0.1 / 0.06
    assert 1.0 < gain_factor("c", PLAIN) <= 1.5
    assert gain_factor("d", PLAIN) == 1.0
    assert gain_factor("unknown", PLAIN) == 1.0
    assert gain_factor("b", replace(PLAIN, value=1.0)) == 1.0


def test_evidence_and_names_are_read_as_the_expert_makes_them() -> None:
    assert evidence_of(PLAIN) == "plain"
    assert evidence_of(replace(PLAIN, value=0.5)) == "overfit"
    coloured = replace(PLAIN, diagnostics=(replace(CLEAN, whiteness=0.9),))
    assert evidence_of(coloured) == "coloured"
    names = {move.name for move in all_moves()}
    assert name_of("grey-box: x1 acts late", names) == "{state} acts late"
    title = "neural state-space: one state more (order 3 to 4)"
    assert name_of(title, names) == "one state more"
    assert name_of("neural state-space", names) == ""
