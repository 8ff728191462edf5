"""The same finished searches in optuna-dashboard and trackio, to compare them with asia view.

python benchmarks/machinery/rivals.py RUNS OUT

Writes OUT/optuna.db, two studies a run: V, with the values of the folds as intermediate values, and
the trade-off of V against the count of numbers in the model. Writes OUT/trackio, two projects a
run: the search as `asia run --sink trackio` sends it, and a run for each experiment with its
settings and picture. Prints the commands that open the three.
"""

from __future__ import annotations

import argparse
import os
import shutil
import tempfile
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt

from asia.ledger.evidence import folds_of
from asia.ledger.run import Run, open_run
from asia.ledger.view import Experiment
from asia.presentation.experiments import decision_text
from asia.problem.folds import make_folds
from asia.problem.load import load_lock
from asia.recipe import read_recipe
from asia.report.pictures.simulation import draw_simulation
from asia.search.sinks import TrackioSink


def main() -> None:
    """Write both stores from all runs of a folder."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", type=Path)
    parser.add_argument("out", type=Path)
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    # trackio reads its folder on import.
    os.environ["TRACKIO_DIR"] = str(given.out / "trackio")
    for ledger in sorted(given.runs.glob("*/ledger.jsonl")):
        run = open_run(ledger.parent)
        with tempfile.TemporaryDirectory() as folder:
            rows = list(experiments(run, Path(folder)))
            send_to_optuna(run, rows, given.out)
            send_to_trackio(run, rows)
        print(f"{run.name}: {len(rows)} experiments", flush=True)
    out = given.out
    print(f"asia view {given.runs}")
    print(f"optuna-dashboard sqlite:///{out}/optuna.db --artifact-dir {out}/artifacts")
    print(f"TRACKIO_DIR={out}/trackio trackio show")


Row = tuple[Experiment, dict[str, Any], dict[str, Any], Path]
"""Experiment, settings, facts about it, picture of the simulation."""


def experiments(run: Run, folder: Path) -> Iterator[Row]:
    """The experiments of a run that have a V, drawn into `folder`."""
    problem = load_lock(run.directory / "problem.lock.toml")
    folds = make_folds(problem.train, problem.protocol)
    for e in run.view.finished:
        if e.score is None or e.result is None:
            continue
        recipe = read_recipe(run.store.text(e.proposed.source))
        pairs = (*recipe.config, *recipe.options, *recipe.maps) if recipe else ()
        settings = {
            "family": e.proposed.family,
            **{key: v if isinstance(v, int | float | str) else str(v) for key, v in pairs},
        }
        numbers = [one.numbers for one in folds_of(run.store, e) if one.numbers]
        facts = {
            "number": e.number, "title": e.proposed.title, "hypothesis": e.proposed.hypothesis,
            "status": e.result.status, "reason": decision_text(e, run.view),
            "seconds": e.result.seconds, "size": max(numbers, default=0),
            **{f"V_fold_{k}": fold.value for k, fold in enumerate(e.score.folds, 1)},
        }  # fmt: skip
        picture = folder / f"simulation-{e.number}.png"
        figure = draw_simulation(run, problem, e, folds)
        figure.savefig(picture, dpi=120)
        plt.close(figure)
        yield e, settings, facts, picture


def send_to_optuna(run: Run, rows: list[Row], out: Path) -> None:
    """Write the studies of a run."""
    import optuna
    from optuna.artifacts import FileSystemArtifactStore, upload_artifact
    from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    storage = f"sqlite:///{out}/optuna.db"
    (out / "artifacts").mkdir(exist_ok=True)
    store = FileSystemArtifactStore(str(out / "artifacts"))
    seen: dict[str, set[Any]] = {}
    for _, settings, *_ in rows:
        for key, value in settings.items():
            seen.setdefault(key, set()).add(value)

    def distribution(key: str) -> BaseDistribution:
        values = seen[key]
        if all(isinstance(v, int | float) and not isinstance(v, bool) for v in values):
            low, high = float(min(values)), float(max(values))
            return FloatDistribution(low, high, log=low > 0 and high > 50 * low)
        return CategoricalDistribution(sorted(values, key=str))

    one = optuna.create_study(study_name=run.name, storage=storage)
    two = optuna.create_study(
        study_name=f"{run.name} trade-off", storage=storage, directions=["minimize", "minimize"]
    )
    one.set_metric_names(["V"])
    two.set_metric_names(["V", "size"])
    for e, settings, facts, picture in rows:
        assert e.score is not None
        columns = {key: distribution(key) for key in settings}
        for study in (one, two):
            study.enqueue_trial(settings, user_attrs=facts)
            trial = study.ask(columns)
            if study is two:
                study.tell(trial, [e.score.value, facts["size"]])
                continue
            import_module("optuna_dashboard").save_note(
                trial, f"{facts['hypothesis']}\n\n{facts['status']}: {facts['reason']}"
            )
            # A finished trial takes no artifact.
            upload_artifact(artifact_store=store, file_path=str(picture), study_or_trial=trial)
            for k, fold in enumerate(e.score.folds, 1):
                trial.report(fold.value, k)
            study.tell(trial, e.score.value)


def send_to_trackio(run: Run, rows: list[Row]) -> None:
    """Write the projects of a run. The sink keeps a file in a run, so it sends a copy."""
    trackio = import_module("trackio")

    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / run.name
        shutil.copytree(run.directory, copy)
        TrackioSink(copy, run.view).close()
    for e, settings, facts, picture in rows:
        assert e.score is not None
        config = {**settings, **{k: v for k, v in facts.items() if not k.startswith("V_")}}
        sent = trackio.init(
            f"{run.view.started.problem}-experiments",
            name=f"{e.number:02d} {e.proposed.title}",
            group=e.proposed.family,
            config=config,
            embed=False,
        )
        for k, fold in enumerate(e.score.folds, 1):
            sent.log({"V_fold": fold.value}, step=k)
        sent.log({
            "V": e.score.value, "size": facts["size"], "seconds": facts["seconds"],
            "simulation": trackio.Image(str(picture), caption=facts["title"]),
        }, step=len(e.score.folds) + 1)  # fmt: skip
        sent.finish()


if __name__ == "__main__":
    main()
