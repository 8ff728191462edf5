"""GPU access of workers, with made-up device nodes and without a driver."""

import ctypes
import os
import struct
from dataclasses import replace
from pathlib import Path

import pytest

from asia.errors import CandidateError, Reason, SandboxError, UserError
from asia.judge.sandbox import availability as gpu_module
from asia.judge.sandbox.availability import chosen_gpu, gpu_here, open_worker
from asia.judge.sandbox.layers import bubblewrap, environment, seccomp
from asia.judge.sandbox.layers.gpu import GPU_FACTS, gpu_nodes
from asia.judge.sandbox.types import Isolation, Limits
from asia.judge.sandbox.worker.process import ResourceWatch, resident_bytes

from .conftest import Case

LIMITS = Limits(60.0, 30.0, 4096)
ON_GPU = replace(LIMITS, gpu=True)
NODES = ("/dev/nvidia0", "/dev/nvidia1", "/dev/nvidiactl", "/dev/nvidia-uvm")
PLAIN = """
import os, resource


class Model:
    def simulate(self, past_u, past_y, u):
        return u[:, :, [0, 0]]


def fit(trajectories, context):
    print(resource.getrlimit(resource.RLIMIT_AS)[0], os.environ["JAX_PLATFORMS"])
    return Model()
"""


