"""A run as a table."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from asia.errors import UserError
from asia.ledger import Experiment, Run, find_run, open_run

if TYPE_CHECKING:
    import pandas as pd


def load_run(run: Run | Path | str | None = None, *, runs: Path | str = "runs") -> pd.DataFrame:
    """The experiments of a run, one row each, by their number.

    run: a run such as `SystemIdentifier.run_`, a path, a name below `runs`, or None for the newest
    one. Columns: `V`, the value of each
    fold (`V_fold1`, ...), `status`, `family`, `title`, `parent`, `hypothesis`, `seconds` and
    `failure`; what there is none of is missing. `frame.attrs` has `run`, `problem`, `metric`, and
    `best`, the number of the best experiment. Needs pandas. Raises UserError when there is no such
    run, or no pandas.
    """
    try:
        import pandas as pd
    except ImportError:
        raise UserError("a data frame needs pandas: pip install pandas") from None
    if isinstance(run, Run):
        run = run.directory
    opened = open_run(find_run(Path(runs), None if run is None else str(run)))
    view = opened.view
    numbers = pd.Index([e.number for e in view.experiments], name="experiment")
    frame = pd.DataFrame([_row(e) for e in view.experiments], index=numbers)
    frame.attrs.update(
        run=opened.name,
        problem=view.started.problem,
        metric=opened.metric,
        best=view.best.number if view.best else None,
    )
    return frame


def _row(experiment: Experiment) -> dict[str, Any]:
    proposed, score = experiment.proposed, experiment.score
    result, failure = experiment.result, experiment.failure
    folds = score.folds if score else ()
    return {
        "V": score.value if score else float("nan"),
        **{f"V_fold{k}": fold.value for k, fold in enumerate(folds, 1)},
        "status": result.status if result else "running",
        "family": proposed.family,
        "title": proposed.title,
        "parent": proposed.parent,
        "hypothesis": proposed.hypothesis,
        "seconds": result.seconds if result else float("nan"),
        "failure": failure.reason.advice if failure else None,
    }
