"""Published results of benchmarks, and the rank of a model among them."""

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cache

from asia._files import PACKAGE
from asia.judge.scoring.outcome import Failure
from asia.ledger.events import TestedModel, Unsealed
from asia.ledger.run import model_to_use, tested_model
from asia.ledger.view import SearchView
from asia.problem.problem import Problem


@dataclass(frozen=True)
class Entry:
    """A published result."""

    year: int
    """The year of publication."""
    method: str
    """The method or model."""
    authors: str
    """Authors of the result."""
    figures: tuple[float | None, ...]
    """Test RMSE for each figure of the benchmark, in its official unit; None where none is
    published."""
    source: str
    """Source of the published figure."""
    training_time: str = ""
    """The class of training time; "" where it is not known."""

    @property
    def test_rmse(self) -> float:
        """The only figure, of a benchmark that has one."""
        (value,) = self.figures
        assert value is not None
        return value

    @property
    def words(self) -> str:
        """Method, authors and year."""
        return f"{self.method} ({self.authors}, {self.year})"


@cache
def leaderboard(problem_name: str) -> tuple[Entry, ...]:
    """Published results of a built-in problem in the order of the list; empty when it has none."""
    file = PACKAGE / "problems" / "leaderboards.csv"
    lines = [x for x in file.read_text("utf-8").splitlines() if x and not x.startswith("#")]
    reader = csv.DictReader(lines, strict=True)
    return tuple(
        Entry(
            int(row["year"]),
            row["method"],
            row["authors"],
            tuple(None if v == "-" else float(v) for v in row["test_rmse"].split()),
            row["source"],
            row["training_time"],
        )
        for row in reader
        if row["benchmark"] == problem_name
    )


# The place of a model among the published results of its benchmark.


_FORM = "https://forms.gle/JF9zR9M9Td9GJgDx8"
# The form's classes of training time, each up to so many seconds.
_TIMES = (
    (1.0, "<1 sec"),
    (60.0, "1-60 sec"),
    (3_600.0, "1-60 min"),
    (86_400.0, "1-24 hours"),
    (4 * 86_400.0, "1-4 days"),
)
_LONGEST = "> 4 days"


@dataclass(frozen=True)
class OfficialFigure:
    """One official test score of a model."""

    name: str
    """The test record, or the group of records it is the mean over."""
    value: float
    """RMSE, the mean over outputs, in the official unit."""


@dataclass(frozen=True)
class Standing:
    """The place of one figure among the published ones."""

    figure: OfficialFigure
    """The figure."""
    rank: int
    """1 where no published result is lower."""
    among: int
    """Number of ranked results, this one included; 1 if none is published."""
    above: Entry | None
    """The published result just above; None at rank 1."""
    above_value: float | None = None
    """Its value."""

    @property
    def words(self) -> str:
        """`2nd of 17, below 0.334 of NL-LFR (Floren et al., 2025)`; "" where none is published."""
        if self.among == 1:
            return ""
        place = f"{ordinal(self.rank)} of {self.among}"
        if self.above is None:
            return f"{place}, nothing published is lower"
        return f"{place}, just above it {self.above_value:g} of {self.above.words}"


@dataclass(frozen=True)
class Board:
    """A benchmark's published results and what a run's model has among them."""

    problem: str
    """Name of the problem."""
    unit: str
    """The official unit."""
    entries: tuple[Entry, ...]
    """The published results; () where there are none."""
    names: tuple[str, ...]
    """The official figures; where the test is sealed, of those that have a published value."""
    standings: tuple[Standing, ...]
    """Rank of each figure; () while the test is sealed or the model has no score."""
    unit_is_outputs: bool = True
    """True if the problem names no official unit."""
    submission: str = ""
    """Text for the submission form of the benchmarks' site; "" without figures or published
    results.
    """


def read_board(problem: Problem, view: SearchView | None) -> Board:
    """The board of a problem with the model to use of a search, once its test was opened. view:
    None for no search."""
    # A user's own data may have a benchmark's name; their error does not belong on that list.
    entries = leaderboard(problem.name) if problem.data.public else ()
    unit = problem.protocol.test.unit or problem.outputs[0].unit
    figures: tuple[OfficialFigure, ...] = ()
    if view is not None and view.unsealed is not None:
        named = model_to_use(view)
        model = tested_model(view.unsealed, named.model if named else "ensemble")
        if not isinstance(model, Failure):
            figures = official_figures(problem, view.unsealed, model)
    names = tuple(figure.name for figure in figures or problem.protocol.test.figures)
    count = max((len(entry.figures) for entry in entries), default=0)
    if not names and count == 1:
        names = ("test",)
    elif not names:
        names = tuple(f"figure {k + 1}" for k in range(count))
    line = ""
    if entries and figures and view is not None and view.best is not None:
        result = view.best.result
        seconds = sum(fold.fit_seconds for fold in result.folds) if result else 0.0
        line = submission_line(figures, unit, seconds)
    own_unit = problem.protocol.test.unit is None
    places = standings(entries, figures)
    return Board(problem.name, unit, entries, names, places, own_unit, line)


def official_figures(
    problem: Problem, record: Unsealed, model: TestedModel
) -> tuple[OfficialFigure, ...]:
    """The official figures of a model: one for each test record, or as `protocol.test.figures`
    has it; () where the test has no RMSE, or a figure no record."""
    rule = problem.protocol.test
    scores = [s for s in model.scores if s.metric == "rmse"]
    if not scores or record.horizon is not None:
        return ()
    factor = rule.unit_factor or 1.0
    values = {
        name: factor * value
        for name, value in zip(record.trajectories, scores[0].per_trajectory, strict=True)
    }
    if not rule.figures:
        return tuple(OfficialFigure(name, value) for name, value in values.items())
    found: list[OfficialFigure] = []
    for figure in rule.figures:
        own = [v for n, v in values.items() if any(fnmatchcase(n, p) for p in figure.records)]
        if not own:
            # The following figures would be in the wrong place on the board.
            return ()
        found.append(OfficialFigure(figure.name, sum(own) / len(own)))
    return tuple(found)


def standings(entries: Sequence[Entry], figures: Sequence[OfficialFigure]) -> tuple[Standing, ...]:
    """The place of each figure. entries: the board, with a value for each figure or none at all."""
    found: list[Standing] = []
    for index, figure in enumerate(figures):
        given = [(e.figures[index], e) for e in entries if index < len(e.figures)]
        there = [(v, e) for v, e in given if v is not None]
        lower = sorted(((v, e) for v, e in there if v < figure.value), key=lambda pair: pair[0])
        value, above = lower[-1] if lower else (None, None)
        found.append(Standing(figure, len(lower) + 1, len(there) + 1, above, value))
    return tuple(found)


def submission_line(figures: Sequence[OfficialFigure], unit: str, seconds: float) -> str:
    """Write the text for the submission form of nonlinearbenchmark.org.

    Args:
        figures: official scores of the model.
        unit: unit of the scores.
        seconds: training time of the model, s.
    """
    values = "; ".join(f"{figure.value:.3g}" for figure in figures)
    time = next((text for most, text in _TIMES if seconds <= most), _LONGEST)
    return (
        f"RMSE [{values}] {unit}, training time {time}; your method, authors, and how white (1) or "
        f"black (10) the model is: {_FORM}"
    )


def ordinal(number: int) -> str:
    """`1st`, `2nd`, `11th`."""
    ending = {1: "st", 2: "nd", 3: "rd"}.get(number % 10, "th")
    return f"{number}{'th' if number % 100 in (11, 12, 13) else ending}"
