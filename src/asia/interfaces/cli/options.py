"""Options that commands share, and groups of options as dataclasses."""

from __future__ import annotations

import inspect
import json
import os
import re
from collections.abc import Callable, Collection, Iterator, Sequence
from copy import copy
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass, replace
from functools import partial, wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args, get_origin, get_type_hints

import typer
from typer.models import ArgumentInfo, OptionInfo, ParameterInfo

from asia._text import say
from asia.interfaces.cli.driver import Driver

if TYPE_CHECKING:
    from asia.agents.llm.agent import LlmAgent
    from asia.interfaces.coding_agents.session import Access, CommandRules
    from asia.interfaces.workspace.process import SearchRequest
    from asia.judge.executors import Executor
    from asia.judge.sandbox.types import Isolation
    from asia.problem.problem import Problem


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
        _check_given((*configs, *mounts), self.pass_env or ())
        return Access(
            network=self.network,
            mounts=tuple(p.expanduser().resolve() for p in mounts),
            # Not resolved: a link keeps its own name below the agent's home.
            configs=tuple(Path(os.path.abspath(p.expanduser())) for p in configs),
            variables=(*keys, *(self.pass_env or ())),
        )


def access_settings(access: Access) -> dict[str, str]:
    """Return the settings for the ledger."""
    return {
        "network": "yes" if access.network else "no",
        "mounts": _names(access.mounts),
        "configs": _names(access.configs),
    }


def jail_words(access: Access) -> str:
    """Return a phrase on what a program in the jail can reach."""
    network = "the network" if access.network else "no network (hosted models need --network)"
    shown = ", ".join(str(p) for p in (*access.mounts, *access.configs)) or "nothing else of yours"
    return f"in a jail (level namespace) with its workspace, {network}, {shown}"


def _names(paths: Sequence[Path]) -> str:
    home = str(Path.home())
    return ", ".join(re.sub(f"^{re.escape(home)}(?=/|$)", "~", str(p)) for p in paths) or "none"


def _check_given(paths: Sequence[Path], variables: Sequence[str]) -> None:
    from asia.errors import UserError

    for path in paths:
        if not path.expanduser().exists():
            raise UserError(f"{path} does not exist: give a folder or file that does")
    for variable in variables:
        if variable not in os.environ:
            raise UserError(f"--pass-env {variable}: the variable is not set; export it first")


# Options of language models: `asia run --agent llm`, and what coding agents share with it.


KEY_VARIABLE = "OPENAI_API_KEY"
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


@dataclass(frozen=True)
class LlmOptions:
    """Server, sampling and limits of a language model."""

    base_url: Annotated[
        str | None,
        _own(
            envvar="OPENAI_BASE_URL",
            help="OpenAI-compatible server, such as http://localhost:8000/v1; default OpenAI's.",
        ),
    ] = None
    temperature: Annotated[
        float | None, _own(min=0.0, help="Passed to the server; not sent by default.")
    ] = None
    top_p: Annotated[
        float | None, _own(min=0.0, max=1.0, help="Passed to the server; not sent by default.")
    ] = None
    llm_seed: Annotated[
        int | None, _own(help="Seed for the server, which may ignore it; not sent by default.")
    ] = None
    extra_body: Annotated[
        str | None,
        _own(metavar="JSON", help="More fields of the request, such as '{\"top_k\": 20}'."),
    ] = None
    api_key_env: Annotated[
        str,
        _own(
            metavar="NAME", help="Environment variable that holds the key; local servers need none."
        ),
    ] = KEY_VARIABLE
    max_reply_tokens: Annotated[
        int | None, _own(min=1, help="Limit of one reply, with its reasoning; default 16384.")
    ] = None
    prices: Annotated[
        str | None,
        _own(metavar="IN,OUT", help="USD for a million input and output tokens, such as 0.5,2."),
    ] = None
    anonymous: Annotated[
        bool,
        _own(
            "--anonymous",
            help=(
                "Hide names, units, description and equations, to measure the value of prior "
                "knowledge."
            ),
        ),
    ] = False

    def agent(self, caps: ModelOptions) -> LlmAgent:
        """Make the agent. Raises UserError for invalid options."""
        from asia.agents.llm.agent import LlmAgent
        from asia.agents.llm.settings import LlmSettings

        price_input, price_output = _prices(self.prices)
        return LlmAgent(
            LlmSettings(
                model=caps.model or "",
                base_url=self.base_url,
                temperature=self.temperature,
                top_p=self.top_p,
                seed=self.llm_seed,
                extra_body=_object(self.extra_body),
                api_key_env=self.api_key_env,
                max_tokens_total=caps.max_tokens,
                max_cost=caps.max_cost,
                price_input=price_input,
                price_output=price_output,
                max_reply_tokens=self.max_reply_tokens or LlmSettings.max_reply_tokens,
                anonymous=self.anonymous,
            )
        )


