"""A search in a job of a Slurm cluster of one node, this machine, by the script in the examples."""

import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from asia.errors import UserError
from asia.judge.executors import make_executor
from asia.ledger.run import open_run
from asia.ledger.verification import verify
from tests.unit.search.toy import write_problem

SCRIPT = Path(__file__).parents[4] / "examples/slurm/search.sbatch"
CONF = """
ClusterName=one
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={ports[0]}
SlurmdPort={ports[1]}
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
AuthInfo=socket={folder}/munge.sock
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
MpiDefault=none
ReturnToService=2
NodeName={host} NodeAddr=127.0.0.1 CPUs={cores} State=UNKNOWN
PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE State=UP
"""
MISSING = [name for name in ("munged", "slurmctld", "slurmd", "sbatch") if not shutil.which(name)]


@dataclass
class SlurmNode:
    """Daemons of a Slurm node, with files in a folder of their own."""

    folder: Path
    processes: list[subprocess.Popen[bytes]] = field(default_factory=list)

    @property
    def environment(self) -> dict[str, str]:
        """Variables with which its commands find it, and a job finds the commands of this
        Python."""
        path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
        return {**os.environ, "SLURM_CONF": str(self.folder / "slurm.conf"), "PATH": path}

    def start(self, *command: str) -> None:
        with (self.folder / f"{command[0]}.log").open("wb") as log:
            started = subprocess.Popen(command, stdout=log, stderr=log, env=self.environment)
        self.processes.append(started)

    def ready(self) -> bool:
        return self._ask("sinfo", "--noheader", "-o", "%t") == "idle"

    def jobs(self) -> str:
        """Those that wait or run."""
        return self._ask("squeue", "--noheader")

    def _ask(self, *command: str) -> str:
        found = subprocess.run(
            command, env=self.environment, capture_output=True, text=True, check=False
        )
        return found.stdout.strip()


@contextmanager
def one_node(folder: Path) -> Iterator[SlurmNode]:
    node = SlurmNode(folder)
    for name in ("state", "spool"):
        (folder / name).mkdir()
    key = folder / "munge.key"
    key.write_bytes(os.urandom(1024))
    key.chmod(0o400)
    with socket.create_server(("127.0.0.1", 0)) as one, socket.create_server(("", 0)) as other:
        ports = one.getsockname()[1], other.getsockname()[1]
    (folder / "slurm.conf").write_text(
        CONF.format(host=socket.gethostname(), ports=ports, folder=folder, cores=os.cpu_count())
    )
    try:
        node.start(
            "munged", "--force", "--foreground", "--key-file", str(key),
            "--socket", f"{folder}/munge.sock", "--pid-file", f"{folder}/munged.pid",
            "--log-file", f"{folder}/munged.txt", "--seed-file", f"{folder}/munge.seed",
        )  # fmt: skip
        end = time.monotonic() + 30.0
        while not (folder / "munge.sock").exists():
            assert time.monotonic() < end, "munged did not start"
            time.sleep(0.1)
        node.start("slurmctld", "-D")
        node.start("slurmd", "-D", "-N", socket.gethostname())
        while not node.ready():
            assert time.monotonic() < end, "slurm did not start"
            time.sleep(0.3)
        yield node
    finally:
        for process in reversed(node.processes):
            process.terminate()
            process.wait(30)


needs_slurm = pytest.mark.skipif(bool(MISSING), reason=f"not installed: {', '.join(MISSING)}")
needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="slurmd needs root")


@pytest.mark.slow
@needs_slurm
@needs_root
def test_a_job_of_slurm_runs_a_search(tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    folder = tmp_path / "slurm"
    folder.mkdir()
    write_problem(tmp_path / "toy", experiments=2)
    with one_node(folder) as node:
        words = ["toy", "--agent", "random", "--name", "job", "--parallel", "2"]
        done = subprocess.run(
            ["sbatch", "--wait", "--ntasks=2", "--mem-per-cpu=0", "-o", "job.txt", SCRIPT, *words],
            cwd=tmp_path, env=node.environment, check=False, timeout=300,
        )  # fmt: skip
        said = (tmp_path / "job.txt").read_text()
        assert done.returncode == 0, said
    check_run(tmp_path / "runs" / "job")
    assert not list(tmp_path.glob(".asia-scheduler-*")), said


@pytest.mark.long
@needs_slurm
@needs_root
def test_a_search_asks_slurm_for_its_workers(tmp_path: Path) -> None:
    pytest.importorskip("dask_jobqueue")
    folder = tmp_path / "slurm"
    folder.mkdir()
    write_problem(tmp_path / "toy", experiments=2)
    skipped = 'job_directives_skip = ["--mem"]'
    (tmp_path / "workers.toml").write_text(f'jobs = 2\nwalltime = "00:10:00"\n{skipped}\n')
    asia = Path(sys.executable).with_name("asia")
    words = ["toy", "--agent", "random", "--name", "asked", "--parallel", "2"]
    with one_node(folder) as node:
        done = subprocess.run(
            [asia, "run", *words, "--executor", "dask-slurm:workers.toml"],
            cwd=tmp_path, env=node.environment, check=False, timeout=300,
            capture_output=True, text=True,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        assert "waiting for the first worker" in done.stderr
        end = time.monotonic() + 60.0
        while node.jobs():
            assert time.monotonic() < end, "the jobs outlived the search"
            time.sleep(0.5)
    check_run(tmp_path / "runs" / "asked")


def check_run(directory: Path) -> None:
    verify(directory)
    finished = open_run(directory).view.finished
    assert len(finished) == 2
    machines = {fold.machine for e in finished if e.result for fold in e.result.folds}
    assert machines == {socket.gethostname()}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("jobs = 0", "jobs = 0: expected a number of Slurm jobs"),
        ("jobs = ", "workers.toml: "),
        ('colour = "red"', "colour"),
    ],
)
def test_wrong_settings_are_refused(tmp_path: Path, text: str, said: str) -> None:
    pytest.importorskip("dask_jobqueue")
    file = tmp_path / "workers.toml"
    file.write_text(text)
    with pytest.raises(UserError, match=said):
        make_executor(f"dask-slurm:{file}")
