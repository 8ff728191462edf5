import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from asia.candidate import Context
from asia.data import Signal, Trajectory
from asia.errors import CandidateError, Reason, SandboxError
from asia.judge.sandbox.availability import open_worker, why_not
from asia.judge.sandbox.types import Isolation, Limits
from asia.judge.sandbox.worker.process import select_one
from asia.problem import ParameterRange, Physics

from .conftest import one_level

GAIN = """
import numpy as np

class Gain:
    def __init__(self, gain):
        self.gain = gain

    def simulate(self, past_u, past_y, u):
        return u @ self.gain + past_y[:, -1:, :]

def fit(trajectories, context):
    u = np.concatenate([t.u for t in trajectories])
    y = np.concatenate([t.y for t in trajectories])
    for step in range(10):
        context.log(step, 1.0 / (step + 1))
    print("fitted", len(u), "samples")
    return Gain(np.linalg.lstsq(u, y, rcond=None)[0])
"""
FAIL = """
def fit(trajectories, context):
    BODY
"""


def failing(body: str) -> str:
    return FAIL.replace("BODY", body)


def failure(worker, case, source: str) -> CandidateError:
    with worker() as one, pytest.raises(CandidateError) as caught:
        one.fit(source, case.trajectories, case.context)
    return caught.value


@one_level
def test_the_candidate_gets_the_whole_context_and_read_only_records(worker, case):
    physics = Physics(("x",), {"x": "-k*x + u"}, {"k": ParameterRange(0.1, 1.0)})
    context = Context(
        (Signal("u", "V"),), (Signal("a"), Signal("b")), 0.1, 5, 3, 40, "mae", physics, seed=7
    )
    source = GAIN.replace(
        "    print(",
        "    import time\n"
        "    print(context.inputs[0].label, context.ny, context.horizon, context.metric,\n"
        "          context.physics.parameters['k'].max, context.seed, context.n_past_y,\n"
        "          0 < context.deadline - time.monotonic() < 61,\n"
        "          trajectories[1].name, trajectories[0].u.flags.writeable)\n"
        "    print(",
    )
    with worker() as one:
        reply = one.fit(source, case.trajectories, context)
    assert reply[1].splitlines()[0] == "u [V] 2 40 mae 1.0 7 3 True second False"


@one_level
def test_a_refit_may_start_from_the_models_of_the_folds(worker, case):
    source = GAIN.replace(
        "    print(", "    print([m.gain.shape for m in context.fold_models()])\n    print("
    )
    models = []
    for expected in ("[]", "[(1, 2)]"):
        with worker() as one:
            reply = one.fit(source, case.trajectories, case.context, fold_models=models)
            models = [one.dump()]
        assert reply[1].splitlines()[0] == expected


@one_level
def test_long_curve_is_thinned_evenly(worker, case):
    source = GAIN.replace("range(10)", "range(9001)")
    with worker() as one:
        curve = one.fit(source, case.trajectories, case.context)[0]
    assert 1000 <= len(curve) <= 2000
    assert curve[0, 0] == 0
    assert set(np.diff(curve[:, 0])) == {8.0}


@one_level
def test_many_lines_of_the_sandbox_are_no_output_of_a_candidate(worker, case):
    lines = "import os;os.write(2, b'[mutex.cc : 1] RAW: Lock blocking 0x0\\n' * 4000)"
    source = GAIN.replace("print(", f"{lines};_ = (")
    with worker() as one:
        assert one.fit(source, case.trajectories, case.context)[1] == ""


@one_level
def test_output_is_kept_up_to_the_end_of_fit_and_cleaned(worker, case):
    source = GAIN.replace("print(", "print('\\x1b[31mred\\x07', 'x' * 100_000);print(").replace(
        "        return u",
        "        print('late');import os;os.write(2, b'x' * 200_000)\n        return u",
    )
    with worker() as one:
        output = one.fit(source, case.trajectories, case.context)[1]
        y = one.simulate(case.past_u, case.past_y, case.u)
    assert output.startswith("[31mred x")
    assert len(output) < 64 * 1024 + 50
    assert " bytes left out ..." in output
    assert output.endswith("x\nfitted 250 samples\n")
    assert y.shape == (3, 40, 2)


def test_environment_is_fixed(worker, case, monkeypatch):
    monkeypatch.setenv("SECRET_KEY", "hunter2")
    source = GAIN.replace(
        "    print(", "    import os\n    print(*sorted(os.environ), hash('a'))\n    print("
    )
    seen = set()
    for _ in range(2):
        with worker() as one:
            seen.add(one.fit(source, case.trajectories, case.context)[1])
    assert len(seen) == 1  # string hashes too: a set has the same order in every worker
    assert "SECRET_KEY" not in seen.pop()


