"""Verdict on a search whose model is no better than the training mean."""

from pathlib import Path

import numpy as np
import pytest

import asia
from asia.interfaces.cli.output import verdict_facts
from tests.unit.search.toy import Scripted, arx, write_problem


@pytest.mark.slow
@pytest.mark.parametrize("driven", [True, False])
def test_a_model_that_says_nothing_is_doubted(tmp_path: Path, driven: bool) -> None:
    problem = write_problem(tmp_path / "toy")
    if not driven:
        rng = np.random.default_rng(0)
        table = np.column_stack([rng.normal(size=240), rng.normal(size=240)])
        np.savetxt(problem / "train.csv", table, delimiter=",", header="u,y", comments="")
    run = asia.run(problem, agent=Scripted((arx(2),)), runs=tmp_path / "runs", experiments=2)
    lines = [text for _, text in verdict_facts(run.view)]
    assert lines[0].startswith("not usable") == (not driven)
    assert any(line.startswith("It is worse than the mean") for line in lines) == (not driven)
    assert ('kind = "windows"' in " ".join(lines)) == (not driven)
