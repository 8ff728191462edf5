"""Programs that JAX compiles for the tests: made cheaply, and kept for the next run."""

import os
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory

import jax

CHEAP = "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"
_WEEK = 7 * 24 * 3600.0


def compile_cheaply() -> None:
    """For this process and those it starts, before anything is compiled: programs of tests run for
    milliseconds, and their compilation takes seconds. Workers of the sandbox compile as always."""
    os.environ["XLA_FLAGS"] = f"{CHEAP} {os.environ.get('XLA_FLAGS', '')}".strip()


@contextmanager
def kept(shared: Path) -> Iterator[None]:
    """Compiled programs are taken from the folder `shared`, and new ones are put there at the end.

    JAX writes its files in place, so each process has a folder of its own in the meantime.
    """
    shared.mkdir(parents=True, exist_ok=True)
    for left in shared.parent.glob(f"{shared.name}-*"):  # by a run that was killed
        with suppress(FileNotFoundError):
            if time.time() - left.stat().st_mtime > _WEEK:
                shutil.rmtree(left, ignore_errors=True)
    with TemporaryDirectory(prefix=f"{shared.name}-", dir=shared.parent) as name:
        own = Path(name)
        for program in shared.iterdir():
            with suppress(FileNotFoundError):  # another process may have dropped it
                if time.time() - program.stat().st_mtime < _WEEK:
                    shutil.copyfile(program, own / program.name)
                else:
                    program.unlink()
        given = set(os.listdir(own))
        jax.config.update("jax_compilation_cache_dir", name)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        # The folder would be a part of every key.
        jax.config.update("jax_persistent_cache_enable_xla_caches", "none")
        yield
        jax.config.update("jax_compilation_cache_dir", None)
        for new in set(os.listdir(own)) - given:
            os.replace(own / new, shared / new)