def _prices(text: str | None) -> tuple[float | None, float | None]:
    from asia.errors import UserError

    if text is None:
        return None, None
    try:
        price_input, price_output = (float(part) for part in text.split(","))
    except ValueError:
        raise UserError(
            f"--prices {text}: expected two numbers, USD for a million input and output tokens, "
            "such as 0.5,2"
        ) from None
    return price_input, price_output


def _object(text: str | None) -> dict[str, Any]:
    from asia.errors import UserError

    if text is None:
        return {}
    try:
        value = json.loads(text)
    except (ValueError, RecursionError):
        value = None
    if not isinstance(value, dict):
        raise UserError(f"--extra-body {text}: expected a JSON object, such as '{{\"top_k\": 20}}'")
    return value


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

    def driver(self, agent: str, caps: ModelOptions) -> Driver:
        """Make the driver: program, rules and jail. Raises UserError for a missing program, and for
        a limit that cannot be enforced."""
        from asia.interfaces.coding_agents.presets import make_preset
        from asia.interfaces.coding_agents.session import check_rules, command_agent

        name = _name(agent)
        preset = make_preset(name, self.command)
        rules = self._rules(preset.keys, caps)
        check_rules(preset, rules)
        return Driver(
            name,
            lambda ready, leg: command_agent(ready, preset, rules, leg),
            _settings(self.command or name, rules),
            (_jail_words(name, rules),),
        )

    def _rules(self, keys: tuple[str, ...], caps: ModelOptions) -> CommandRules:
        from asia.interfaces.coding_agents.session import CommandRules
        from asia.judge.sandbox.jail import Jail

        access = self.access(keys)
        return CommandRules(
            minutes=self.agent_minutes,
            tokens=caps.max_tokens,
            cost=caps.max_cost,
            stuck_minutes=self.stuck_minutes,
            network=access.network,
            mounts=access.mounts,
            configs=access.configs,
            variables=access.variables,
            jail=Jail.why_not() is None,
            model=caps.model,
        )


def _name(agent: str) -> str:
    """Return NAME of `command:NAME`. Raises UserError if it is reserved or invalid."""
    from asia.agents.registry import RESERVED
    from asia.errors import UserError

    name = agent.removeprefix(PREFIX)
    if not name.replace("-", "").isalnum():
        raise UserError(f"--agent {agent}: expected command:NAME with letters and digits")
    if name in RESERVED:
        raise UserError(f"--agent {agent}: '{name}' is reserved; choose another name")
    return name


def _settings(command: str, rules: CommandRules) -> dict[str, str]:
    """Return the settings for the ledger."""
    return {
        "command": command,
        "model": rules.model or "its default",
        "jail": "namespace" if rules.jail else "none",
        **access_settings(rules),
    }


def _jail_words(name: str, rules: CommandRules) -> str:
    """Return a sentence on the isolation of the agent."""
    if not rules.jail:
        return (
            f"agent {name}: no jail (level process). It can read all your files: other runs, "
            "unsealed test files, keys. Its score still comes only from the evaluator. "
            "Install bubblewrap for a jail."
        )
    return f"agent {name}: {jail_words(rules)}"


# Options of the evaluation: executor, device, experiments at a time.


@dataclass(frozen=True)
class EngineOptions:
    """Options of a command that evaluates many candidates."""

    parallel: Annotated[
        int,
        typer.Option(
            min=1,
            help="Experiments at a time: each is proposed before the last N - 1 have results.",
        ),
    ] = 1
    stop_folds: Annotated[
        bool,
        typer.Option(
            "--stop-folds",
            help="Skip the remaining folds of a candidate that is far behind the best.",
        ),
    ] = False
    device: Annotated[
        str,
        typer.Option(
            help="Device for networks: cpu, gpu (NVIDIA, extra gpu), or auto (a GPU if present)."
        ),
    ] = "cpu"
    executor: Annotated[
        str,
        typer.Option(
            help="Where folds are fitted: local, local:N (N jobs), dask://HOST:PORT, dask:FILE, "
            "dask-slurm:FILE."
        ),
    ] = "local"

    def chosen(self) -> Executor:
        """Make the executor. Raises UserError for an unknown name."""
        from asia.judge.executors import make_executor

        return make_executor(self.executor)


