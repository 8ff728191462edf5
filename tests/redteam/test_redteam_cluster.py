"""The attacks of candidates through a Dask cluster on this machine."""

from pathlib import Path

import pytest

from asia.judge.evaluation.machines import survey_machines
from asia.judge.sandbox.availability import fitting_levels, why_not
from tests.redteam.attacks.table import ATTACKS
from tests.redteam.suite import RedTeamPlan, run_suite
from tests.redteam.types import CandidateAttack
from tests.unit.judge.executor.cluster import two_workers

LEVELS = [x.isolation for x in fitting_levels() if x.confined and why_not(x.isolation) is None]


@pytest.mark.long
@pytest.mark.skipif(not LEVELS, reason="no level keeps intent in here")
def test_attacks_are_stopped_through_a_cluster(tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    candidates = tuple(a for a in ATTACKS if isinstance(a, CandidateAttack))
    with two_workers(tmp_path) as cluster:
        executor = cluster.connected(2)
        survey_machines(executor)
        plan = RedTeamPlan((LEVELS[0],), candidates, prove=False, executor=executor)
        report = run_suite(plan)
        executor.close()
    assert [f for f in report.findings if f.through] == []
    assert report.stopped == len(candidates) == len(report.findings)
