"""Does the agent of rules find what is planted, and nothing else? Prints its transcripts.

python run_planted.py FOLDER [bend+lag+drift] [bend] [lag] [drift] [none]
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

from planted import Planted, problem

HERE = Path(__file__).parent
ALL = ("bend+lag+drift", "bend", "lag", "drift", "none")


def main(folder: Path, wanted: list[str], seed: int) -> None:
    """A problem, a workspace and a transcript for each."""
    for name in wanted or ALL:
        effects = [] if name == "none" else name.split("+")
        here = folder / name
        problem(here / "problem", Planted(**dict.fromkeys(effects, True)), seed)
        asia = Path(sys.executable).parent / "asia"
        work, runs = here / "work", here / "runs"
        subprocess.run(
            [asia, "agent", "workspace", here / "problem", work, "--experiments", "7",
             "--runs", runs],
            check=True, stdout=subprocess.DEVNULL,
        )  # fmt: skip
        transcript = folder / f"{name}.txt"
        with transcript.open("w") as stream:
            agent = [sys.executable, HERE / "residual_agent.py"]
            subprocess.run(agent, cwd=work, stdout=stream, check=True)
        print(f"{name}: {transcript.read_text().splitlines()[-1]}", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("systems", nargs="*", help=", ".join(ALL))
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    main(given.folder, given.systems, given.seed)