# Groups of options as dataclasses, one field per option; short and full help.


_ALL = "help_all"


def with_groups(
    command: Callable[..., None], brief_help: Collection[str] | None = None
) -> Callable[..., None]:
    """Return the command for typer. Each parameter annotated with a dataclass is replaced by the
    fields of that dataclass, which keep their annotations and defaults. The option `--help-all`
    shows the options that `--help` hides.

    brief_help: parameters that `--help` shows; None: all that are not declared hidden."""
    hints = get_type_hints(command, include_extras=True)
    groups: dict[str, Any] = {name: hint for name, hint in hints.items() if is_dataclass(hint)}

    @wraps(command)
    def called(**given: Any) -> None:
        for name, group in groups.items():
            given[name] = group(**{f.name: given.pop(f.name) for f in fields(group)})
        given.pop(_ALL)
        command(**given)

    own = inspect.signature(command).parameters
    shown = [p for name in own for p in _parameters(own[name], hints[name])]
    if brief_help is not None:
        shown = [p if p.name in brief_help else _hidden(p) for p in shown]
    shown.append(_parameter(_ALL, _help_all(any(map(_is_hidden, shown))), False))
    called.__signature__ = inspect.Signature(shown)  # pyright: ignore[reportAttributeAccessIssue]
    called.__annotations__ = {p.name: p.annotation for p in shown}
    return called


def _help_all(useful: bool) -> Any:
    """Annotation of `--help-all`; itself hidden for a command that hides nothing."""

    def show(ctx: typer.Context, wanted: bool) -> None:
        if wanted:
            for parameter in ctx.command.params:
                parameter.hidden = False  # pyright: ignore[reportAttributeAccessIssue]
            say(ctx.get_help())
            raise typer.Exit

    option = typer.Option(
        "--help-all",
        is_eager=True,
        callback=show,
        hidden=not useful,
        help="Show all options and exit.",
    )
    return Annotated[bool, option]


def _info(parameter: inspect.Parameter) -> ParameterInfo | None:
    """Declaration of an option or an argument."""
    notes = (
        get_args(parameter.annotation)[1:] if get_origin(parameter.annotation) is Annotated else ()
    )
    return next((n for n in notes if isinstance(n, ParameterInfo)), None)


def _is_hidden(parameter: inspect.Parameter) -> bool:
    found = _info(parameter)
    return isinstance(found, OptionInfo) and found.hidden


def _hidden(parameter: inspect.Parameter) -> inspect.Parameter:
    found = _info(parameter)
    if found is None or isinstance(found, ArgumentInfo):
        return parameter
    found = copy(found)
    found.hidden = True
    kind = get_args(parameter.annotation)[0]
    return parameter.replace(annotation=Annotated[kind, found])


def given(group: Any, *, leave_out: tuple[str, ...] = ()) -> dict[str, object]:
    """Return the options of a group that differ from their defaults, by name."""
    return {
        f.name: getattr(group, f.name)
        for f in fields(group)
        if f.name not in leave_out and getattr(group, f.name) != f.default
    }


def _parameters(own: inspect.Parameter, hint: Any) -> Iterator[inspect.Parameter]:
    if not is_dataclass(hint):
        yield _parameter(own.name, hint, own.default)
        return
    hints = get_type_hints(hint, include_extras=True)
    for field in fields(hint):
        yield _parameter(field.name, hints[field.name], _default(field))


def _parameter(name: str, annotation: Any, default: Any) -> inspect.Parameter:
    kind = inspect.Parameter.KEYWORD_ONLY
    return inspect.Parameter(name, kind, annotation=annotation, default=default)


