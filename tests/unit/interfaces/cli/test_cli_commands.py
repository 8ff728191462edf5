"""The commands: groups, short and full help, plugins, steering."""

import fcntl
import sys
from types import ModuleType

import pytest
import typer

from asia import _plugins
from asia._plugins import Part
from asia.interfaces.cli import MAIN_COMMANDS, MORE_COMMANDS

from .conftest import Asia, Searched


def listed(text: str) -> list[str]:
    """First words of the rows in the boxes of a help page."""
    rows = [line.removeprefix("│ ") for line in text.splitlines() if line.startswith("│ ")]
    return [row.split()[0] for row in rows if not row.startswith(" ")]


def test_help_lists_the_main_commands_first(asia: Asia) -> None:
    names = [word for word in listed(asia("--help").out) if not word.startswith("-")]
    place = names.index("linear") + 1
    assert names[place : place + 4] == ["control", "monitor", "certify", "next"]
    assert [*names[:place], *names[place + 4 :]] == [*MAIN_COMMANDS, *MORE_COMMANDS]
    assert {"init", "check", "run"} <= {*MAIN_COMMANDS}
    assert "workspace" in listed(asia("agent", "--help").out)
    assert "agents" in listed(asia("bench", "--help").out)


def test_the_help_of_run_is_short_and_help_all_is_complete(asia: Asia) -> None:
    options = [w for w in listed(asia("run", "--help").out) if w.startswith("--")]
    assert options == [
        "--agent", "--experiments", "--seed", "--hours", "--isolation", "--name", "--parallel",
        "--executor", "--runs", "--json", "--help-all", "--help", "--model",
    ]  # fmt: skip
    done = asia("run", "--help-all")
    assert done.code == 0
    assert {*options, "--retests", "--temperature", "--network"} <= {*listed(done.out)}
    # A hidden option works, and a command that hides nothing shows the same twice.
    assert "--retests" not in asia("run", "--help").out
    assert "Invalid value for '--retests'" in asia("run", "--retests", "x").err
    brief, full = (listed(asia("status", option).out) for option in ("--help", "--help-all"))
    assert [word for word in full if word != "--help-all"] == brief


def test_options_of_repeated_fits_need_their_flag(asia: Asia, searched: Searched) -> None:
    runs = ("--runs", searched.runs)
    for words, expected in (
        (("--top", 2), "--top belongs to --repeat"),
        (("--ablate", "--top", 2), "--top belongs to --repeat"),
        (("--seeds", 2), "--seeds belongs to --repeat or --ablate"),
        (("--repeat", "--ablate"), "--repeat and --ablate do not go together"),
        (("--repeat", "--time", "t"), "--repeat uses training records only"),
    ):
        done = asia("validate", *words, *runs)
        assert (done.code, done.out) == (2, "")
        assert expected in done.err
    assert "--from-scratch belongs to --replay" in asia("verify", "--from-scratch", *runs).err
    assert "do not go together" in asia("doctor", "--attack", "--executor", "local").err


def test_a_running_search_is_steered(asia: Asia, searched: Searched) -> None:
    def steer(*words: str) -> str:
        done = asia("steer", searched.name, *words, "--runs", searched.runs)
        return done.out if done.code == 0 else done.err

    control = searched.directory / "control"
    assert "give --note TEXT, --pause, --resume or --stop" in steer()
    assert "--pause and --stop do not go together" in steer("--pause", "--stop")
    assert "is finished: there is nothing to pause" in steer("--pause", "--note", "slower")
    assert not control.exists() or not [*control.glob("steer-*")]
    assert steer("--note", "slower").startswith(f"noted for {searched.name}: recorded when the")
    assert len([*control.glob("steer-*")]) == 1
    assert steer("--resume") == f"{searched.name} was not paused\n"
    with (searched.directory / "ledger.jsonl").open("ab") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        assert "pauses after its current experiment" in steer("--pause")
        assert "is already paused" in steer("--pause")
        assert (control / "pause").exists()
        assert steer("--resume") == f"{searched.name} continues\n"
        assert not (control / "pause").exists()
        assert "stops after its current experiment" in steer("--stop")
        assert (control / "stop").exists()


def test_a_plugin_adds_commands(asia: Asia, monkeypatch: pytest.MonkeyPatch) -> None:
    module = ModuleType("oven_commands")

    def bake(degrees: int = 200) -> None:
        """Bake a model."""
        typer.echo(f"baked at {degrees}")

    group = typer.Typer(help="Shelves of an oven.")

    @group.command("count")
    def count() -> None:
        """Count them."""
        typer.echo("three")

    @group.command("clean")
    def clean() -> None:
        """Clean them."""

    module.bake, module.shelf, module.number = bake, group, 3  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "oven_commands", module)
    parts = [
        Part("asia.commands", name, f"oven_commands:{target}", "oven", "1.0")
        for name, target in (
            ("bake", "bake"), ("shelf", "shelf"), ("number", "number"), ("gone", "nothing"),
            ("run", "bake"),
        )
    ]  # fmt: skip
    monkeypatch.setattr(_plugins, "parts", lambda: tuple(parts))
    shown = asia("--help").out
    assert "Commands of oven" in shown
    assert {"bake", "shelf", "number", "gone"} <= {*listed(shown)}
    assert asia("bake", "--degrees", 180).out == "baked at 180\n"
    assert asia("shelf", "count").out == "three\n"
    # A plugin does not replace a command of ASIA.
    assert "baked" not in asia("run", "nowhere").out
    for name, expected in (("number", "expected a typer.Typer or a function"), ("gone", "has no")):
        done = asia(name)
        assert (done.code, done.out) == (2, "")
        assert expected in done.err
    assert "commands bake" in asia("doctor").out
