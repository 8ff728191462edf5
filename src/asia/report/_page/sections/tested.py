"""The sealed test, once it was opened."""

from __future__ import annotations

from asia.ledger import TestedModel, Unsealed, model_to_use
from asia.protocol import find_metric
from asia.report._board import Board, read_board
from asia.report._page.html import Html, join, said, table, tag
from asia.report._page.overlay import Overlay, draw_overlays
from asia.report._page.section import Section
from asia.report._page.subject import Subject

_MODELS = (
    ("ensemble", "ensemble of the fold models"),
    ("refit", "refit on all training records"),
    ("stack", "stack of several experiments"),
)


def _write(subject: Subject) -> Html | None:
    opened = subject.view.unsealed
    if opened is None:
        return None
    how = join((subject.number(opened, "skip", "count"), " samples of each record are left out"))
    if opened.horizon is not None:
        how = join(("windows of ", subject.number(opened, "horizon", "count"), " samples"))
    text = tag("p", "The test records were opened once, after the search had ended: ", how, ".")
    return join(
        (
            text,
            _table(subject, opened),
            _by_record(subject, opened),
            _horizons(subject, opened),
            _board(subject),
            _pictures(subject, opened),
        )
    )


def _models(opened: Unsealed) -> list[tuple[str, str, TestedModel]]:
    found = [(key, text, getattr(opened, key)) for key, text in _MODELS]
    return [(key, text, model) for key, text, model in found if isinstance(model, TestedModel)]


def _table(subject: Subject, opened: Unsealed) -> Html | None:
    """A row for each metric and output, a column for each model."""
    named, models = model_to_use(subject.view), _models(opened)
    failed = [text for key, text in _MODELS if _failed(opened, key)]
    note = tag("p", "No simulation from: ", ", ".join(failed), ".") if failed else None
    if not models:
        return note
    rows: list[list[str | None]] = []
    for k, score in enumerate(models[0][2].scores):
        label = said(find_metric(score.metric).label)
        paths = [("mean over the outputs", "value")] if len(opened.channels) > 1 else []
        paths += [(name, f"per_channel.{c}") for c, name in enumerate(opened.channels)]
        for name, path in paths:
            values = [
                subject.number(opened, f"{key}.scores.{k}.{path}", "sig4") for key, _, _ in models
            ]
            rows.append([join((label, " ", said(name))), *values])
    use = named.model if named else ""
    head = ["error", *(f"{text} (to use)" if key == use else text for key, text, _ in models)]
    return join((table(head, rows, "Error on the sealed test, in the unit of the output"), note))


def _horizons(subject: Subject, opened: Unsealed) -> Html | None:
    """The Mean Euclidean Errors of the model to use."""
    named = model_to_use(subject.view)
    models = [(key, text, model) for key, text, model in _models(opened) if model.mee]
    chosen = next((m for m in models if named and m[0] == named.model), None)
    if chosen is None or chosen[2].mee is None:
        return None
    key, text, mee = chosen[0], chosen[1], chosen[2].mee
    rows: list[list[str | None]] = []
    for i, group in enumerate(mee.groups):
        at = f"{key}.mee.groups.{i}.steps"
        values = [subject.number(opened, f"{at}.{h - 1}", "sig4") for h in mee.horizons]
        total = subject.made("sum", "sig4", (opened, f"{at}.*"))
        rows.append([said(group.name), *values, total])
    head = ["outputs", *(said(f"after {h}") for h in mee.horizons), "sum"]
    return table(head, rows, f"Mean Euclidean error after so many samples, {text}")


def _failed(opened: Unsealed, key: str) -> bool:
    model = getattr(opened, key)
    return model is not None and not isinstance(model, TestedModel)


def _by_record(subject: Subject, opened: Unsealed) -> Html | None:
    models = _models(opened)
    if len(opened.trajectories) < 2 or not models:
        return None
    rows = [
        [
            said(name),
            *(
                subject.number(opened, f"{key}.scores.0.per_trajectory.{i}", "sig4")
                for key, _, _ in models
            ),
        ]
        for i, name in enumerate(opened.trajectories)
    ]
    return table(["record", *(text for _, text, _ in models)], rows, "Error on each test record")


def _board(subject: Subject) -> Html | None:
    if subject.problem is None:
        return None
    board = read_board(subject.problem, subject.view)
    if not board.entries or not board.standings:
        return None
    parts: list[Html] = [_board_of(board, index) for index in range(len(board.standings))]
    return join((tag("h3", "Comparison with published results"), *parts))


def _board_of(board: Board, index: int) -> Html:
    """Published results and ours, the lowest first. They are no events of this ledger, and the
    official figure is the one above in another unit, so both are quoted."""
    ours = board.standings[index]
    entries = [(e.figures[index], e.words) for e in board.entries if index < len(e.figures)]
    rows = [(v, text, False) for v, text in entries if v is not None]
    rows.append((ours.figure.value, "this search, the model to use", True))
    rows.sort(key=lambda row: row[0])
    most = rows[-1][0]
    bars: list[list[str | None]] = []
    for value, text, own in rows:
        share = f"width:{100 * value / most:.1f}%"
        bar = tag("span", class_="bar own" if own else "bar", style=share)
        name = tag("b", text) if own else said(text)
        bars.append([name, said(f"{value:.4g}"), bar])
    caption = f"Test error of {ours.figure.name} [{board.unit}]"
    return table(["result", "error", "size"], bars, caption)


def _pictures(subject: Subject, opened: Unsealed) -> Html | None:
    problem, models = subject.problem, _models(opened)
    if problem is None or not models or opened.horizon is not None:
        return None
    named = model_to_use(subject.view)
    chosen = next((m for m in models if named and m[0] == named.model), models[0])
    shapes = [(length, len(opened.channels)) for length in opened.lengths]
    measured = subject.run.store.get_arrays(opened.measured, shapes)
    simulated = subject.run.store.get_arrays(chosen[2].y_hat, shapes)
    edges = None
    if opened.bands is not None and opened.bands.model == chosen[0]:
        stored = (opened.bands.lower, opened.bands.upper)
        edges = [subject.run.store.get_arrays(one, shapes) for one in stored]
    parts = [
        Overlay(
            title=join((said(name), ", ", chosen[1])),
            alt=f"Test record {name}",
            channel=channel,
            first=problem.protocol.past,
            measured=measured[i],
            simulated=simulated[i],
            skip=opened.skip,
            band=None if edges is None else (edges[0][i], edges[1][i]),
        )
        for i, name in enumerate(opened.trajectories)
        for channel in range(len(problem.outputs))
    ]
    return draw_overlays(problem, parts)


SECTION = Section("test", "The sealed test", _write)
