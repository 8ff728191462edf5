"""Workers of a Dask cluster as jobs of Slurm, which are given back when the command ends."""

from __future__ import annotations

import importlib
import importlib.util
import os
import sys
import time
import tomllib
from inspect import signature
from pathlib import Path
from typing import Any

from asia._text import say, suggestion
from asia.errors import UserError
from asia.judge.executors.dask import DaskExecutor

_POLL_SECONDS = 0.2
# A worker that has lost its search ends by then.
_DEATH_SECONDS = 60


class SlurmExecutor(DaskExecutor):
    """Folds on workers that Slurm starts.

    Raises:
        UserError: without the extra `slurm`, where a setting is wrong, and where Slurm takes no
            job
    """

    def __init__(self, file: Path | None) -> None:
        """Start the workers and return once the first one is ready.

        Args:
            file: a TOML file, `jobs` and arguments of `dask_jobqueue.SLURMCluster`; None for
                four jobs of one core and 5 GB each
        """
        for name in ("distributed", "dask_jobqueue"):
            if importlib.util.find_spec(name) is None:
                raise UserError(
                    f"--executor dask-slurm needs the package {name.replace('_', '-')}: "
                    "pip install '.[slurm]' in a clone of ASIA"
                )
        given: dict[str, Any] = {}
        try:
            given = {} if file is None else tomllib.loads(file.read_text("utf-8"))
        except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
            raise UserError(
                f"--executor dask-slurm:{file}: {getattr(error, 'strerror', None) or error}; "
                'expected a TOML file such as jobs = 8, memory = "5GB", walltime = "08:00:00"'
            ) from None
        jobs = given.pop("jobs", 4)
        if not isinstance(jobs, int) or jobs < 1:
            raise UserError(f"{file}: jobs = {jobs!r}: expected a number of Slurm jobs, 1 or more")
        settings = {"cores": 1, "processes": 1, "memory": "5GB"}
        # Kept: its jobs end with it.
        self._cluster: Any = _cluster(settings | given, file)
        _started(self._cluster, jobs)
        super().__init__(self._cluster.scheduler_address)

    def close(self) -> None:
        """Leave the cluster, and end its jobs."""
        super().close()
        self._cluster.close()


def _cluster(settings: dict[str, Any], file: Path | None) -> Any:
    make: Any = importlib.import_module("dask_jobqueue").SLURMCluster
    core: Any = importlib.import_module("dask_jobqueue.core")
    taken = (make.job_cls.__init__, core.Job.__init__, core.JobQueueCluster.__init__)
    known = {name for function in taken for name in signature(function).parameters}
    for name in settings.keys() - known:
        raise UserError(
            f"--executor dask-slurm:{file}: there is no setting '{name}'"
            f"{suggestion(name, sorted(known))}: expected jobs and arguments of "
            "dask_jobqueue.SLURMCluster, such as queue, account, cores, memory, walltime"
        )
    fixed = {"nanny": False, "death_timeout": _DEATH_SECONDS, "python": sys.executable}
    return make(**(fixed | settings))


def _started(cluster: Any, jobs: int) -> None:
    say(f"slurm    asked for {jobs} jobs; waiting for the first worker", file=sys.stderr)
    try:
        cluster.scale(jobs=jobs)
        while not cluster.scheduler_info["workers"]:
            if str(cluster.status) == "Status.failed":
                raise OSError("the cluster has failed")
            time.sleep(_POLL_SECONDS)
    except (OSError, RuntimeError) as error:
        cluster.close()
        raise UserError(
            f"--executor dask-slurm: Slurm takes no job ({error}): try 'sbatch --version' and "
            f"'sinfo' here, in {os.getcwd()}"
        ) from None
    except BaseException:
        cluster.close()
        raise