def _default(field: Field[Any]) -> Any:
    return inspect.Parameter.empty if field.default is MISSING else field.default


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
        "wiener_hammerstein), or a directory with "
        "problem.toml.",
    ),
]
Time = Annotated[
    str | None, typer.Option(help='Column with the time stamps; "none": do not use any.')
]
TimeUnit = Annotated[
    str | None, typer.Option(help="Unit of time stamps that are numbers: s, ms, us, ns, days.")
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
    from asia.errors import UserError
    from asia.interfaces.workspace.workspace import Workspace
    from asia.ledger.run import find_run

    place = Workspace.around(Path()) if runs == DEFAULT_RUNS else None
    if place is None:
        return find_run(runs, name)
    if place.run is None:
        raise UserError(
            f"{place.folder} is the folder of a coding agent, which does not see its run: read "
            "results.tsv and search_journal.md there, or run the command outside this folder"
        )
    if name is not None:
        return find_run(place.run.parent, name)
    if not (place.run / "ledger.jsonl").is_file():
        raise UserError(
            f"the search of this workspace, {place.run.name}, has not started: asia try starts it"
        )
    if named:
        raise UserError(
            f"this cannot be undone: name the run of this workspace, {place.run.name}, to continue"
        )
    return place.run


# Options of a search: budget, name, isolation.


@dataclass(frozen=True)
class SearchOptions:
    """Options of every command that starts a search."""

    experiments: Annotated[
        int | None, typer.Option(min=1, help="Candidates to evaluate, the baseline included.")
    ] = None
    seed: Annotated[int, typer.Option(min=0, help="Seed of the search.")] = 0
    hours: Annotated[
        float | None, typer.Option(help="Start no experiment after this many hours of evaluation.")
    ] = None
    retests: Annotated[
        int | None,
        typer.Option(
            min=0,
            help="Repeat fits required before accepting a new best; 0: one fit decides. Default: "
            "the problem's.",
        ),
    ] = None
    name: Annotated[
        str | None, typer.Option(help="Name of the run; default PROBLEM-AGENT-sSEED.")
    ] = None
    early_stopping: Annotated[
        str | None,
        typer.Option(help="inner, or validation (V is then not leak-free); default the problem's."),
    ] = None
    isolation: Annotated[
        str | None,
        typer.Option(help="Isolation level instead of the strongest: landlock or process."),
    ] = None
    isolation_strict: Annotated[
        bool,
        typer.Option(
            "--isolation-strict",
            help="Fit the folds one at a time: slower, but workers cannot communicate.",
        ),
    ] = False

    @property
    def level(self) -> Isolation | None:
        """The requested level. Raises UserError for an unknown one."""
        from asia.errors import UserError
        from asia.judge.sandbox.types import Isolation

        levels = [level.value for level in Isolation]
        if self.isolation is not None and self.isolation not in levels:
            raise UserError(f"--isolation {self.isolation}: expected one of {', '.join(levels)}")
        return Isolation(self.isolation) if self.isolation else None

    def check(self) -> None:
        """Raise UserError for an invalid name or an unknown level. A number would be read as an
        experiment, and a path would leave the directory of the runs."""
        from asia.errors import UserError

        name = self.name
        if name is not None and (not re.fullmatch(r"\w[\w.+-]*", name) or name.isdecimal()):
            raise UserError(
                f"--name '{name}': expected letters, digits and . _ + - that begin with a letter "
                "or digit and are not a number alone"
            )
        _ = self.level

    def applied(self, problem: Problem) -> Problem:
        """Return the problem with these options in place of its own."""
        from asia.search.run import with_early_stopping

        own = problem.budget
        budget = replace(
            own,
            experiments=self.experiments or own.experiments,
            hours=self.hours if self.hours is not None else own.hours,
            retests=self.retests if self.retests is not None else own.retests,
        )
        problem = replace(problem, budget=budget)
        if self.early_stopping is None:
            return problem
        return with_early_stopping(problem, self.early_stopping)

    def request(self, problem: str, agent: str) -> SearchRequest:
        """Return the request for a search by `agent`. Raises UserError as `check` does."""
        from asia.interfaces.workspace.process import SearchRequest

        self.check()
        return SearchRequest(
            problem=problem,
            agent=agent,
            seed=self.seed,
            experiments=self.experiments,
            hours=self.hours,
            early_stopping=self.early_stopping,
            isolation=self.isolation,
            isolation_strict=self.isolation_strict,
            retests=self.retests,
        )

    def words(self) -> list[str]:
        """Return the command line of these options."""
        pairs = (
            ("--experiments", self.experiments),
            ("--seed", self.seed or None),
            ("--hours", self.hours),
            ("--retests", self.retests),
            ("--name", self.name),
            ("--early-stopping", self.early_stopping),
            ("--isolation", self.isolation),
        )
        words = [w for option, value in pairs if value is not None for w in (option, str(value))]
        return [*words, *(["--isolation-strict"] if self.isolation_strict else [])]
