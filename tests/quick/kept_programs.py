"""Programs that workers of the sandbox compile for the library, kept in a folder for other
processes and later runs. Results of the library are not kept: their keys do not hold its code."""

import os
import threading
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from types import ModuleType

FOLDER = "ASIA_TEST_PROGRAMS"


def keep_programs(module: ModuleType) -> None:
    """Let the store of this process use the folder that the environment names.

    Args:
        module: `asia.judge.sandbox.programs`
    """
    if FOLDER not in os.environ:
        return
    folder = Path(os.environ[FOLDER])

    class Kept(module.ProgramStore):
        def get(self, key: str) -> bytes | None:
            found = super().get(key)
            if found is None and key.startswith("jit_") and (folder / key).is_file():
                found = (folder / key).read_bytes()
                super().add({key: found})
            return found

        def add(self, programs: Mapping[str, bytes]) -> None:
            super().add(programs)
            for key, program in programs.items():
                if key.startswith("jit_") and not (folder / key).exists():
                    new = folder / f"{key}.{os.getpid()}-{threading.get_ident()}"
                    with suppress(OSError):  # the process may not write there
                        new.write_bytes(program)
                        new.replace(folder / key)

    module.program_store().__class__ = Kept
