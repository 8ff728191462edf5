"""tools.py of a workspace computes what the evaluator computes."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from asia.errors import CandidateError, Reason, UserError
from asia.interfaces.workspace.tools import WorkspaceTools, main, variants
from asia.interfaces.workspace.workspace import scored_locally, write_folder
from asia.judge.sandbox.layers.environment import REPEATABLE
from asia.judge.scoring.outcome import FoldRecord, combine
from asia.ledger.run import Run, open_run
from asia.problem.load import load_problem
from asia.search.run import prepare, search
from tests.unit.search.toy import Scripted, arx, write_problem

GREYBOX = """
from asia.models import greybox
from asia.models.methods import LevenbergMarquardt


def fit(trajectories, context):
    model = greybox.build(greybox.Config(), context)
    return greybox.train(model, trajectories, context, LevenbergMarquardt(iterations=5, starts=1))
"""
SEEDED = arx(2).replace(
    "    context.log(",
    "    weights = weights * (1 + 1e-3 * np.random.default_rng(context.seed).normal())\n"
    "    context.log(",
)


def judged(problem: Path | str, source: str, root: Path, seed: int) -> Run:
    """A run whose baseline is this candidate."""
    loaded = replace(load_problem(problem), baseline=source)
    loaded = replace(loaded, budget=replace(loaded.budget, experiments=1))
    prepared = prepare(loaded, "scripted", seed=seed, runs=root / "runs")
    search(prepared, Scripted(()), lambda event, view: None, lambda view: None)
    write_folder(root / "work", loaded, 1, seed=seed)
    return open_run(prepared.directory)


def windows(directory: Path) -> Path:
    """The toy in windows of 20 samples, two records, each a group."""
    write_problem(directory)
    rows = (directory / "train.csv").read_text().splitlines()
    (directory / "a b.csv").write_text("\n".join([rows[0], *rows[40:]]) + "\n")
    text = (directory / "problem.toml").read_text()
    text = text.replace('train = ["train.csv"]', 'train = ["train.csv", "a b.csv"]')
    text = text.replace(
        "[protocol]\n",
        '[data.groups]\nfirst = ["train"]\nsecond = ["a b"]\n[protocol]\nkind = "windows"\n'
        'horizon = 20\nfolds = { kind = "leave_one_group_out" }\n',
    )
    (directory / "problem.toml").write_text(text)
    return directory


@pytest.mark.slow
def test_the_score_is_the_evaluators(tmp_path: Path) -> None:
    """Bit for bit: of a candidate that draws random numbers."""
    run = judged(windows(tmp_path / "toy"), SEEDED, tmp_path, seed=7)
    found = WorkspaceTools(tmp_path / "work", seed=7).evaluate("candidate.py")
    best = run.view.best
    assert best is not None
    assert best.score is not None

    def score(record: FoldRecord) -> tuple[object, ...]:
        return record.value, record.rmse, record.mae, record.fit_index, record.r2, record.other

    assert [score(record) for record, _ in found] == [score(one) for one in best.score.folds]
    other = WorkspaceTools(tmp_path / "work", seed=8).evaluate("candidate.py")
    assert other[0][0].value != best.score.folds[0].value


@pytest.fixture
def tools(tmp_path: Path) -> WorkspaceTools:
    write_folder(tmp_path / "work", load_problem(windows(tmp_path / "toy")), 3)
    return WorkspaceTools(tmp_path / "work", seed=0)


def test_the_folder_has_the_problem_but_not_its_test(tmp_path: Path, tools: WorkspaceTools) -> None:
    original = load_problem(tmp_path / "toy")
    assert tools.problem.test.source is None
    assert [t.name for t in tools.problem.train] == ["train", "a_b"]
    for one, other in zip(tools.problem.train, original.train, strict=True):
        assert one.y.tobytes() == other.y.tobytes()
        assert one.u.tobytes() == other.u.tobytes()
    assert "test" not in (tmp_path / "work" / "problem.toml").read_text().replace(
        "protocol.test", ""
    )


def test_folds_of_your_own(tools: WorkspaceTools) -> None:
    assert [len(fold.train) for fold in tools.blocks(3)] == [2, 4, 2]
    (fold,) = tools.hold_out(["a_b"])
    assert [t.name for t in fold.train] == ["train"]
    assert {block.name for block in fold.held_out} == {"a_b"}
    with pytest.raises(UserError, match="no record 'a b'; did you mean 'a_b'"):
        tools.hold_out(["a b"])
    with pytest.raises(UserError, match="leave one or more to train on"):
        tools.hold_out(["a_b", "train"])
    ((record, _),) = tools.evaluate("candidate.py", [fold])
    assert np.isfinite(record.value)


@pytest.mark.slow
def test_the_command_scores_one_fold_and_draws_it(
    tools: WorkspaceTools, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, value in REPEATABLE.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(sys, "argv", ["tools.py", "--fold", "2", "--plot"])
    with pytest.raises(SystemExit) as end:
        main(tools)
    assert end.value.code == 0
    said = capsys.readouterr().out
    assert "folds of your own or not all of them" in said
    assert "  fold 2: " in said
    assert "  fold 1: " not in said
    assert "held-out part" not in said
    for name in ("plots/tools.png", "plots/tools-residuals.png"):
        assert f"picture {name}" in said
        assert (tools.folder / name).read_bytes().startswith(b"\x89PNG")
    monkeypatch.setattr(sys, "argv", ["tools.py", "--fold", "3"])
    with pytest.raises(SystemExit) as end:
        main(tools)
    assert end.value.code == 2
    assert "there is no fold 3" in capsys.readouterr().err


@pytest.mark.long
def test_the_analysis_is_printed_and_a_reader_may_end_early(tools: WorkspaceTools) -> None:
    environment = {**os.environ, **REPEATABLE}
    words = [sys.executable, "tools.py", "--why"]
    done = subprocess.run(
        words, cwd=tools.folder, env=environment, capture_output=True, text=True, check=True
    )
    assert "parts of the held-out error" in done.stdout
    assert "missing terms, score test on the training part" in done.stdout
    piped = f"{sys.executable} tools.py | head -n 1"
    done = subprocess.run(
        ["bash", "-c", piped], cwd=tools.folder, env=environment, capture_output=True, text=True,
        check=True,
    )  # fmt: skip
    assert done.stdout.startswith("V = ")
    assert not done.stderr


def test_a_python_without_asia_is_told_which_one_has_it(tools: WorkspaceTools) -> None:
    for script in ("tools.py", "plot.py"):
        done = subprocess.run(
            [sys.executable, "-S", script], cwd=tools.folder, capture_output=True, text=True,
            check=False,
        )  # fmt: skip
        assert done.returncode == 1
        assert done.stderr.startswith(f"{script}: No module named ")
        assert done.stderr.endswith(f"; start it with {sys.executable}\n")


def test_candidates_scored_on_the_folds_of_v_are_counted(tools: WorkspaceTools) -> None:
    assert scored_locally(tools.folder) == 0
    tools.evaluate_source(arx(2))
    tools.evaluate_source(f"# The same again.\n{arx(2)}")
    tools.evaluate_source(arx(1), tools.folds[:1])
    tools.evaluate_source(arx(3), tools.blocks(2))
    assert scored_locally(tools.folder) == 2


def test_a_fold_prints_no_samples(tools: WorkspaceTools) -> None:
    assert repr(tools.folds[0]).startswith("<fold 1: ")
    assert len(repr(tools.folds[0])) < 100


def test_what_the_evaluator_refuses_is_refused(tmp_path: Path, tools: WorkspaceTools) -> None:
    candidate = tmp_path / "work" / "candidate.py"
    candidate.write_text("x = 1\n")
    with pytest.raises(CandidateError, match="contract"):
        tools.evaluate("candidate.py")
    candidate.write_text(arx(2).replace("[:, k0:]", "[:, k0 + 1:]"))
    with pytest.raises(CandidateError) as caught:
        tools.evaluate("candidate.py")
    assert caught.value.reason is Reason.WRONG_LENGTH


def test_the_early_stopping_score_is_given(tmp_path: Path) -> None:
    write_problem(tmp_path / "toy")
    problem = tmp_path / "toy" / "problem.toml"
    problem.write_text(
        problem.read_text().replace("[protocol]\n", '[protocol]\nearly_stopping = "validation"\n')
    )
    asks = arx(2).replace(
        "    return Model(weights)",
        "    model = Model(weights)\n    model.asked = context.validation_score(model)\n"
        "    return model",
    )
    write_folder(tmp_path / "work", load_problem(tmp_path / "toy"), 3)
    (tmp_path / "work" / "candidate.py").write_text(asks)
    for record, fit in WorkspaceTools(tmp_path / "work", seed=0).evaluate():
        assert fit.model.asked == pytest.approx(record.value, rel=1e-3)  # type: ignore[attr-defined]


def test_variants_are_all_combinations_of_the_values() -> None:
    found = dict(variants(GREYBOX, ["iterations=5,10", "starts=1,None"]))
    assert list(found) == [
        "iterations=5, starts=1",
        "iterations=5, starts=None",
        "iterations=10, starts=1",
        "iterations=10, starts=None",
    ]
    assert found["iterations=5, starts=1"] == GREYBOX
    assert "LevenbergMarquardt(iterations=10, starts=None)" in found["iterations=10, starts=None"]
    (text,) = (source for _, source in variants("f(noise=None, é='ü', order=2)\n", ["noise=slow"]))
    assert text == "f(noise='slow', é='ü', order=2)\n"
    for wrong in ("order=1,2", "iterations", "iterations="):
        with pytest.raises(UserError, match=r"a setting that the candidate writes once, or that"):
            list(variants(GREYBOX, [wrong]))


def test_a_setting_that_is_not_written_is_added_to_the_call_that_takes_it() -> None:
    source = """from asia.models import arx
