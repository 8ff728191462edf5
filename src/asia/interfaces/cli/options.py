"""Options that commands share, and groups of options as dataclasses."""

from __future__ import annotations

import inspect
import json
import os
import re
import sys
from collections.abc import Callable, Collection, Iterable, Sequence
from copy import copy
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import partial, wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, get_args, get_origin, get_type_hints

import typer
from annotated_types import Ge, Le
from typer.models import OptionInfo

from asia._progress import reported
from asia._text import say
from asia.agents.llm.settings import RequestSettings
from asia.errors import UserError
from asia.ledger.folder import linked_workspace, workspace_around
from asia.ledger.run import find_run
from asia.search.settings import SearchSettings

if TYPE_CHECKING:
    from asia.agents.llm.agent import LlmAgent
    from asia.interfaces.coding_agents.session import Access
    from asia.interfaces.workspace.process import SearchRequest
    from asia.judge.sandbox.types import Isolation


# Options of a jail: access of a program in it to more than its workspace.


_option = partial(typer.Option, rich_help_panel="Jail of a coding agent")


@dataclass(frozen=True)
class JailOptions:
    """Access of a program in a jail."""

    network: Annotated[
        bool, _option("--network", help="Allow network access, which hosted models need.")
    ] = False
    agent_config: Annotated[
        list[Path] | None,
        _option(
            help="Configuration folder or file of the agent, such as ~/.claude; it gets a copy."
        ),
    ] = None
    agent_mount: Annotated[
        list[Path] | None,
        _option(help="Folder that the agent may read, such as its installation."),
    ] = None
    pass_env: Annotated[
        list[str] | None,
        _option(help="Environment variable to pass to the agent, such as its key."),
    ] = None

    def access(self, keys: tuple[str, ...] = ()) -> Access:
        """Return the access. keys: variables to pass on if they are set. Raises UserError for a
        missing path or variable."""
        from asia.interfaces.coding_agents.session import Access

        configs, mounts = self.agent_config or (), self.agent_mount or ()
        for path in (*configs, *mounts):
            if not path.expanduser().exists():
                raise UserError(f"{path} does not exist: give a folder or file that does")
        for variable in self.pass_env or ():
            if variable not in os.environ:
                raise UserError(f"--pass-env {variable}: the variable is not set; export it first")
        return Access(
            network=self.network,
            mounts=tuple(p.expanduser().resolve() for p in mounts),
            # Not resolved: a link keeps its own name below the agent's home.
            configs=tuple(Path(os.path.abspath(p.expanduser())) for p in configs),
            variables=(*keys, *(self.pass_env or ())),
        )


def access_settings(access: Access) -> dict[str, str]:
    """Return the settings for the ledger."""

    def names(paths: Sequence[Path]) -> str:
        home = re.escape(str(Path.home()))
        return ", ".join(re.sub(f"^{home}(?=/|$)", "~", str(p)) for p in paths) or "none"

    return {
        "network": "yes" if access.network else "no",
        "mounts": names(access.mounts),
        "configs": names(access.configs),
    }


def jail_words(access: Access) -> str:
    """Return a phrase on what a program in the jail can reach."""
    network = "the network" if access.network else "no network (hosted models need --network)"
    shown = ", ".join(str(p) for p in (*access.mounts, *access.configs)) or "nothing else of yours"
    return f"in a jail (level namespace) with its workspace, {network}, {shown}"


# Options of language models: `asia run --agent llm`, and what coding agents share with it.


_shared = partial(
    typer.Option, rich_help_panel="Language models and coding agents (--agent llm, command:NAME)"
)
_own = partial(typer.Option, rich_help_panel="Language model (--agent llm)")


@dataclass(frozen=True)
class ModelOptions:
    """Model and its limits, for language models and coding agents."""

    model: Annotated[str | None, _shared(help="Name of the model, as its server calls it.")] = None
    max_tokens: Annotated[
        int | None,
        _shared(
            min=1,
            help=("Stop before input plus output tokens exceed this; no limit by default."),
        ),
    ] = None
    max_cost: Annotated[
        float | None,
        _shared(metavar="USD", help="Stop before the cost exceeds this; llm needs --prices."),
    ] = None


