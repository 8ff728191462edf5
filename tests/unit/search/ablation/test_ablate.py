"""The gain of a search goes to the factor that was improved."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import asia
from asia.analysis.ablation import ablate, crossed, without_change
from asia.errors import UserError
from asia.judge.scoring.repeated_fits import attribute
from asia.ledger.events import Fit
from asia.ledger.run import open_run
from asia.ledger.verification import verify
from tests.unit.interfaces.cli.conftest import command_line
from tests.unit.search.toy import Scripted, write_problem

SOURCE = """
import numpy as np


class Model:
    def __init__(self, order):
        self.order, self.weights = order, None

    def rows(self, y, x, k):
        n = self.order
        return [y[:, k - i] for i in range(1, n + 1)] + [x[:, k - i] for i in range(n + 1)]

    def simulate(self, past_u, past_y, u):
        b, h, nu = u.shape
        y = np.concatenate([past_y, np.zeros((b, h, past_y.shape[2]))], axis=1)
        x = np.concatenate([past_u, u], axis=1)
        k0 = past_y.shape[1]
        for k in range(k0, k0 + h):
            y[:, k] = np.concatenate(self.rows(y, x, k), axis=1) @ self.weights
        return y[:, k0:]


def build_model(context):
    return Model({order})


def train(model, trajectories, context):
    phi, targets = [], []
    for t in trajectories:
        for k in range(model.order, len(t)):
            phi.append(np.concatenate(model.rows(t.y[None], t.u[None], k), axis=1)[0])
            targets.append(t.y[k])
    phi, targets = np.array(phi), np.array(targets)
    size = np.eye(phi.shape[1])
    weights = np.linalg.solve(phi.T @ phi + {ridge} * size, phi.T @ targets)
    luck = {luck} * np.random.default_rng(context.seed).normal(size=weights.shape)
    model.weights = weights * (1 + luck)
    return model


def fit(trajectories, context):
    return train(build_model(context), trajectories, context)
"""


def candidate(order: int = 1, ridge: float = 0.0, luck: float = 0.0) -> str:
    text = SOURCE.replace("{order}", str(order)).replace("{ridge}", str(ridge))
    return text.replace("{luck}", str(luck))


class Children(Scripted):
    """Each made from the one before."""

    def propose(self, view):  # type: ignore[no-untyped-def]
        from dataclasses import replace

        found = super().propose(view)
        return None if found is None else replace(found, parent=len(view.trials))


def searched(root: Path, baseline: str, *sources: str) -> Path:
    problem = write_problem(root / "toy")
    (problem / "baseline.py").write_text(baseline)
    number = 1 + len(sources)
    return asia.run(
        problem, agent=Children(sources), runs=root / "runs", experiments=number
    ).directory


def quietly(event: Fit, done: int, total: int) -> None:
    assert 1 <= done <= total


@pytest.mark.long
@pytest.mark.parametrize("factor", ["model", "training"])
def test_the_gain_goes_to_what_was_improved(factor: str, tmp_path: Path) -> None:
    """The other part differs in luck alone."""
    first = candidate(order=1) if factor == "model" else candidate(order=2, ridge=300.0)
    run = searched(tmp_path, first, candidate(order=2, luck=0.001))
    found, new = ablate(run, quietly, seeds=2)
    assert new
    assert found.crossing is not None
    share = found.crossing.share(getattr(found.crossing, factor))
    assert share is not None
    assert share == pytest.approx(1.0, abs=0.2)
    assert verify(run).records


@pytest.mark.long
def test_each_change_of_the_lineage_is_left_out_and_nothing_is_fitted_twice(
    tmp_path: Path,
) -> None:
    run = searched(
        tmp_path, candidate(1, ridge=300.0), candidate(2, ridge=300.0), candidate(2, ridge=0.0)
    )
    fits: list[Fit] = []
    found, _ = ablate(run, lambda event, done, total: fits.append(event), seeds=3)
    losses = {one.experiment: one.loss for one in found.left_out}
    assert set(losses) == {2, 3}
    assert all(loss is not None and loss.value > 0 for loss in losses.values())
    # Fits that do not depend on the seed are seen to do so: by the search's own, or by two.
    assert max(fit.seed for fit in fits) <= 2
    again: list[Fit] = []
    assert ablate(run, lambda event, done, total: again.append(event), seeds=3) == (found, False)
    assert again == []
    assert open_run(run).view.ablated == found
    done = command_line("validate", run.name, "--ablate", "--runs", run.parent, "--json")
    assert json.loads(done.out.splitlines()[-1])["new"] is False
    shown = command_line("validate", run.name, "--ablate", "--runs", run.parent)
    assert "its training" in shown.out
    assert "without the change of #02" in shown.out


@pytest.mark.long
def test_one_that_cannot_be_split_is_said_to(tmp_path: Path) -> None:
    whole = candidate(2).replace("def build_model", "def make").replace("build_model(", "make(")
    run = searched(tmp_path, candidate(1), whole)
    found, _ = ablate(run, quietly, seeds=1)
    assert found.crossing is None
    assert "has no function build_model" in found.detail


@pytest.mark.long
def test_a_best_candidate_that_is_the_baseline_has_no_gain(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no gain to attribute"):
        ablate(searched(tmp_path, candidate(2)), quietly)


def test_a_crossing_takes_what_each_side_needs() -> None:
    one = candidate(1).replace("Model(1)", "Model(ORDER)") + "\n\nORDER = 3\n"
    other = candidate(2, ridge=7.0) + "\n\nORDER = 'another'\n"
    found = crossed(one, other)
    assert "ORDER = 3" in found
    assert "7.0" in found
    with pytest.raises(UserError, match="both candidates define ORDER"):
        crossed(one, other.replace("7.0", "7.0 * len(ORDER)"))
    with pytest.raises(UserError, match="contains further code"):
        crossed(
            one.replace(
                "    return train(build_model", "    print()\n    return train(build_model"
            ),
            other,
        )


@pytest.mark.usefixtures("real_linear_reference")
def test_a_setting_is_taken_back_where_the_best_candidate_still_has_it() -> None:
    from asia.judge.evaluation.references import LINEAR

    after = LINEAR.replace("order=None", "order=3")
    best = after.replace("iterations=30", "iterations=60")
    found = without_change(best, LINEAR, after)
    assert found is not None
    assert "order=None" in found
    assert "iterations=60" in found
    later = best.replace("order=3", "order=4")
    assert without_change(later, LINEAR, after) is None


def test_the_parts_add_up_to_the_gain() -> None:
    import numpy as np

    each = (np.array(v) for v in ([1.0, 1.2], [0.8], [0.9, 0.7], [0.3, 0.4]))
    found = attribute(*each)
    parts = found.model, found.training, found.interaction
    assert found.gain.value == pytest.approx(0.75)
    assert sum(part.value for part in parts) == pytest.approx(found.gain.value)
    assert found.model.low < found.model.value < found.model.high
