"""Pictures of runs with made-up outcomes: what is drawn, and that every text can be read."""

from __future__ import annotations

import itertools
import subprocess
import sys
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import imread
from matplotlib.legend import Legend
from matplotlib.text import Annotation, Text
from matplotlib.transforms import Bbox

from asia.data import Signal
from asia.errors import UserError
from asia.judge.scoring.checks.check import Check, CheckCurve, Verdict
from asia.ledger.run import open_run
from asia.problem.load import load_problem
from asia.problem.lock import lock_text
from asia.problem.problem import Seal
from asia.report.drawing.style import drawing, names_that_fit, plain
from asia.report.files import pictures, save, write_report
from asia.report.pictures.check import draw_data
from asia.report.pictures.evidence import draw_validation

from .made_up import BENCHMARK, Outcomes, Shape, make_problem, write_run

FIVE: Outcomes = (
    ("vanilla RNN, 4 units", 0.681),
    ("linear state-space, order 4", 0.34),
    ("LSTM, 128 units", None),
    ("grey-box ODE", 0.217),
    ("grey-box with saturation of the upper tank and spill into the lower one", 0.131),
)
MANY: Outcomes = tuple(
    (f"a rather long title of experiment {i} with details", None if i % 9 == 4 else v)
    for i, v in enumerate(
        [0.9 * 0.93**i if i % 2 == 0 else 0.95 * 0.94**i for i in range(29)] + [4e5]
    )
)
ODD: Outcomes = (("costs $5 & 系统辨识 \n\t <b>x_1^2</b> \\frac", 0.5), ("🙂" * 40, 0.3))
RUNGS = (
    ("training mean", 1.107),
    ("last output held", 1.1),
    ("linear model", 0.345),
    ("simulated truth", 0.046),
)
MIMO = Shape(
    samples=(150, 120, 130),
    inputs=(Signal("u1", "V"), Signal("motor_speed_commanded_left", "rad/s")),
    outputs=(Signal("x", "m"), Signal("angular_velocity_of_the_arm", "rad/s"), Signal("plain")),
    sampling_time=0.01,
)
WIDE = Shape(
    samples=(80,) * 7,
    inputs=tuple(Signal(f"motor_{i}", "rad/s") for i in range(4)),
    outputs=tuple(Signal(f"state_{i}", "m/s^2") for i in range(12)),
)


def visible_texts(figure: Figure) -> list[tuple[str, Bbox]]:
    """Texts of the figure and their places in pixels; tick labels out of view left out."""
    canvas = FigureCanvasAgg(figure)
    figure.draw_without_rendering()
    hidden: set[int] = set()
    for axes in figure.findobj(Axes):
        assert isinstance(axes, Axes)
        for axis, limits in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
            for tick in (*axis.get_major_ticks(), *axis.get_minor_ticks()):
                if not min(limits) - 1e-9 <= tick.get_loc() <= max(limits) + 1e-9:
                    hidden |= {id(tick.label1), id(tick.label2)}
    boxes: list[tuple[str, Bbox]] = []
    for text in figure.findobj(Text):
        assert isinstance(text, Text)
        if text.get_visible() and text.get_text().strip() and id(text) not in hidden:
            box = Text.get_window_extent(text, canvas.get_renderer())
            boxes.append((text.get_text(), box))
    return boxes


def assert_readable(figure: Figure) -> None:
    """Every text lies inside the figure, and no two overlap."""
    texts = visible_texts(figure)
    width, height = figure.bbox.width, figure.bbox.height
    for text, box in texts:
        inside = box.x0 >= -1 and box.y0 >= -1 and box.x1 <= width + 1 and box.y1 <= height + 1
        assert inside, f"cut off: {text!r} at {box.extents} in {width} x {height}"
    for (a, first), (b, second) in itertools.combinations(texts, 2):
        apart = (
            min(first.x1, second.x1) - max(first.x0, second.x0) < 1.5
            or min(first.y1, second.y1) - max(first.y0, second.y0) < 1.5
        )
        assert apart, f"{a!r} overlaps {b!r}"
    for legend in figure.findobj(Legend):
        assert isinstance(legend, Legend)
        box = legend.get_window_extent()
        inside = box.x0 >= -1 and box.y0 >= -1 and box.x1 <= width + 1 and box.y1 <= height + 1
        assert inside, f"legend cut off at {box.extents} in {width} x {height}"
        for axes in figure.axes:
            window = axes.get_window_extent()
            for line in axes.get_lines():
                points = line.get_transform().transform(np.array(line.get_xydata()))
                drawn = [p for p in points if window.contains(p[0], p[1]) or not line.get_clip_on()]
                assert not box.count_contains(drawn), f"a legend covers {line.get_label()!r}"