@dataclass(frozen=True, kw_only=True)
class LlmOptions(RequestSettings):
    """Server, sampling and limits of a language model."""

    panel: ClassVar[str] = "Language model (--agent llm)"

    base_url: Annotated[
        str | None,
        _own(
            envvar="OPENAI_BASE_URL",
            help="OpenAI-compatible server, such as http://localhost:8000/v1; default OpenAI's.",
        ),
    ] = None
    local: Annotated[
        Path | None,
        _own(
            metavar="GGUF", help="Start and stop a server with this model on this machine instead."
        ),
    ] = None
    llm_seed: Annotated[
        int | None, "Seed for the server, which may ignore it; not sent by default."
    ] = None
    extra_body: Annotated[
        str | None,
        _own(metavar="JSON", help="More fields of the request, such as '{\"top_k\": 20}'."),
    ] = None
    prices: Annotated[
        str | None,
        _own(metavar="IN,OUT", help="USD for a million input and output tokens, such as 0.5,2."),
    ] = None

    def agent(self, caps: ModelOptions) -> LlmAgent:
        """Make the agent. Raises UserError for invalid options."""
        from asia.agents.llm.agent import LlmAgent
        from asia.agents.llm.local import LocalServer
        from asia.agents.llm.settings import LlmSettings

        price_input = price_output = None
        if self.prices is not None:
            try:
                price_input, price_output = map(float, self.prices.split(","))
            except ValueError:
                raise UserError(
                    f"--prices {self.prices}: expected two numbers, USD for a million input and "
                    "output tokens, such as 0.5,2"
                ) from None
        extra_body: Any = {}
        if self.extra_body is not None:
            try:
                extra_body = json.loads(self.extra_body)
            except (ValueError, RecursionError):
                extra_body = None
            if not isinstance(extra_body, dict):
                raise UserError(
                    f"--extra-body {self.extra_body}: expected a JSON object, such as "
                    "'{\"top_k\": 20}'"
                )
        server, model = None, caps.model or ""
        if self.local is not None:
            # Requests of a menu are short; a longer context costs memory.
            server = LocalServer(self.local, context=8192 if self.proposals == "menu" else 0)
            model = model or self.local.stem
        return LlmAgent(
            LlmSettings(
                model=model,
                base_url=self.base_url if server is None else server.url,
                seed=0 if self.llm_seed is None and server is not None else self.llm_seed,
                extra_body=extra_body,
                max_tokens_total=caps.max_tokens,
                max_cost=caps.max_cost,
                price_input=price_input,
                price_output=price_output,
                local={} if server is None else server.facts,
                **{one.name: getattr(self, one.name) for one in fields(RequestSettings)},
            ),
            server=server,
        )


# Options of the agent `command:NAME`.


PREFIX = "command:"
_command_option = partial(
    typer.Option,
    rich_help_panel="Agent command:NAME (claude, codex, gemini, or a program of your own)",
)


@dataclass(frozen=True)
class CommandOptions(JailOptions):
    """Command line, limits and access of a coding agent."""

    command: Annotated[
        str | None,
        _command_option(
            help="Command line of your own agent, with {prompt} or {prompt_file} in it."
        ),
    ] = None
    agent_minutes: Annotated[
        float | None,
        _command_option(help="Stop the agent this many minutes after this command starts."),
    ] = None
    stuck_minutes: Annotated[
        float,
        _command_option(help="Stop the agent after this many minutes without a new experiment."),
    ] = 30.0


# Options of the evaluation: executor, experiments at a time.


@dataclass(frozen=True)
class EngineOptions:
    """Options of a command that evaluates many candidates."""

    parallel: Annotated[
        int, Ge(1), "Experiments at a time: each is proposed before the last N - 1 have results."
    ] = 1
    executor: Annotated[
        str,
        "Where folds are fitted: local, local:N (N jobs), dask://HOST:PORT, dask:FILE, "
        "dask-slurm:FILE.",
    ] = "local"


