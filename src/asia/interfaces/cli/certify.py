"""asia certify: statements on a model with a proof."""

from __future__ import annotations

import json as jsonlib
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from asia._text import say
from asia.errors import UserError
from asia.interfaces.cli.options import (
    DEFAULT_RUNS,
    CandidateLevel,
    Json,
    RunName,
    Runs,
    candidate_level,
    run_directory,
)


def certify(
    run: RunName = None,
    u: Annotated[
        list[str] | None,
        typer.Option(
            "--u", help="Input limits, 0..10 or name=0..10, repeatable; default: the records'."
        ),
    ] = None,
    horizon: Annotated[int, typer.Option(min=1, help="Samples of the tube.")] = 50,
    model: Annotated[
        str | None,
        typer.Option(
            help="refit, ensemble, stack, or the number of an experiment, whose file is "
            "certificate-N.json; default: the model to use."
        ),
    ] = None,
    check: Annotated[
        Path | None, typer.Option(help="Prove the statements of this certificate again.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="File; default: certificate.json in the run.")
    ] = None,
    isolation: CandidateLevel = None,
    runs: Runs = DEFAULT_RUNS,
    json: Json = False,
) -> None:
    """Prove statements on a model: stability and gains of a linear model, bounds of the outputs of
    every model. Without a proof there is no certificate."""
    from asia.analysis.certificate_check import check_certificate

    if check is not None:
        sentences = check_certificate(check)
        for line in [jsonlib.dumps(sentences)] if json else [f"proven    {s}" for s in sentences]:
            say(line)
        return
    from asia.analysis.certificate import certify as find
    from asia.analysis.certificate import text_lines
    from asia.export.pipeline import lowered_run
    from asia.ledger.run import open_run
    from asia.lowering.evaluation import evaluate
    from asia.lowering.linear import joined
    from asia.report.page.sections.evidence import CERTIFICATE_FILE

    opened = open_run(run_directory(runs, run))
    ready = lowered_run(opened, model, candidate_level(isolation))
    subject, window = ready.model, ready.windows[0]
    names = [signal.name for signal in subject.inputs]
    limits = np.array(subject.input_range, np.float64)
    for text in u or ():
        name, equals, span = text.rpartition("=")
        try:
            ends = [float(word) for word in span.split("..")]
            low, high = ends
            rows = [names.index(name)] if equals else range(len(names))
            if not -np.inf < low <= high < np.inf:
                raise ValueError
        except ValueError:
            raise UserError(
                f"--u is '{text}', expected limits such as 0..10 or {names[0]}=0..10"
            ) from None
        limits[list(rows)] = low, high
    first = np.clip(window.u[0], limits[:, 0], limits[:, 1])
    start = joined(evaluate(subject.lowered.initial, [window.past_u, window.past_y, first]))
    spans = ", ".join(
        f"{s.label} from {low:g} to {high:g}"
        for s, (low, high) in zip(subject.inputs, limits.tolist(), strict=True)
    )
    facts: dict[str, Any] = {
        "run": subject.name,
        "model": subject.use,
        "inputs": names,
        "outputs": [signal.name for signal in subject.outputs],
        "assumptions": [
            f"inputs: any sequence with {spans}, held over {subject.sampling_time:g} s",
            "start: the state before the first training window; the box holds it",
            "the statements are about the model, not about the system: model errors and noise "
            "are not part of them",
            "library functions err by less than 8 units in the last place",
        ],
    }
    content = find(subject.lowered, limits, start, horizon, facts)
    lines = [f"run {subject.name}, model {subject.use}", *text_lines(content)]
    # Each experiment has a file of its own, so that their gains are compared.
    own = f"certificate-{int(model)}.json" if model and model.isdecimal() else CERTIFICATE_FILE
    path = opened.directory / own if out is None else out
    path.write_text(jsonlib.dumps(content) + "\n", "utf-8")
    for line in [jsonlib.dumps(content)] if json else [*lines, f"file      {path}"]:
        say(line)
    if not content["statements"]:
        say("no certificate")
        raise typer.Exit(1)