from asia.models.methods import LevenbergMarquardt

def fit(trajectories, context):
    model = arx.build(arx.Config(), context)
    return arx.train(model, trajectories, context, LevenbergMarquardt(
        iterations=2,
    ))
"""
    (name, text), *_ = variants(source, ["starts=4,8"])
    assert name == "starts=4"
    assert "iterations=2,\n    starts=4)" in text
    (text,) = (t for _, t in variants(source, ["na=3", "iterations=5", "nb=2"]))
    assert "arx.Config(na=3, nb=2)" in text
    assert "iterations=5," in text
    with pytest.raises(UserError, match="'order' is written 0 times, and 0 calls take it: write"):
        list(variants(source, ["order=2"]))
    twice = source + "\nOTHER = arx.Config()\n"
    with pytest.raises(UserError, match="'na' is written 0 times, and 2 calls take it"):
        list(variants(twice, ["na=2"]))


@pytest.mark.long
def test_each_variant_has_its_score(
    tools: WorkspaceTools, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, value in REPEATABLE.items():
        monkeypatch.setenv(name, value)
    library = """
from asia.models import arx
from asia.models.methods import LevenbergMarquardt


def fit(trajectories, context):
    model = arx.build(arx.Config(na=2, nb=2), context)
    return arx.train(model, trajectories, context, LevenbergMarquardt(iterations=2))