# Commands and options of plug-ins.


@dataclass(frozen=True)
class Command:
    """A command of a plug-in among the main commands of ASIA."""

    run: Callable[..., None] | typer.Typer
    after: str
    """Command that it follows in `asia --help`."""


AddedOptions = Callable[..., None]
"""Function of a plug-in with options of a command of ASIA. It receives a function without arguments
that runs the command, the values of the command's own parameters by name, and its options by
keyword."""


# Groups of options as dataclasses, one field per option; short and full help.


def with_groups(
    command: Callable[..., None],
    brief_help: Collection[str] | None = None,
    *,
    prints_progress: Callable[[], bool] = lambda: False,
    added: Sequence[AddedOptions] = (),
) -> Callable[..., None]:
    """Return the command for typer. Each parameter annotated with a dataclass is replaced by the
    annotated fields of that dataclass with their defaults. The annotation is an option of typer, or
    the text of the option and its limits. The option `--help-all` shows the options that `--help`
    hides.

    brief_help: parameters that `--help` shows; None: all that are not declared hidden.
    prints_progress: whether the command does so by itself.
    added: functions of plug-ins that add options."""
    groups: dict[str, Any] = {
        name: hint for name, hint, _ in _parameters(command) if is_dataclass(hint)
    }
    # Name, annotation and default of each option.
    own = [(one, [*_parameters(one)][2:]) for one in added]

    @wraps(command)
    def called(**given: Any) -> None:
        for name, group in groups.items():
            values = {f.name: given.pop(f.name) for f in fields(group) if f.name in given}
            given[name] = group(**values)
        given.pop("help_all")
        outer = [partial(one, **{name: given.pop(name) for name, *_ in p}) for one, p in own]
        do: Callable[[], None] = partial(command, **given)
        for one in outer:
            do = partial(one, do, given)
        if prints_progress():
            do()
            return
        with reported(command.__name__.strip("_"), lambda line: say(line, file=sys.stderr)):
            do()

    called.__doc__ = "\n\n".join(inspect.getdoc(one) or "" for one in (command, *added)).strip()

    shown: list[tuple[str, Any, Any]] = []
    for name, annotation, default in _parameters(command):
        if name not in groups:
            shown.append((name, annotation, default))
            continue
        hints = get_type_hints(groups[name], include_extras=True)
        for field in fields(groups[name]):
            if get_origin(hints[field.name]) is Annotated:
                default = inspect.Parameter.empty if field.default is MISSING else field.default
                if field.default_factory is not MISSING:
                    default = field.default_factory()
                option = _with_option(field.name, hints[field.name], groups[name])
                shown.append((field.name, option, default))
    shown += [parameter for _, parameters in own for parameter in parameters]

    some_hidden = False
    for place, (name, annotation, default) in enumerate(shown):
        notes = get_args(annotation)[1:] if get_origin(annotation) is Annotated else ()
        option = next((note for note in notes if isinstance(note, OptionInfo)), None)
        if option is not None and brief_help is not None and name not in brief_help:
            option = copy(option)
            option.hidden = True
            shown[place] = name, Annotated[get_args(annotation)[0], option], default
        some_hidden = some_hidden or (option is not None and option.hidden)

    def show_all(ctx: typer.Context, wanted: bool) -> None:
        if wanted:
            for parameter in ctx.command.params:
                parameter.hidden = False  # pyright: ignore[reportAttributeAccessIssue]
            say(ctx.get_help())
            raise typer.Exit

    help_all = typer.Option(
        "--help-all",
        is_eager=True,
        callback=show_all,
        # A command that hides nothing does not need it.
        hidden=not some_hidden,
        help="Show all options and exit.",
    )
    shown.append(("help_all", Annotated[bool, help_all], False))
    parameters = [
        inspect.Parameter(
            name, inspect.Parameter.KEYWORD_ONLY, annotation=annotation, default=default
        )
        for name, annotation, default in shown
    ]
    called.__signature__ = inspect.Signature(parameters)  # pyright: ignore[reportAttributeAccessIssue]
    called.__annotations__ = {p.name: p.annotation for p in parameters}
    return called


