"""Keys in the environment stay there: not in a child's, not on a command line, not in a file."""

from __future__ import annotations

import json
import os
import threading
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from asia.agents.llm.settings import LlmSettings
from asia.errors import UserError
from asia.interfaces.workspace.process import start_search
from asia.interfaces.workspace.server import RunDesk
from asia.problem.load import load_problem
from asia.search.run import prepare
from tests.unit.agents.fake_llm import Told, fake_llm, said
from tests.unit.interfaces.cli.conftest import command_line
from tests.unit.search.toy import arx, write_problem

from .commands import JAILED, RULES, run_command, says
from .desks import candidate, end_searches, ordered, searches

PLANTED = "planted-secret-8c1f0e"
KEY = "sk-planted-77a1"
BYSTANDER = "AWS_SECRET_ACCESS_KEY"
# A candidate that tells all it has of an environment, by every way out that it has.
TELLTALE = arx(2).replace(
    "    context.log",
    "    import os\n"
    "    found = repr(dict(os.environ))\n"
    "    for path in ('/proc/self/environ', '/proc/self/cmdline', '/proc/1/environ'):\n"
    "        try:\n"
    "            found += open(path, 'rb').read().decode('latin-1')\n"
    "        except OSError as error:\n"
    "            found += repr(error)\n"
    "    print(found)\n"
    "    context.log",
)
TELLTALE_CRASH = TELLTALE.replace("    print(found)\n", "    raise ValueError(found)\n")
DUMPS = (
    "import os; print(dict(os.environ)); print(open('/proc/self/environ').read()); "
    "print(open('/proc/1/environ').read() if os.environ['HOME'] == '/home/agent' else '')"
)


@dataclass
class Children:
    """All processes below this one while it was watched."""

    watched: set[int] = field(default_factory=set[int])
    told: list[str] = field(default_factory=list[str])

    def look(self, secrets: tuple[str, ...]) -> None:
        """Read environment and command line of each."""
        parents: dict[int, int] = {}
        for entry in os.listdir("/proc"):
            if entry.isdecimal():
                try:
                    stat = Path(f"/proc/{entry}/stat").read_text()
                except OSError:
                    continue
                parents[int(entry)] = int(stat.rpartition(")")[2].split()[1])
        for pid in parents:
            above = parents.get(pid)
            while above not in (None, 0, os.getpid()):
                above = parents.get(above)
            if above == os.getpid():
                self._read(pid, secrets)

    def _read(self, pid: int, secrets: tuple[str, ...]) -> None:
        for name in ("environ", "cmdline"):
            try:
                data = Path(f"/proc/{pid}/{name}").read_bytes()
            except OSError:
                continue
            if data:
                self.watched.add(pid)
            if any(secret.encode() in data for secret in secrets):
                self.told.append(f"{name} of {pid}")


@contextmanager
def watching(*secrets: str) -> Generator[Children]:
    children, over = Children(), threading.Event()

    def watch() -> None:
        while not over.wait(0.01):
            children.look(secrets)

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        yield children
    finally:
        over.set()
        thread.join()


def holding(folder: Path, secret: str) -> list[Path]:
    """Files that hold it, as it is or as JSON has it."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    assert len(files) > 5
    return [path for path in files if secret.encode() in path.read_bytes()]


@pytest.mark.slow
def test_a_search_with_a_language_model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PLANTED_KEY", KEY)
    monkeypatch.setenv(BYSTANDER, PLANTED)
    problem = write_problem(tmp_path / "toy")
    answers = [
        Told(status=503, body={"error": {"message": f"busy, {KEY}"}}, headers={"retry-after": "0"}),
        said(TELLTALE),
        said(TELLTALE_CRASH, title=f"with {KEY}"),
        Told(status=401, body={"error": {"message": f"no such key: {KEY}"}}),
    ]
    with fake_llm(answers) as server, watching(KEY, PLANTED) as children:
        done = command_line(
            "run", problem, "--agent", "llm", "--model", "made-up", "--base-url",
            server.url.replace("http://", f"http://user:{PLANTED}@"), "--api-key-env",
            "PLANTED_KEY", "--experiments", 4, "--runs", tmp_path / "runs",
        )  # fmt: skip
    assert len(server.asked) == 4, done.err
    assert "refuses the key" in done.err
    assert len(children.watched) >= 3
    assert children.told == []
    for secret in (KEY, PLANTED):
        assert secret not in done.out + done.err
        assert holding(tmp_path / "runs", secret) == []


@pytest.mark.slow
def test_the_process_behind_a_desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENAI_API_KEY", KEY)
    monkeypatch.setenv(BYSTANDER, PLANTED)
    place = ordered(tmp_path, experiments=2)
    desk = RunDesk(place.directory, start_search)
    try:
        with watching(KEY, PLANTED) as children:
            desk.submit(candidate())
            (search,) = searches(place.directory)
            environment = Path(f"/proc/{search}/environ").read_bytes()
            assert b"PATH=" in environment
            children.look((KEY, PLANTED))
        assert search in children.watched
        assert children.told == []
    finally:
        end_searches(place.directory)


@pytest.mark.slow
def test_a_coding_agent_and_its_own_key(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It must have its key; what it prints of it is not kept, and it gets no other."""
    monkeypatch.setenv("ANTHROPIC_API_KEY", KEY)
    monkeypatch.setenv(BYSTANDER, PLANTED)
    problem = write_problem(tmp_path / "toy", experiments=2)
    ready = prepare(load_problem(problem), "mine", seed=0, runs=tmp_path / "runs")
    preset = says(DUMPS)
    preset = type(preset)(**{**vars(preset), "keys": ("ANTHROPIC_API_KEY",)})
    rules = type(RULES)(**{**vars(RULES), "variables": preset.keys, "mounts": ()})
    with watching(PLANTED) as children:
        view = run_command(ready, preset, rules)
    assert view.sessions
    assert children.told == []
    run = tmp_path / "runs"
    assert holding(run, KEY) == holding(run, PLANTED) == []
    streams = b"".join(p.read_bytes() for p in (ready.directory / "artifacts").iterdir())
    assert streams.count(b"[hidden]") >= (3 if JAILED else 2)


@pytest.mark.parametrize("url", [f"http://[{PLANTED}", f"{PLANTED}@host", f"http://h:{PLANTED}"])
def test_what_is_no_address_is_not_repeated(url: str) -> None:
    with pytest.raises(UserError, match="the base URL is not valid") as caught:
        LlmSettings("m", url)
    assert PLANTED not in str(caught.value)


def test_the_record_of_an_address_has_no_password_and_no_query() -> None:
    settings = LlmSettings("m", f"https://user:{PLANTED}@[::1]:8000/v1?key={PLANTED}")
    assert json.dumps(settings.record()).count(PLANTED) == 0
    assert settings.shown_url == "https://[::1]:8000/v1"