"""
    (tools.folder / "candidate.py").write_text(library)
    monkeypatch.setattr(sys, "argv", ["tools.py", "--vary", "na=1,2"])
    with pytest.raises(SystemExit) as end:
        main(tools)
    said = capsys.readouterr().out.splitlines()
    rows = [line for line in said if line.startswith("V ")]
    assert (end.value.code, len(rows)) == (0, 2)
    value = combine([record for record, _ in tools.evaluate()]).value
    assert rows[1].startswith(f"V {value:.6f} na=2 (folds ")
    assert "; training " in rows[1]
    assert "optimistic" in said[-1]
    (tools.folder / "other.py").write_text(library.replace("na=2", "na=1"))
    monkeypatch.setattr(sys, "argv", ["tools.py", "candidate.py", "other.py"])
    with pytest.raises(SystemExit) as end:
        main(tools)
    files = [line for line in capsys.readouterr().out.splitlines() if line.startswith("V ")]
    assert [line.split(" (")[0] for line in files] == [
        f"V {value:.6f} candidate.py",
        rows[0].split(" (")[0].replace("na=1", "other.py"),
    ]
    monkeypatch.setattr(sys, "argv", ["tools.py", "candidate.py", "other.py", "--why"])
    with pytest.raises(SystemExit) as end:
        main(tools)
    assert end.value.code == 2
    assert "for one candidate" in capsys.readouterr().err
    monkeypatch.setattr(sys, "argv", ["tools.py", "--vary", "none=1"])
    with pytest.raises(SystemExit) as end:
        main(tools)
    assert end.value.code == 2
    assert "'none' is written 0 times" in capsys.readouterr().err