def draw_all(directory: Path, shape: Shape, outcomes: Outcomes, unsealed: int) -> dict[str, Figure]:
    problem = make_problem(shape)
    run = open_run(write_run(directory, problem, outcomes, RUNGS, unsealed))
    with drawing():
        return {name: draw() for name, draw in pictures(run, problem)}


@pytest.mark.parametrize("outcomes", [(), MANY, ODD])
def test_progress_can_be_read(tmp_path: Path, outcomes: Outcomes) -> None:
    problem = make_problem(Shape())
    run = open_run(write_run(tmp_path / "run", problem, outcomes, RUNGS))
    with drawing():
        name, draw = next(pictures(run, problem))
        assert name == "progress"
        assert_readable(draw())


@pytest.mark.slow
def test_progress_shows_what_the_ledger_tells(tmp_path: Path) -> None:
    figure = draw_all(tmp_path / "run", Shape(), FIVE, 0)["progress"]
    (axes,) = figure.axes
    curves = {line.get_label(): line for line in axes.get_lines()}
    assert list(curves["best so far"].get_xdata()) == [1, 2, 4, 5, 5]
    assert list(curves["best so far"].get_ydata()) == [0.681, 0.34, 0.217, 0.131, 0.131]
    assert list(curves["failed, no score"].get_xdata()) == [3]
    assert list(curves["failed, no score"].get_ydata()) == [1.0]
    tags = {t.get_text().replace("\n", " ") for t in axes.texts if isinstance(t, Annotation)}
    assert {title for title, _ in FIVE[:2]} <= tags
    assert any(tag.startswith("grey-box with saturation of") for tag in tags)
    assert "noise floor (truth) 0.046" in tags
    assert axes.get_yscale() == "log"


def test_progress_shows_the_guard(tmp_path: Path) -> None:
    run = write_run(
        tmp_path / "run", make_problem(Shape()), FIVE, RUNGS, guard=[(4, 0.3), (5, 9e4)]
    )
    with drawing():
        _, draw = next(pictures(open_run(run), make_problem(Shape())))
        figure = draw()
        assert_readable(figure)
    curves = {line.get_label(): line for line in figure.axes[0].get_lines()}
    assert list(curves["guard records"].get_xdata()) == [4]
    assert list(curves["guard records"].get_ydata()) == [0.3]
    assert list(curves["off scale"].get_xdata()) == [5]


def test_a_huge_value_does_not_squeeze_the_others(tmp_path: Path) -> None:
    outcomes = [*FIVE, ("diverges", 3e5)]
    figure = draw_all(tmp_path / "run", Shape(), outcomes, 0)["progress"]
    (axes,) = figure.axes
    curves = {line.get_label(): line for line in axes.get_lines()}
    assert axes.get_ylim()[1] < 10.0
    assert list(curves["off scale"].get_xdata()) == [6]


def test_legends_of_a_validation_report_cover_nothing() -> None:
    """Curves through every corner of the panel, short and long names, one name or many."""
    x = np.linspace(0.1, 1.0, 60)
    names = (
        ("y1", "y2"),
        ("motor speed to level, data, coherence above 0.5", "motor speed to level, simulation"),
        tuple(f"u{k} to the angular velocity of the arm, low" for k in range(7)),
        ("level",),
        tuple(f"y{k} with u{k}" for k in range(4)),
    )
    checks = [
        Check(
            name, Verdict.PASS, "", axes=("frequency [Hz]", "gain"),
            curves=tuple(
                CheckCurve(curve, x, 1.1 + np.sin((40 + k) * x)) for k, curve in enumerate(group)
            ),
        )
        for name, group in zip(
            ("inputs", "frequency response", "poles", "ten horizons", "time"), names, strict=True
        )
    ]  # fmt: skip
    with drawing():
        figure = draw_validation(checks, "pass 5, doubt 0, fail 0")
        assert_readable(figure)
    assert [axes.get_legend() is not None for axes in figure.axes[:5]] == [
        True, True, True, False, True,
    ]  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize(
    ("shape", "trajectories"),
    [
        (BENCHMARK, 1),
        pytest.param(MIMO, 3, marks=pytest.mark.slow),
        pytest.param(WIDE, 2, marks=pytest.mark.slow),
    ],
)
def test_every_picture_can_be_read(tmp_path: Path, shape: Shape, trajectories: int) -> None:
    figures = draw_all(tmp_path / "run", shape, FIVE, trajectories)
    with drawing():
        figures["data"] = draw_data(make_problem(shape))
        for figure in figures.values():
            assert_readable(figure)
            assert len(figure.axes) <= 16


