import subprocess
import sys
from pathlib import Path

import pytest

import asia

from .search.toy import Scripted, arx, write_problem


def test_importing_asia_loads_nothing_heavy() -> None:
    code = "import asia, sys; print([m for m in ('numpy', 'jax', 'pydantic') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_every_public_name_is_there() -> None:
    for name in asia.__all__:
        assert getattr(asia, name).__name__ == name
    with pytest.raises(AttributeError, match="nothing"):
        _ = asia.nothing  # type: ignore[attr-defined]


@pytest.mark.slow
@pytest.mark.usefixtures("real_linear_reference")
def test_a_search_from_python(tmp_path: Path) -> None:
    problem = write_problem(tmp_path / "toy")
    run = asia.run(problem, agent=Scripted((arx(2),)), experiments=2, runs=tmp_path / "runs")
    assert run.state == "finished"
    assert run.view.best is not None
    assert run.view.best.number == 2
    assert asia.unseal(run.directory, process_consent=True).first_time