def _with_option(name: str, annotation: Any, group: Any) -> Any:
    """Return the annotation with the option that its text and limits describe, if it has a text.
    `panel` of the group is the title above it in the help."""
    kind, *notes = get_args(annotation)
    text = next((note for note in notes if isinstance(note, str)), None)
    if text is None:
        return annotation
    limits: dict[str, Any] = {
        "min": next((note.ge for note in notes if isinstance(note, Ge)), None),
        "max": next((note.le for note in notes if isinstance(note, Le)), None),
    }
    # A switch that is off has no option that keeps it off.
    names = (f"--{name.replace('_', '-')}",) if kind is bool else ()
    panel = getattr(group, "panel", None)
    return Annotated[kind, typer.Option(*names, help=text, rich_help_panel=panel, **limits)]


def _parameters(function: Callable[..., None]) -> list[tuple[str, Any, Any]]:
    """Name, annotation (None without one) and default of each parameter."""
    hints = get_type_hints(function, include_extras=True)
    known = inspect.signature(function).parameters.values()
    return [(one.name, hints.get(one.name), one.default) for one in known]


def given(group: Any, *, leave_out: tuple[str, ...] = ()) -> dict[str, object]:
    """Return the options of a group that differ from their defaults, by name."""
    return {
        f.name: getattr(group, f.name)
        for f in fields(group)
        if f.name not in leave_out and getattr(group, f.name) != f.default
    }


# Options that several commands share.


Runs = Annotated[
    Path, typer.Option("--runs", envvar="ASIA_RUNS", help="Directory that holds the runs.")
]
RunName = Annotated[
    str | None,
    typer.Argument(
        metavar="[RUN]", help="Path or name; default: the run of this workspace, else the newest."
    ),
]
Json = Annotated[bool, typer.Option("--json", help="JSON on stdout, everything else on stderr.")]
Profile = Annotated[
    bool, typer.Option("--profile", help="Also print the time of each activity of the search.")
]
Keys = Annotated[
    Path | None,
    typer.Option(
        "--keys",
        help="Folder with the keys of sealed tests; default ASIA_KEYS, else ~/.config/asia/keys.",
    ),
]
YesProcess = Annotated[
    bool,
    typer.Option(
        "--yes-process", help="Open the test, although candidates at level process could read it."
    ),
]
ProblemName = Annotated[
    str,
    typer.Argument(
        metavar="PROBLEM",
        help="Built-in name (two_tanks_sim, bouc_wen, cascaded_tanks, ced, emps, f16, "
        "fine_steering_mirror, nanodrone, parallel_wiener_hammerstein, silverbox, "
        "wiener_hammerstein; controllers: two_tanks_control, quadruple_tank_control, "
        "cstr_control), or a directory with problem.toml.",
    ),
]
GuardRecords = Annotated[
    bool | None,
    typer.Option(
        "--guard/--no-guard",
        help="Hold back 15 % of the training records, which no candidate and no agent sees, to "
        "confirm each new best. On by default for agents that write candidates.",
        show_default=False,
    ),
]
Time = Annotated[
    str | None, typer.Option(help='Column with the time stamps; "none": do not use any.')
]
TimeUnit = Annotated[
    str | None,
    typer.Option(
        help="Unit of time stamps that are numbers: s, ms, us, ns, min, h, d; of others their "
        "form: day-first, month-first, h:m, m:s."
    ),
]
ColumnNames = Annotated[
    list[str] | None, typer.Option(help="Column names of files without a header, in order.")
]
Experiment = Annotated[
    str | None, typer.Option(help="Column that names the experiment: each becomes a record.")
]
DEFAULT_RUNS = Path("runs")


# Resolution of the argument RUN.


