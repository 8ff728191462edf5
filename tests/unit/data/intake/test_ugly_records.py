"""Ten records of the benchmark of ugly records through `asia init` and `asia check`."""

import runpy
from pathlib import Path
from typing import Any

import pytest

SCRIPT = Path(__file__).parents[4] / "benchmarks" / "ugly_records.py"
REFUSED = (15, 19, 46, 55)
READ = (12, 2, 24, 27, 49, 57)


@pytest.mark.slow
@pytest.mark.parametrize(
    "number",
    [
        *REFUSED[:2],
        READ[0],
        *(pytest.param(one, marks=pytest.mark.long) for one in (*REFUSED[2:], *READ[1:])),
    ],
)
def test_an_ugly_record_is_read_or_refused_in_a_sentence(tmp_path: Path, number: int) -> None:
    script: dict[str, Any] = runpy.run_path(str(SCRIPT))
    one = script["CASES"][number - 1]
    for command in ("init", "check") if number in READ else ("init",):
        outcome = script["run_command"](one, command, tmp_path / "home", seed=0, full=False)
        assert not outcome.failure, outcome.output
        assert outcome.code == (2 if number in REFUSED else 0), outcome.output
