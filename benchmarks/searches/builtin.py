"""V of an agent on built-in problems over several seeds, with their equations or without.

Without names, the problems are all public benchmarks; one without data on this machine is left out.
Without equations is what a user with nothing but records gets. Nothing here opens a test. Where
`asia unseal` opened one, the second table has the official figures and their rank.

    python benchmarks/searches/builtin.py cascaded_tanks --seeds 0 1 2 --runs runs
    python benchmarks/searches/builtin.py cascaded_tanks nanodrone --without-equations --runs runs
    python benchmarks/searches/builtin.py --experiments 10 --picture pictures
"""

from __future__ import annotations

import statistics
import sys
import time
from dataclasses import replace
from pathlib import Path

from asia.agents import make_agent
from asia.errors import UserError
from asia.ledger.run import open_run
from asia.problem.load import load_problem
from asia.report.files import save
from asia.report.pictures.leaderboard import draw_boards
from asia.report.published import Board, read_board
from asia.search.run import prepare, search
from harness import number, option_parser, table

BENCHMARKS = [
    "cascaded_tanks", "ced", "emps", "bouc_wen", "silverbox", "wiener_hammerstein", "nanodrone",
    "fine_steering_mirror", "f16", "parallel_wiener_hammerstein",
]  # fmt: skip
PUBLISHED = {"cascaded_tanks": 0.250}
"""V of Piga and Forgione, best of 15, early stopping on the validation fold, which ours does not
see. Their baseline has 0.681."""


def main() -> None:
    """Run the searches that are not there yet and print the tables."""
    parser = option_parser(__doc__)
    parser.add_argument("problems", nargs="*", default=BENCHMARKS)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--experiments", type=int, default=15)
    parser.add_argument("--agent", default="expert")
    parser.add_argument("--without-equations", action="store_true")
    parser.add_argument("--runs", type=Path, default=Path("runs"))
    parser.add_argument("--picture", type=Path, help="folder for a picture of published results")
    options = parser.parse_args()
    rows: list[list[str]] = []
    boards: list[Board] = []
    for name in options.problems:
        try:
            problem = load_problem(name)
        except UserError as error:
            print(f"{name} is left out: {error}", file=sys.stderr)
            continue
        problem = replace(problem, budget=replace(problem.budget, experiments=options.experiments))
        if options.without_equations:
            problem = replace(problem, physics=None)
        values: list[float] = []
        for seed in options.seeds:
            kind = "-black-box" if options.without_equations else ""
            run = f"{name}{kind}-{options.agent}-s{seed}"
            start, agent = time.monotonic(), make_agent(options.agent)
            ready = prepare(problem, agent.name, seed=seed, runs=options.runs, name=run)
            search(ready, agent, lambda *_: None, lambda _: None)
            minutes = (time.monotonic() - start) / 60
            view = open_run(options.runs / run).view
            if view.best is None or view.best.score is None:
                raise SystemExit(f"{run}: no candidate has a score")
            if seed == options.seeds[0]:
                boards.append(read_board(problem, view))
            values.append(view.best.score.value)
            linear = {r.name: r.outcome for r in view.references}.get("linear model")
            baseline = view.experiment(1).score
            rows.append(
                [name, str(seed), f"{values[-1]:.4f}",
                 ", ".join(f"{fold.value:.3f}" for fold in view.best.score.folds),
                 view.best.proposed.title, str(view.best.number),
                 number(baseline.value if baseline else None),
                 number(getattr(linear, "value", None)), f"{minutes:.1f}"]
            )  # fmt: skip
        middle = statistics.median(values)
        ratio = "" if name not in PUBLISHED else f"{middle / PUBLISHED[name]:.2f} of the published"
        rows.append([f"**{name}**", "median", f"{middle:.4f}", ratio, *[""] * 5])
    heads = "problem", "seed", "V", "folds", "candidate", "experiment"
    print(table([*heads, "baseline V", "linear V", "wall min"], rows))
    figures = [row for board in boards for row in official_rows(board)]
    if figures:
        heads = "benchmark", "figure", "unit", "test error", "rank", "lowest published"
        print(f"\n{table(heads, figures)}")
    boards = [board for board in boards if board.entries]
    if options.picture is not None and boards:
        save([("boards", lambda: draw_boards(boards, "Published results"))], options.picture)


def official_rows(board: Board) -> list[list[str]]:
    """A row for each official figure of a benchmark."""
    rows: list[list[str]] = []
    for index, name in enumerate(board.names or ("test",)):
        own = board.standings[index] if index < len(board.standings) else None
        ours = "sealed" if own is None else number(own.figure.value)
        rank = "-" if own is None or own.among == 1 else f"{own.rank} of {own.among}"
        found = [entry.figures[index] for entry in board.entries if index < len(entry.figures)]
        lowest = min((value for value in found if value is not None), default=None)
        rows.append([board.problem, name, board.unit or "-", ours, rank, number(lowest)])
    return rows


if __name__ == "__main__":
    main()
