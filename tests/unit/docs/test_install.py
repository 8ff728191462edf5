"""Each line of the documents and messages that installs ASIA works from a clone."""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections import defaultdict
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
LINE = re.compile(
    r"pip install (?P<words>(?:'[^']*'|\"[^\"]*\"|[^\s'\"`#(),;:]+)(?: +\./[\w./-]+)*)"
)
PAGES = ("*.md", "docs/**/*.md", "examples/**/*.md", "examples/**/*.ipynb", "examples/**/*.sbatch")


def install_lines(*patterns: str) -> dict[str, list[str]]:
    """Words after `pip install`, and the files that hold them."""
    found: dict[str, list[str]] = defaultdict(list)
    for path in sorted(path for pattern in patterns for path in ROOT.glob(pattern)):
        text = path.read_text()
        if path.suffix == ".ipynb":
            text = "\n".join("".join(cell["source"]) for cell in json.loads(text)["cells"])
        if path.suffix == ".py":  # a message may be written in several parts
            text = re.sub(r"\"\s*\n\s*f?\"", "", text)
        for line in LINE.finditer(text):
            found[line["words"]].append(str(path.relative_to(ROOT)))
    return dict(found)


def extras_of(words: str) -> list[str]:
    return [name for group in re.findall(r"\[(.*?)\]", words) for name in group.split(",")]


DOCUMENTED = install_lines(*PAGES)
PRINTED = install_lines("src/**/*.py")


def test_pages_and_messages_name_extras_that_exist() -> None:
    named = {extra for words in (*DOCUMENTED, *PRINTED) for extra in extras_of(words)}
    assert named - {"{extra}"} <= set(EXTRAS)  # asia.data.intake.formats names the extra of a file


def test_extras_are_installed_from_the_clone_in_quotes() -> None:
    """The package is in no registry, and an unquoted bracket is a pattern of the shell."""
    wrong = {
        words: files
        for words, files in {**DOCUMENTED, **PRINTED}.items()
        if "asia-sysid" in words or ("[" in words and not re.fullmatch(r"'\.\[[\w,{}]+\]'", words))
    }
    assert wrong == {}
    texts = [p for pattern in (*PAGES, "src/**/*.py") for p in ROOT.glob(pattern)]
    assert [str(p) for p in texts if "asia-sysid[" in p.read_text()] == []


def test_every_extra_is_documented() -> None:
    assert {name for words in DOCUMENTED for name in extras_of(words)} == set(EXTRAS)


def run_in(folder: Path, *command: str) -> str:
    """Run a command as a user would; pip need not compile what is deleted after the test."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    environment |= {"PIP_NO_COMPILE": "1"}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.long
def test_the_first_commands_of_the_readme_work_in_a_clone(tmp_path: Path) -> None:
    first = next(re.finditer(r"```sh\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL))[1]
    commands = [line.split("#")[0].strip() for line in first.splitlines()]
    assert commands == ["make demo", "make test", "source .venv/bin/activate"]
    commands.remove("make test")  # this test is a part of it
    run_in(tmp_path, "git", "clone", "--quiet", ROOT.as_uri(), "clone")
    script = "\n".join(["set -e", *commands, "asia show"])
    printed = run_in(tmp_path / "clone", "bash", "-c", script)
    advice = printed[printed.index("Type next:") :]
    assert "source .venv/bin/activate" in advice.splitlines()[0]
    assert "asia show" in advice.splitlines()[1]
    assert "hypothesis" in advice
    shutil.rmtree(tmp_path / "clone")


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A fresh environment with ASIA and no extra, as `make demo` leaves it."""
    folder = tmp_path_factory.mktemp("installed") / "venv"
    subprocess.run([sys.executable, "-m", "venv", folder], check=True)
    run_in(ROOT, str(folder / "bin" / "python"), "-m", "pip", "install", "--quiet", ".")
    return folder


@pytest.mark.long
@pytest.mark.parametrize("words", DOCUMENTED)
def test_it_installs_into_a_fresh_environment(words: str, installed: Path, tmp_path: Path) -> None:
    """Each line runs in its own copy of an environment that only has ASIA.

    pip replaces files and changes none, so the copies share them by hard links.
    """
    folder = tmp_path / "venv"
    shutil.copytree(installed, folder, symlinks=True, copy_function=os.link)
    python = str(folder / "bin" / "python")
    (folder / "bin" / "asia").unlink()  # pip has to write it again, for this folder

    def run(*command: str) -> str:
        return run_in(ROOT, *command)

    run(python, "-m", "pip", "install", "--quiet", *shlex.split(words))
    run(python, "-m", "pip", "check")
    listed = {
        p["name"].lower() for p in json.loads(run(python, "-m", "pip", "list", "--format", "json"))
    }
    wanted = [re.split(r"[\[<>=]", need)[0] for name in extras_of(words) for need in EXTRAS[name]]
    assert {"asia-sysid", *(name.lower() for name in wanted)} <= listed
    assert "asia 0" in run(str(folder / "bin" / "asia"), "--version")
    shutil.rmtree(folder)
