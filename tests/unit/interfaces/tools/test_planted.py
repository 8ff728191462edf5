"""The agent of rules: what it does about which evidence; that it finds what is planted."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[4]
WORKSPACE = ROOT / "benchmarks" / "workspace"


@pytest.mark.parametrize(
    ("evidence", "tried", "move"),
    [
        ((0.65, 1.5, 0.95), (), 'sensor="power"'),
        ((0.65, 1.5, 0.95), ('sensor="power"',), None),
        ((0.2, 1.5, 0.9), (), "lag=('u',)"),
        ((0.2, 1.5, 0.9), ("lag=('u',)",), "ridge=1e-8"),
        ((0.2, 0.6, 0.85), (), 'noise_model="slow"'),
        ((0.02, 0.6, 0.03), (), None),
    ],
)
def test_evidence_leads_to_one_move(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    evidence: tuple[float, float, float],
    tried: tuple[str, ...],
    move: str | None,
) -> None:
    from asia.interfaces.workspace.tools import WorkspaceTools
    from asia.interfaces.workspace.workspace import write_folder
    from asia.problem.load import load_problem
    from tests.unit.search.toy import write_problem

    monkeypatch.syspath_prepend(str(WORKSPACE))
    import residual_agent as agent  # type: ignore[import-not-found]

    write_folder(tmp_path / "work", load_problem(write_problem(tmp_path / "toy")), 3)
    known = agent.rules(WorkspaceTools(tmp_path / "work", seed=0))
    done = {m for rule in known for m in rule.moves if {*m.config, *m.method} & {*tried}}
    due = agent.next_move(known, agent.Evidence(*evidence), done)
    assert (None if due is None else (*due[1].config, *due[1].method)) == (move and (move,))


@pytest.mark.long
@pytest.mark.parametrize(
    ("planted", "found"),
    [
        ("bend+lag+drift", '(sensor="power", lag=(\'pump\',)), noise_model="slow"'),
        ("none", "(), white noise"),
    ],
)
def test_what_is_planted_is_found(tmp_path: Path, planted: str, found: str) -> None:
    script = [sys.executable, WORKSPACE / "run_planted.py", tmp_path, planted]
    done = subprocess.run(script, capture_output=True, text=True, check=True)
    assert done.stdout == f"{planted}: result: greybox.Config{found}\n"
    assert (tmp_path / f"{planted}.txt").read_text().count("$ asia try") <= 6
