"""asia view: live pages of the runs in a browser."""

import json
import tempfile
import webbrowser
from pathlib import Path
from typing import Annotated

import typer

from asia._text import say
from asia.errors import UserError
from asia.interfaces.cli.options import DEFAULT_RUNS, Runs, run_directory


def view(
    run: Annotated[
        str | None,
        typer.Argument(
            metavar="[RUN]",
            help="Path or name of a run, or a folder of runs; left out: all below --runs.",
        ),
    ] = None,
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="Port on 127.0.0.1; 0 for any free one.")
    ] = 8731,
    open_: Annotated[bool, typer.Option("--open", help="Open the page in the browser.")] = False,
    runs: Runs = DEFAULT_RUNS,
) -> None:
    """Show running searches in a browser: curves, experiments, steering. Ctrl-C ends it.

    The printed address contains a token that the pages require.
    """
    from asia.interfaces.view import require_server

    require_server()
    from asia.interfaces.view.server import serve_view

    if run is not None and Path(run).is_dir() and not (Path(run) / "ledger.jsonl").exists():
        folder, name = Path(run).resolve(), None
    elif run is None and runs.is_dir():
        folder, name = runs.resolve(), None
    else:
        # A workspace has its runs in another folder, and may hide them.
        directory = run_directory(runs, run).resolve()
        folder, name = directory.parent, None if run is None else directory.name

    def started(address: str) -> None:
        say(f"view     {address}")
        say("Ctrl-C ends", flush=True)
        if open_:
            webbrowser.open(address)

    serve_view(folder, name, port, started, RunStarter())


class RunStarter:
    """Starts `asia run` for the pages. The search goes on after `asia view` ends."""

    agents = ("expert", "random", "bayes")
    """They need no key and run no program of others."""

    @property
    def problems(self) -> list[str]:
        """The built-in problems, and the folders with a problem.toml in the present folder."""
        return list(_problems())

    def start(self, runs: Path, text: str) -> tuple[str, str]:
        """See `asia.interfaces.view.streams.Starter`. The checks and messages are those of
        `asia run`."""
        from asia.interfaces.workspace.process import runs as searching
        from asia.interfaces.workspace.process import start_process
        from asia.problem.load import load_problem
        from asia.search.run import RUN_NAME, RUN_NAME_RULE, run_name

        problems = _problems()
        try:
            fields = {key: str(value).strip() for key, value in dict(json.loads(text)).items()}
            problem, agent = problems[fields["problem"]], fields["agent"]
            experiments, seed = int(fields["experiments"]), int(fields["seed"])
            if agent not in self.agents or experiments < 1 or seed < 0:
                raise ValueError(text)
        except (ValueError, TypeError, KeyError):
            raise UserError(
                f"expected one of the listed problems, an agent ({', '.join(self.agents)}), at "
                "least 1 experiment, and a seed of at least 0"
            ) from None
        name = fields.get("name") or run_name(load_problem(problem), agent, seed)
        if not RUN_NAME.fullmatch(name):
            raise UserError(f"'{name}' is no name of a run: {RUN_NAME_RULE}")
        directory = runs.resolve() / name
        if searching(directory):
            raise UserError(f"run '{name}' is running: choose another seed or name")
        words = ["asia", "run", str(problem), "--agent", agent, "--name", name]
        words += ["--experiments", str(experiments), "--seed", str(seed)]
        words += ["--runs", str(runs.resolve())]
        with tempfile.NamedTemporaryFile(prefix="asia-run-") as log:
            start_process(words, directory, Path(log.name))
        if searching(directory):
            return f"the search '{name}' runs", name
        return f"run '{name}' has all its experiments: ask for more of them to continue it", name


def _problems() -> dict[str, Path | str]:
    """Problems by name, as `asia run` takes them."""
    from asia.problem.load import builtin_problems

    own = {path.parent.name: path.parent.resolve() for path in Path().glob("*/problem.toml")}
    return {**{name: name for name in builtin_problems()}, **dict(sorted(own.items()))}
