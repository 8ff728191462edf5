"""The suite on made-up files of the published layout."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from asia.assurance.bench.suite import SUITE, select_problems
from asia.errors import UserError
from tests.official_data import WRITERS
from tests.unit.interfaces.cli.conftest import command_line


def test_benchmarks_are_chosen_by_name_in_the_order_of_the_suite() -> None:
    assert select_problems(None) == SUITE
    assert select_problems("silverbox, wiener-hammerstein,ced") == (
        "ced",
        "silverbox",
        "wiener_hammerstein",
    )
    with pytest.raises(UserError, match="did you mean 'silverbox'"):
        select_problems("silverboks")
    with pytest.raises(UserError, match="names no benchmark"):
        select_problems(" ,")


def test_benchmarks_without_data_are_left_out(files: Path) -> None:
    done = command_line("bench", "suite", "--only", "ced,emps", "--runs", files / "runs", "--json")
    assert done.code == 0
    found = json.loads(done.out.splitlines()[-1])["suite"]
    assert all("not on this machine" in found[name]["left_out"] for name in ("ced", "emps"))


def test_options_that_do_not_go_together(files: Path) -> None:
    for name, *words in (("suite", "--quick"), ("paper", "--only", "ced")):
        done = command_line("bench", name, *words, "--runs", files / "runs")
        assert done.code == 2
        assert f"No such option: {words[0]}" in done.err


@pytest.mark.long
def test_the_suite_searches_resumes_and_opens_only_when_asked(files: Path) -> None:
    WRITERS["ced"](files)
    words = ("bench", "suite", "--only", "ced,emps", "--experiments", 1, "--runs", files / "runs")
    done = command_line(*words)
    assert done.code == 0, done.err
    assert "sealed" in done.out
    assert "emps was left out" in done.out
    assert (files / "runs" / "bench-suite" / "boards.png").is_file()
    ledger = next((files / "runs").glob("bench-ced*/ledger.jsonl"))
    before = ledger.read_bytes()
    again = command_line(*words)
    assert ledger.read_bytes() == before
    assert again.out.splitlines()[-8:] == done.out.splitlines()[-8:]
    opened = command_line(*words, "--unseal", "--yes-process", "--json")
    assert opened.code == 0, opened.err
    figures = json.loads(opened.out.splitlines()[-1])["suite"]["ced"]["figures"]
    assert list(figures) == ["low", "high"]
    assert all(math.isfinite(f["value"]) and f["among"] == 23 for f in figures.values())
    told = command_line("unseal", ledger.parent.name, "--yes", "--runs", files / "runs")
    assert told.out.splitlines()[-1].startswith("submit   RMSE [")
    assert any(line.startswith("official low") for line in told.out.splitlines())


def test_every_benchmark_of_the_suite_is_searched_somewhere() -> None:
    folder = Path(__file__).parent
    searched = "".join(path.read_text() for path in folder.glob("test_searches_*.py"))
    files = [name for name in SUITE if name not in ("cascaded_tanks", "nanodrone")]
    assert [name for name in files if f'"{name}"' not in searched] == []