def run_directory(runs: Path, name: str | None, *, named: bool = False) -> Path:
    """Find the run as `asia.ledger.run.find_run` does. In a workspace, without --runs, the default
    is
    the run of the workspace, and a name is a run in the same folder. named: require a name in a
    workspace, for actions that cannot be undone. Raises UserError."""
    folder = workspace_around(Path()) if runs == DEFAULT_RUNS else None
    if folder is None:
        return find_run(runs, name)
    link = linked_workspace(folder)
    run = None if link is None else link.run
    if run is None:
        raise UserError(
            f"{folder} is the folder of a coding agent, which does not see its run: read "
            "results.tsv and search_journal.md there, or run the command outside this folder. If "
            "you moved the folder, repeat asia agent workspace with its new place"
        )
    if name is not None:
        return find_run(run.parent, name)
    if not (run / "ledger.jsonl").is_file():
        raise UserError(
            f"the search of this workspace, {run.name}, has not started: asia try starts it"
        )
    if named:
        raise UserError(
            f"this cannot be undone: name the run of this workspace, {run.name}, to continue"
        )
    return run


# Isolation of candidates.


CandidateLevel = Annotated[
    str | None,
    typer.Option(
        "--isolation",
        help="Level for the candidates of the run instead of the strongest of this machine: "
        "landlock or process.",
    ),
]


def read_level(text: str | None) -> Isolation | None:
    """Return the requested level; None without one. Raises UserError for an unknown one."""
    from asia.judge.sandbox.types import Isolation

    levels = [level.value for level in Isolation]
    if text is not None and text not in levels:
        raise UserError(f"--isolation {text}: expected one of {', '.join(levels)}")
    return Isolation(text) if text else None


def candidate_level(text: str | None) -> Isolation:
    """Return the level for the candidates of an existing run, see `asia.search.run.level_here`.
    Print a note if it does not confine them. Raises UserError."""
    from asia.judge.sandbox.levels import LEVELS
    from asia.search.run import level_here

    level = level_here(read_level(text))
    if not LEVELS[level].confined:
        say(
            f"note    candidates run at isolation level {level}, with your rights: use it only for "
            "candidates that you trust",
            file=sys.stderr,
        )
    return level


@dataclass(frozen=True)
class RunOptions:
    """Options of a command that runs candidates of an existing run."""

    isolation: CandidateLevel = None
    runs: Runs = DEFAULT_RUNS
    json: Json = False

    @property
    def level(self) -> Isolation:
        """The level for the candidates. Raises UserError."""
        return candidate_level(self.isolation)

    def directory(self, run: str | None, *, named: bool = False) -> Path:
        """Find the run as `run_directory` does."""
        return run_directory(self.runs, run, named=named)

    def print(self, lines: Iterable[str], files: Iterable[Path] = ()) -> None:
        """Print lines and files: on stderr with --json, which has stdout for itself."""
        stream = sys.stderr if self.json else sys.stdout
        for line in (*lines, *(f"file      {path}" for path in files)):
            say(line, file=stream)


# Options of a search: budget, name, isolation.


@dataclass(frozen=True, kw_only=True)
class SearchOptions(SearchSettings):
    """Options of every command that starts a search."""

    name: Annotated[str | None, "Name of the run; default PROBLEM-AGENT-sSEED."] = None

    @property
    def level(self) -> Isolation | None:
        """The requested level. Raises UserError for an unknown one."""
        return read_level(self.isolation)

    def check(self) -> None:
        """Raise UserError for an invalid name or an unknown level. A number would be read as an
        experiment, and a path would leave the directory of the runs."""
        from asia.search.run import RUN_NAME, RUN_NAME_RULE

        name = self.name
        if name is not None and not RUN_NAME.fullmatch(name):
            raise UserError(f"--name '{name}': {RUN_NAME_RULE}")
        _ = self.level

    def request(self, problem: str, agent: str) -> SearchRequest:
        """Return the request for a search by `agent`. Raises UserError as `check` does."""
        from asia.interfaces.workspace.process import SearchRequest

        self.check()
        own = {name: value for name, value in vars(self).items() if name != "name"}
        return SearchRequest(problem=problem, agent=agent, **own)

    def words(self) -> list[str]:
        """Return the command line of these options."""
        words: list[str] = []
        for name, value in given(self).items():
            words += [f"--{name.replace('_', '-')}", *([] if value is True else [str(value)])]
        return words
