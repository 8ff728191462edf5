"""asia doctor: isolation levels, plugins and attacks on this machine."""

from __future__ import annotations

import sys
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Annotated

import typer

from asia._text import say
from asia.interfaces.cli.options import Json, given
from asia.interfaces.cli.redteam import AttackOptions, run_attacks

if TYPE_CHECKING:
    from collections.abc import Sequence

    from asia._plugins import Part
    from asia.judge.sandbox.availability import LevelState, Machine

_INDENT = 13
WINDOWS = (
    "ASIA does not run on Windows directly. Run `wsl --install` in PowerShell to get Linux in "
    "WSL2. Then install ASIA in that Linux."
)
MACOS = (
    "ASIA was not tested on macOS. Candidates run at level sandbox-exec or process, without a "
    "memory limit. Use a Linux virtual machine or container for level namespace or landlock."
)


def doctor(
    *,
    executor: Annotated[
        str | None,
        typer.Option(
            help="Test the machines of an executor instead: dask://HOST:PORT or dask:FILE. With "
            "--attack: its workers, on this machine, fit the folds of the attacks."
        ),
    ] = None,
    attack: Annotated[
        bool,
        typer.Option(
            "--attack",
            help="Run scripted attacks against this installation: each must be blocked or "
            "flagged, and honest candidates must not be. Exit code 1 if not.",
        ),
    ] = False,
    attacks: AttackOptions,
    json: Json = False,
) -> None:
    """Test every isolation level on this machine, print how to enable a stronger one, and list the
    installed plugins."""
    from asia.errors import UserError
    from asia.judge.sandbox.availability import machine, survey

    if attack:
        run_attacks(attacks, executor, json=json)
        return
    for name in given(attacks):
        option = "no-prove" if name == "prove" else name.replace("_", "-")
        raise UserError(f"--{option} belongs to --attack: add --attack or leave it out")
    if executor is not None:
        _print_executor(executor, json=json)
        return
    here, levels = machine(), survey()
    gpu = _gpu(levels)
    plugged, clash = _plugged()
    if json:
        from json import dumps

        best = next(state.level for state in levels if state.works)
        found = {
            "level": best,
            "machine": asdict(here),
            "levels": [asdict(s) for s in levels],
            "gpu": None if gpu is None else asdict(gpu),
            "parts": [_part_object(p) for p in plugged],
            "clash": clash,
        }
        say(dumps(found))
    else:
        _print_machine(here)
        _print_gpu(gpu)
        _print_levels(levels)
        _print_parts(plugged, clash)
        say()
        say("docs/isolation.md lists the attacks that each level stops.")


def _print_executor(name: str, *, json: bool) -> None:
    """Print every worker of an executor. Exit code 2 if one cannot work for a search from here."""
    from json import dumps

    from asia.judge.evaluation.machines import survey_machines
    from asia.judge.executors import make_executor, remote_executor_of

    carrier = remote_executor_of(make_executor(name))
    states = [] if carrier is None else survey_machines(carrier)
    unfit = [state for state in states if state.unlike or not state.isolation]
    if json:
        say(dumps({"executor": name, "workers": [asdict(state) for state in states]}))
    elif carrier is None:
        say(f"executor {name} fits folds on this machine: run asia doctor without --executor")
    for state in () if json else states:
        level = f"{state.isolation} ({', '.join(state.layers)})" if state.isolation else "none"
        say(
            f"worker     {state.worker} on {state.machine}, {state.cores} cores, "
            f"isolation {level}, round trip {1000 * state.round_trip:.0f} ms, "
            f"clock {state.clock:+.2f} s" + (f", GPU {state.gpu}" if state.gpu else "")
        )
        if state.unlike:
            say(f"{'':<11}{state.unlike}")
    if unfit:
        raise typer.Exit(2)


@dataclass(frozen=True)
class _Gpu:
    """The GPU of this machine."""

    driver: str
    """Name that the driver reports."""
    jax: str | None
    """Name in JAX; None if workers cannot use it."""
    why_not: str | None
    """Reason if workers cannot use it."""


def _gpu(levels: Sequence[LevelState]) -> _Gpu | None:
    """Test the GPU at the isolation level that a search uses here; None without a GPU."""
    from asia.errors import SandboxError
    from asia.judge.sandbox.availability import gpu_here
    from asia.judge.sandbox.layers.gpu import gpu_description, gpu_nodes

    if not gpu_nodes():
        return None
    level = next(state.level for state in levels if state.works)
    try:
        return _Gpu(gpu_description(), gpu_here(level), None)
    except SandboxError as error:
        return _Gpu(gpu_description(), None, str(error))


def _print_gpu(gpu: _Gpu | None) -> None:
    if gpu is None:
        say("gpu        none: candidates compute on the processor")
        return
    say(f"gpu        {gpu.driver or 'an NVIDIA GPU'}")
    if gpu.jax is not None:
        say(f"{'':<11}--device gpu: JAX reaches it as {gpu.jax}")
        return
    say(f"{'':<11}--device gpu does not work: {gpu.why_not}")
    say(f"{'':<11}to get it: NVIDIA's driver, and pip install '.[gpu]' in a clone of ASIA")


def _plugged() -> tuple[tuple[Part, ...], str | None]:
    """Return the parts of other packages, or the reason why they cannot be listed."""
    from asia._plugins import parts
    from asia.errors import UserError

    try:
        return tuple(parts()), None
    except UserError as error:
        return (), str(error)


def _part_object(part: Part) -> dict[str, str | None]:
    """Return a part as JSON, with the reason if it does not load."""
    found = asdict(part)
    kind = found.pop("group").removeprefix("asia.")
    return {"kind": kind, **found, "failure": part.why_not()}


def _print_machine(here: Machine) -> None:
    if sys.platform == "darwin":
        say(f"macOS      {MACOS}")
    memory = f", {here.memory_mb} MB of memory" if here.memory_mb else ""
    where = ", in a container" if here.container else ""
    say(f"machine    {here.system}, {here.architecture}, {here.cores} cores{memory}{where}")
    say(f"python     {here.python}, as {'root' if here.user == 'root' else 'an ordinary user'}")
    say(f"landlock   {f'version {here.landlock}' if here.landlock else 'none'}")
    say(f"bubblewrap {here.bubblewrap or 'none'}")


def _print_levels(levels: Sequence[LevelState]) -> None:
    say()
    chosen = False
    for state in levels:
        used = state.works and not chosen
        chosen = chosen or state.works
        words = f"works: {', '.join(state.layers)}" if state.works else "does not work"
        say(f"{state.level:<{_INDENT}}{words}{'   <- what a search uses here' if used else ''}")
        for lack in state.lacks:
            say(f"{'':<{_INDENT}}why not: {lack.reason}")
            say(f"{'':<{_INDENT}}to get it: {lack.remedy}")


def _print_parts(plugged: Sequence[Part], clash: str | None) -> None:
    say()
    if not plugged:
        say(f"{'plugged in':<{_INDENT}}{clash or 'nothing: no other package adds a part'}")
        return
    heads = [f"{p.group.removeprefix('asia.')} {p.name}" for p in plugged]
    width = max(_INDENT, *(len(head) + 2 for head in heads))
    for head, part in zip(heads, plugged, strict=True):
        say(f"{head:<{width}}{part.target}, of {part.package} {part.version}")
        if failure := part.why_not():
            say(f"{'':<{width}}does not load: {failure}")
