"""Pretends to be a coding agent: fake_agent.py FORMAT SCENARIO [ARGUMENTS]. It runs in the jail."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

FORMAT, SCENARIO, ARGUMENTS = sys.argv[1], sys.argv[2], sys.argv[3:]
ASIA = [sys.executable, "-c", "from asia.interfaces.cli import main; main()"]


def say(**event: object) -> None:
    print(json.dumps(event), flush=True)


def reply(number: int, tokens: int) -> None:
    """One reply of the model, as the format tells it."""
    if FORMAT == "claude":
        usage = {"input_tokens": tokens, "output_tokens": 10, "cache_read_input_tokens": 5}
        # Two events of one reply: counted once.
        for _ in range(2):
            say(type="assistant", message={"id": f"m{number}", "usage": usage}, session_id="s-1")
    elif FORMAT == "codex":
        say(type="turn.completed", usage={"input_tokens": tokens, "output_tokens": 10})
    else:
        say(type="message", role="assistant", content="working")


def candidate(name: str, order: int) -> str:
    source = (Path(__file__).parents[2] / "search" / "toy.py").read_text("utf-8")
    scope: dict[str, str] = {}
    exec(source[source.index('ARX = """') : source.index("NOISE =")], scope)
    text = scope["CRASH"] if order < 0 else scope["ARX"].replace("{order}", str(order))
    return text + f"\nNAME = {name!r}\n"


def attempt(name: str, order: int) -> None:
    Path("candidate.py").write_text(candidate(name, order))
    done = subprocess.run([*ASIA, "try", "-m", name], capture_output=True, text=True, check=False)
    say(type="tool_result", text=done.stdout + done.stderr)


def main() -> None:
    if FORMAT == "claude":
        say(type="system", subtype="init", session_id="s-1")
    elif FORMAT == "codex":
        say(type="thread.started", thread_id="t-1")
    else:
        say(type="init", session_id="g-1")
    print("this is not JSON", flush=True)
    if SCENARIO == "hang":
        time.sleep(600)
    if SCENARIO == "leave":
        sys.exit("cannot log in")
    if SCENARIO == "greedy":
        for number in range(1000):
            reply(number, 1000)
            # Long enough for a slow machine to read one before the next.
            time.sleep(0.5)
    if SCENARIO == "probe":
        probe()
    if SCENARIO == "plan":
        follow(json.loads(ARGUMENTS[0]))
        return
    first = not any("resume" in a for a in ARGUMENTS)
    orders = {"fail": [-1, -1, -1], "twice": [2] if first else [3]}.get(SCENARIO, [2, 3])
    for number, order in enumerate(orders):
        reply(number, 100)
        attempt(f"order {order}, number {number}", order)
    if FORMAT == "claude":
        cost = 0.03 if first else 0.05
        say(type="result", subtype="success", total_cost_usd=cost, num_turns=2, session_id="s-1")
    elif FORMAT == "gemini":
        say(type="result", status="success", stats={"input_tokens": 200, "output_tokens": 20})


def follow(plans: dict[str, list[str]]) -> None:
    """Do the steps that a plan has for this agent: `try N`, `submit N` without waiting for its
    result, `see N` (wait until results.tsv has it), `die` (in the first session)."""
    from asia.agents import Proposal
    from asia.interfaces.workspace.server import SocketDesk

    prompt = Path("PROMPT.md").read_text()
    for step in plans[prompt.partition("You are ")[2].partition(".")[0]]:
        verb, _, number = step.partition(" ")
        name = f"order {number}"
        if verb == "die" and not prompt.startswith("Continue the search"):
            os.kill(os.getpid(), 9)
        elif verb == "see":
            end = time.monotonic() + 120.0
            while name not in Path("results.tsv").read_text() and time.monotonic() < end:
                time.sleep(0.1)
        elif verb == "try":
            attempt(name, 1 + int(number) % 3)
        elif verb == "submit":
            desk = SocketDesk(Path(os.environ["ASIA_DESK"]))
            desk.submit(Proposal(candidate(name, 1 + int(number) % 3), "", name, name, ""))


def probe() -> None:
    """List the files and hosts that this process can reach."""
    found = {
        "home": os.path.exists(ARGUMENTS[0]),
        "ledger": os.path.exists(ARGUMENTS[1]),
        "test": os.path.exists(ARGUMENTS[2]),
        "root": sorted(os.listdir("/")),
        "processes": [p for p in os.listdir("/proc") if p.isdigit()],
        "keys": sorted(os.environ),
        "written": [],
        "network": False,
    }
    for place in ("/etc/x", "/usr/x", "/run/asia/x", "/x", f"{sys.prefix}/x"):
        try:
            Path(place).write_text("x")
        except OSError:
            continue
        found["written"].append(place)
    try:
        import socket

        socket.create_connection((ARGUMENTS[3], int(ARGUMENTS[4])), 1.0).close()
        found["network"] = True
    except OSError:
        pass
    Path("probe.json").write_text(json.dumps(found))


main()