@one_level
def test_worker_imports_nothing_heavy(worker, case):
    source = GAIN.replace(
        "    print(",
        "    import sys\n"
        "    import asia\n"
        "    heavy = ('pydantic', 'typer', 'matplotlib', 'scipy', 'jax', 'sympy', 'rich')\n"
        "    print([name for name in heavy if name in sys.modules])\n"
        "    print(",
    )
    with worker() as one:
        output = one.fit(source, case.trajectories, case.context)[1]
    assert output.splitlines()[0] == "[]"


@one_level
def test_jax_runs_under_the_default_memory_limit(worker, case):
    source = """
import jax
import jax.numpy as jnp

class Decay:
    def __init__(self, rate):
        self.rate = rate

    def simulate(self, past_u, past_y, u):
        def step(y, u_k):
            y = self.rate * y + u_k
            return y, y
        run = jax.jit(jax.vmap(lambda y0, u: jax.lax.scan(step, y0, u)[1]))
        return run(past_y[:, -1], u)

def fit(trajectories, context):
    rate = jax.jit(jax.grad(lambda r: jnp.sum(r * jnp.ones(2))))(0.3)
    return Decay(rate / 4)
"""
    with worker() as one:
        one.fit(source, case.trajectories, case.context)
        y = one.simulate(case.past_u, case.past_y, case.u)
    expected = 0.5 * case.past_y[:, -1] + case.u[:, 0]
    np.testing.assert_allclose(y[:, 0], expected, rtol=1e-5)


@one_level
@pytest.mark.parametrize(
    ("source", "reason", "words"),
    [
        ("def fit(:\n", Reason.SYNTAX, "SyntaxError"),
        ("x = 1", Reason.CONTRACT, "no function fit"),
        (failing("return 3"), Reason.CONTRACT, "int, which has no simulate"),
        (failing("return {}['gain']"), Reason.CRASH, "in fit\n    return {}['gain']"),
        (failing("import numpy; numpy.linalg.inv(numpy.zeros((2, 2)))"), Reason.CRASH, "Singular"),
        (failing("raise SystemExit(3)"), Reason.EXITED, "SystemExit: 3"),
        (failing("import os; os._exit(3)"), Reason.EXITED, "exit code 3"),
        (failing("import os; os.abort()"), Reason.EXITED, "exit code 134"),
        (failing("raise MemoryError"), Reason.MEMORY, "MemoryError"),
        (failing("raise RuntimeError('RESOURCE_EXHAUSTED: x')"), Reason.MEMORY, "EXHAUSTED"),
        (failing("print('std::bad_alloc'); import os; os.abort()"), Reason.MEMORY, "bad_alloc"),
        (failing("raise KeyboardInterrupt"), Reason.CRASH, "KeyboardInterrupt"),
    ],
)
def test_each_failure_of_fit_has_its_reason_and_words(worker, case, source, reason, words):
    error = failure(worker, case, source)
    assert error.reason is reason
    assert words in error.detail
    assert "_child.py" not in error.detail


@one_level
@pytest.mark.parametrize(
    ("result", "reason", "words"),
    [
        ("u[:, :-1]", Reason.WRONG_LENGTH, "got shape (3, 39, 1), expected (3, 40, 2)"),
        ("u[:, :20]", Reason.WRONG_LENGTH, "got shape (3, ?, 1), expected (3, 40, 2)"),
        ("None", Reason.WRONG_LENGTH, "got shape ()"),
        ("'text'", Reason.CONTRACT, "no array of numbers"),
        ("1j * past_y[:, -1:].repeat(40, 1)", Reason.CONTRACT, "no array of numbers"),
        ("[[1], [2, 3]]", Reason.CONTRACT, "no array of numbers"),
        ("1 / 0", Reason.CRASH, "ZeroDivisionError"),
        ("exec('raise type(str(u[0, 0, 0]), (Exception,), {})')", Reason.CRASH, "of its own"),
    ],
)
def test_each_failure_of_simulate_has_its_reason(worker, case, result, reason, words):
    source = GAIN.replace("return u @ self.gain + past_y[:, -1:, :]", f"return {result}")
    with worker() as one:
        one.fit(source, case.trajectories, case.context)
        with pytest.raises(CandidateError) as caught:
            one.simulate(case.past_u, case.past_y, case.u)
    assert caught.value.reason is reason
    assert words in caught.value.detail


@one_level
def test_a_worker_that_failed_or_is_closed_answers_no_more(worker, case):
    one = worker()
    with pytest.raises(CandidateError):
        one.fit("x = 1", case.trajectories, case.context)
    with pytest.raises(SandboxError):
        one.simulate(case.past_u, case.past_y, case.u)
    one.close()
    one.close()
    unused = worker()
    with pytest.raises(SandboxError):
        unused.dump()
    unused.close()
    with pytest.raises(SandboxError):
        unused.fit(GAIN, case.trajectories, case.context)