@pytest.mark.slow
def test_simulation_titles_give_the_recorded_errors(tmp_path: Path) -> None:
    problem = make_problem(MIMO)
    run = open_run(write_run(tmp_path / "run", problem, FIVE))
    best = run.view.best
    assert best is not None
    assert best.score is not None
    with drawing():
        figure = dict(pictures(run, problem))["simulation"]()
    titles = " ".join(a.get_title(loc="left") for a in figure.axes)
    for fold in best.score.folds:
        assert f"{fold.rmse[0]:.3g} m, fit {fold.fit_index[0]:.1f} %" in titles


@pytest.mark.slow
def test_the_sealed_test_is_drawn_only_once_opened(tmp_path: Path) -> None:
    before = draw_all(tmp_path / "a", BENCHMARK, FIVE[:1], 0)
    after = draw_all(tmp_path / "b", BENCHMARK, FIVE[:1], 1)
    assert set(before) == {"progress", "simulation", "residuals"}
    assert set(after) == {*before, "test", "leaderboard"}


@pytest.mark.long
def test_files_are_the_same_twice_and_have_their_size(tmp_path: Path) -> None:
    problem = make_problem(Shape())
    run = open_run(write_run(tmp_path / "run", problem, FIVE[:2]))
    one = save(itertools.islice(pictures(run, problem), 2), tmp_path / "one")
    two = save(itertools.islice(pictures(run, problem), 2), tmp_path / "two")
    assert [p.name for p in one] == [
        "progress.png",
        "progress.pdf",
        "simulation.png",
        "simulation.pdf",
    ]
    assert [p.read_bytes() for p in one] == [p.read_bytes() for p in two]
    assert imread(one[0]).shape[:2] == (645, 1080)
    assert one[1].read_bytes().startswith(b"%PDF")


@pytest.mark.long
def test_write_report_reads_a_run_directory(tmp_path: Path) -> None:
    problem = load_problem("two_tanks_sim")
    run = tmp_path / "run"
    run.mkdir()
    (run / "problem.lock.toml").write_text(lock_text(problem, Seal(None)))
    write_run(run, problem, FIVE[:2])
    before = dict(mpl.rcParams)
    written = write_report(run)
    assert {p.relative_to(run).as_posix() for p in written} == {
        f"report/{name}.{suffix}"
        for name in ("progress", "simulation", "residuals")
        for suffix in ("png", "pdf")
    }
    assert all(p.stat().st_size > 5000 for p in written)
    assert dict(mpl.rcParams) == before
    assert write_report(run, missing_only=True) == ()
    (run / "report" / "residuals.pdf").unlink()
    again = write_report(run, missing_only=True)
    assert [p.name for p in again] == ["residuals.png", "residuals.pdf"]


def test_a_changed_artifact_is_refused(tmp_path: Path) -> None:
    problem = make_problem(Shape())
    run = open_run(write_run(tmp_path / "run", problem, FIVE[:1]))
    best = run.view.best
    assert best is not None
    assert best.result is not None
    (tmp_path / "run" / "artifacts" / best.result.folds[0].y_hat).write_bytes(b"12345678")
    with pytest.raises(UserError, match="was changed"):
        dict(pictures(run, problem))["simulation"]()


def test_plain_text_holds_only_what_the_font_can_draw() -> None:
    assert plain("a\n\tb  c") == "a b c"
    assert plain("系 α ≤ x") == "? α ≤ x"
    assert plain("x" * 80, 10) == "x" * 9 + "…"


@pytest.mark.long
def test_importing_the_package_loads_no_matplotlib_and_drawing_no_pyplot(tmp_path: Path) -> None:
    script = (
        "import sys, asia.report\n"
        "assert 'matplotlib' not in sys.modules\n"
        "import asia.report.files\n"
        "assert 'matplotlib.pyplot' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", script], check=True, cwd=tmp_path)


def test_names_of_records_stay_in_their_part_of_the_axis() -> None:
    def names(*lengths: int) -> tuple[str, ...]:
        ends = np.cumsum([0, *lengths]).astype(float)
        times = [ends[k : k + 2] for k in range(len(lengths))]
        return names_that_fit([f"record_{k}" for k in range(len(lengths))], times, 80)

    assert names(50, 50) == ("record_0", "record_1")
    assert names(90, 8, 2) == ("record_0", "recor…", "")
    for count in (3, 12, 40):
        assert sum(map(len, names(*range(1, count)))) <= 80
