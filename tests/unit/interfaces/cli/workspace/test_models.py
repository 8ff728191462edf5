"""asia models: the model library in words."""

from pathlib import Path

import pytest

from asia.agents.library.registry import all_families
from asia.candidate import check_source
from tests.unit.interfaces.cli.conftest import Asia


@pytest.mark.slow
def test_every_family_is_listed_and_has_a_page(asia: Asia) -> None:
    listed = asia("models").out
    for row in all_families():
        assert f"\n{row.name} " in f"\n{listed}"
        page = asia("models", row.name)
        assert page.code == 0, page.err
        assert f"## {row.name}.Config" in page.out
        # Every option has its default and its text.
        options = page.out.split(f"## {row.name}.Config")[1].split("\n## ")[0]
        assert all(len(line) > 10 for line in options.splitlines() if line.startswith("- `"))


def test_a_page_has_methods_ranges_and_an_example(asia: Asia) -> None:
    page = asia("models", "greybox").out
    assert "`sensor: Sensor | None = None`" in page
    assert "## LevenbergMarquardt, to train it" in page
    assert "`noise_model: NoiseKind" in page
    assert "## Ranges that the agents of ASIA search" in page
    check_source(page.split("```python\n")[1].split("```")[0])


def test_an_unknown_family_is_answered_with_the_nearest(asia: Asia) -> None:
    done = asia("models", "gray-box")
    assert done.code == 2
    assert "did you mean 'greybox'?" in done.err


def test_the_example_is_of_the_workspace(
    asia: Asia, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "work"
    options = ("--no-start", "--runs", tmp_path / "runs")
    assert asia("agent", "workspace", "two_tanks_sim", folder, *options).code == 0
    monkeypatch.chdir(folder / "data")
    assert "## Example" in asia("models", "greybox").out
    assert "## Example" not in asia("models", "physics_net").out