def test_a_sandbox_killed_from_outside_is_not_the_candidates_fault(case):
    reason = why_not(Isolation.NAMESPACE)
    if reason is not None:
        pytest.skip(reason)
    with open_worker(Isolation.NAMESPACE, Limits(60.0, 30.0, 4096)) as one:
        one.fit(GAIN, case.trajectories, case.context)
        one._process.process.kill()
        one._process.process.wait()
        assert _wait_for(lambda: select_one(one._process.pipes.replies)), "the worker lives on"
        with pytest.raises(SandboxError, match="signal 9"):
            one.simulate(case.past_u, case.past_y, case.u)


def test_ending_one_worker_keeps_the_others(worker, case, level):
    daemon = "import os, time\n    if os.fork() == 0:\n        os.setsid(); time.sleep(60)"
    bystander = subprocess.Popen(["sleep", "60"], start_new_session=True)
    try:
        with worker() as kept:
            kept.fit(GAIN, case.trajectories, case.context)
            with worker() as ended:
                error = None
                try:
                    ended.fit(failing(daemon), case.trajectories, case.context)
                except CandidateError as caught:
                    error = caught
            assert error is not None
            forks = level is Isolation.PROCESS
            assert error.reason is (Reason.CONTRACT if forks else Reason.CRASH)
            assert kept.simulate(case.past_u, case.past_y, case.u).shape == (3, 40, 2)
        assert bystander.poll() is None
    finally:
        bystander.kill()
        bystander.wait()


@one_level
def test_workers_run_side_by_side_in_threads(worker, case):
    results: list[np.ndarray] = []

    def run() -> None:
        with worker() as one:
            one.fit(GAIN, case.trajectories, case.context)
            results.append(one.simulate(case.past_u, case.past_y, case.u))

    threads = [threading.Thread(target=run) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(results) == 3
    np.testing.assert_array_equal(results[0], results[1])
    np.testing.assert_array_equal(results[0], results[2])


PARENT = """
import sys
from asia.candidate import Context
from asia.problem import Signal, Trajectory
from asia.judge.sandbox.types import Isolation, Limits
from asia.judge.sandbox.availability import open_worker

worker = open_worker(Isolation(sys.argv[1]), Limits(120.0, 1.0, 4096))
record = Trajectory([0.0, 1.0], [0.0, 1.0], 1.0)
context = Context((Signal("u"),), (Signal("y"),), 1.0, 1, 1)
worker.fit(open(sys.argv[2]).read(), [record], context)
"""
DAEMON = """
import ctypes, os, time

def fit(trajectories, context):
    ctypes.CDLL(None).prctl(15, b"NAME", 0, 0, 0)
    ctypes.CDLL(None).prctl(1, 0, 0, 0, 0)  # not to be told of the parent's death
    try:
        child = os.fork()
    except PermissionError:
        child = None
    if child == 0:
        os.setsid()
        if os.fork():
            os._exit(0)
    time.sleep(120)
"""


def test_a_killed_parent_takes_worker_and_daemons_with_it(level: Isolation, tmp_path):
    name = f"orphan{os.getpid()}"
    source = tmp_path / "source.py"
    source.write_text(DAEMON.replace("NAME", name))
    command = [sys.executable, "-c", PARENT, level.value, str(source)]
    env = os.environ | {"TMPDIR": str(tmp_path)}
    parent = subprocess.Popen(command, start_new_session=True, env=env)
    try:
        processes = 2 if level is Isolation.PROCESS else 1
        assert _wait_for(lambda: _named(name) >= processes), "the candidate did not start"
    finally:
        os.killpg(parent.pid, signal.SIGKILL)
        parent.wait()
    assert _wait_for(lambda: _named(name) == 0), "processes outlived their parent"
    assert _wait_for(lambda: os.listdir(tmp_path) == ["source.py"]), "a folder was left behind"


def _wait_for(condition, seconds: float = 30.0) -> bool:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.02)
    return False


def _named(name: str) -> int:
    count = 0
    for pid in os.listdir("/proc"):
        try:
            with open(f"/proc/{pid}/stat") as file:
                text = file.read()
        except OSError:
            continue
        count += f"({name})" in text and text.rpartition(")")[2].split()[0] not in "ZX"
    return count


@one_level
def test_long_records_are_read_only_and_long_cases_are_the_candidates_own(worker, case):
    rng = np.random.default_rng(1)
    u, y = rng.normal(size=(20_000, 1)), rng.normal(size=(20_000, 2))
    source = GAIN.replace(
        "    print(", "    print(trajectories[0].u.flags.writeable, float(u.sum()))\n    print("
    ).replace("        return u", "        u += 1.0\n        return u")
    with worker() as one:
        reply = one.fit(source, (Trajectory(u, y, 0.1, "long"),), case.context)
        past_u, past_y, u_now = case.past_u[:1], case.past_y[:1], u[None]
        y_hat = one.simulate(past_u, past_y, u_now)
    assert reply[1].splitlines()[0] == f"False {u.sum()}"
    gain = np.linalg.lstsq(u, y, rcond=None)[0]
    np.testing.assert_allclose(y_hat, (u_now + 1.0) @ gain + past_y[:, -1:], rtol=1e-12)
    assert np.array_equal(u_now[0], u)