@pytest.fixture
def nodes(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (bubblewrap, environment, gpu_module):
        monkeypatch.setattr(module, "gpu_nodes", lambda: NODES)


def test_a_gpu_is_a_card_and_its_driver(tmp_path: Path) -> None:
    (tmp_path / "nvidia0").touch()
    assert gpu_nodes(tmp_path) == ()
    for name in ("nvidiactl", "nvidia1", "nvidia-uvm", "nvidia-modeset", "nvram"):
        (tmp_path / name).touch()
    found = [Path(node).name for node in gpu_nodes(tmp_path)]
    assert found == ["nvidia0", "nvidia1", "nvidiactl", "nvidia-uvm"]


def test_without_a_gpu_a_worker_is_unchanged(nodes: None) -> None:
    plain = environment.child_command(3, 4, LIMITS, ("rlimits",))
    assert "4096" in plain
    assert not any("nvidia" in word or word in GPU_FACTS for word in plain)
    assert not any("nvidia" in word for word in bubblewrap.bubblewrap_options())
    assert environment.environment("/x") == {
        **environment.environment("/x"),
        **environment.REPEATABLE,
    }
    assert environment.environment("/x")["JAX_PLATFORMS"] == "cpu"
    assert "XLA_PYTHON_CLIENT_PREALLOCATE" not in environment.environment("/x")


def test_a_worker_on_a_gpu_gets_its_nodes_and_no_limit_of_addresses(nodes: None) -> None:
    command = environment.child_command(3, 4, ON_GPU, ("rlimits",))
    place = command.index("/dev/nvidia0")
    assert command[place - 1 : place + 4] == ["4", *NODES]
    assert "0" in command[: command.index("rlimits")]
    assert "4096" not in command
    assert {*GPU_FACTS} <= {*command}
    walls = bubblewrap.bubblewrap_options(gpu=True)
    after = walls.index("--dev")
    for node in NODES:
        place = walls.index(node)
        assert walls[place - 1 : place + 2] == ["--dev-bind-try", node, node]
        assert place > after, "the file system of devices would hide it"
    assert "--ro-bind-try" in walls[: walls.index("/sys/bus/pci")][-1:]


def test_the_environment_is_repeatable_and_shares_a_card(
    nodes: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    found = environment.environment("/x", gpu=True)
    assert found["JAX_PLATFORMS"] == "cuda"
    assert found["XLA_PYTHON_CLIENT_PREALLOCATE"] == "false"
    assert "--xla_gpu_deterministic_ops=true" in found["XLA_FLAGS"]
    assert environment.REPEATABLE["XLA_FLAGS"] in found["XLA_FLAGS"]
    assert "CUDA_VISIBLE_DEVICES" not in found
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "1")
    walls = bubblewrap.bubblewrap_options(gpu=True)
    assert walls[walls.index("CUDA_VISIBLE_DEVICES") + 1] == "1"


def test_a_worker_meant_for_a_gpu_starts_without_one(level: Isolation, case: Case) -> None:
    said = []
    for limits in (LIMITS, ON_GPU):
        with open_worker(level, limits) as worker:
            reply = worker.fit(PLAIN, case.trajectories, case.context)
            assert worker.device() == ""
            said.append(reply.output.split())
    assert said == [[str(4096 * 1024 * 1024), "cpu"], ["-1", "cuda"]]


@pytest.mark.slow
def test_jax_reports_its_device(level: Isolation, case: Case) -> None:
    source = "import jax\n" + PLAIN
    with open_worker(level, LIMITS, libraries=("jax",)) as worker:
        worker.fit(source, case.trajectories, case.context)
        assert worker.device() == "cpu cpu"


def test_the_reported_device_is_short_and_harmless(level: Isolation, case: Case) -> None:
    liar = """
import sys, types
class Device:
    platform, device_kind = "gpu\\x1b[2J", "H100 " * 1000
sys.modules["jax"] = types.SimpleNamespace(devices=lambda: [Device])
"""
    with open_worker(level, ON_GPU) as worker:
        worker.fit(liar + PLAIN, case.trajectories, case.context)
        said = worker.device()
    assert said.startswith("gpu")
    assert len(said) <= 100
    assert "\x1b" not in said


HUNGRY = PLAIN.replace(
    "    print(",
    "    import time\n    held = bytearray(600 * 1024 * 1024)\n    time.sleep(30)\n    print(",
)


@pytest.mark.slow
def test_a_worker_on_a_gpu_has_a_limit_on_its_memory(level: Isolation, case: Case) -> None:
    hungry = replace(ON_GPU, memory_mb=400)
    with open_worker(level, hungry) as worker, pytest.raises(CandidateError) as caught:
        worker.fit(HUNGRY, case.trajectories, case.context)
    assert caught.value.reason is Reason.MEMORY
    assert "more than 400 MB in memory" in caught.value.detail


def test_the_watch_looks_until_it_is_closed() -> None:
    assert 1_000_000 < resident_bytes(os.getpid()) < 10**12
    assert resident_bytes(None) == 0
    ended: list[int] = []
    ResourceWatch(lambda: 2, 1, lambda: ended.append(1), 9.0).close()
    watch = ResourceWatch(lambda: 2, 1, lambda: ended.append(2), 0.01)
    for _ in range(1000):
        if watch.exceeded and ended:
            break
        ctypes.CDLL(None).usleep(1000)
    assert ended == [2]


@pytest.mark.parametrize("machine", ["x86_64", "aarch64"])
def test_the_filter_allows_only_the_calls_of_the_driver(machine: str) -> None:
    def verdicts(*, devices: bool) -> dict[str, int]:
        program = list(struct.iter_unpack("@HBBI", seccomp.build(machine, 4321, devices=devices)))
        known = seccomp.numbers(machine)
        return {name: run(program, number, machine) for name, number in known.items()}

    plain, open_ = verdicts(devices=False), verdicts(devices=True)
    differ = {name for name in plain if plain[name] != open_[name]}
    assert differ == {name for name in seccomp._FOR_DEVICES if name in plain}
    assert all(open_[name] == 0x7FFF0000 for name in differ)
    for name in ("socket", "execve", "ptrace", "process_vm_readv", "mount"):
        assert open_[name] == plain[name] != 0x7FFF0000


def run(program: list[tuple[int, ...]], number: int, machine: str) -> int:
    """Run the filter on a call with strange arguments."""
    architecture = {"x86_64": 0xC000003E, "aarch64": 0xC00000B7}[machine]
    data = struct.pack("<iIQ6Q", number, architecture, 0, *([12345] * 6))
    place, value = 0, 0
    while True:
        operation, if_true, if_false, k = program[place]
        place += 1
        if operation == 0x20:
            (value,) = struct.unpack_from("<I", data, k)
        elif operation == 0x54:
            value &= k
        elif operation == 0x06:
            return k
        else:
            holds = {0x15: value == k, 0x25: value > k, 0x45: bool(value & k)}[operation]
            place += if_true if holds else if_false


def test_none_is_asked_for_or_none_is_there() -> None:
    assert chosen_gpu("cpu", Isolation.PROCESS) == ("", ())
    assert chosen_gpu("auto", Isolation.PROCESS) == ("", ())
    with pytest.raises(UserError, match="--device cuda: expected auto, cpu or gpu"):
        chosen_gpu("cuda", Isolation.PROCESS)
    with pytest.raises(UserError, match=r"no device node.*\.\[gpu\].*asia doctor"):
        chosen_gpu("gpu", Isolation.PROCESS)


@pytest.mark.slow
def test_nodes_that_jax_does_not_reach_are_refused_and_auto_does_without(
    level: Isolation, nodes: None
) -> None:
    with pytest.raises(SandboxError, match=f"JAX does not reach it at level {level}: .+"):
        gpu_here(level)
    with pytest.raises(UserError, match=r"--device gpu: JAX does not reach it.*\.\[gpu\]"):
        chosen_gpu("gpu", level)
    gpu, (words,) = chosen_gpu("auto", level)
    assert gpu == ""
    assert words.startswith("gpu: not used, JAX does not reach it")


def test_a_card_that_jax_reaches_is_used_and_its_isolation_is_described(
    nodes: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[Limits] = []

    class There:
        """Stand-in for a worker on a GPU."""

        def __enter__(self) -> "There":
            return self

        def __exit__(self, *raised: object) -> None: ...

        def fit(self, *given: object) -> object:
            return type("Reply", (), {"output": "a warning\nNVIDIA H100\n"})

    def open_there(level: Isolation, limits: Limits, **others: object) -> There:
        opened.append(limits)
        return There()

    monkeypatch.setattr(gpu_module, "open_worker", open_there)
    for asked in ("auto", "gpu"):
        gpu, (words,) = chosen_gpu(asked, Isolation.NAMESPACE)
        assert gpu == "NVIDIA H100"
        assert "reach its driver at level namespace" in words
    assert all(limits.gpu for limits in opened)
