"""Server of a language model on this machine, which ASIA starts and stops itself."""

import hashlib
import json
import os
import subprocess
import sys
import tempfile
import urllib.request
from pathlib import Path
from typing import Any

from asia._plugins import is_installed, library, version_of
from asia.errors import UserError

_SAMPLER = (
    "temperature", "top_k", "top_p", "min_p", "typical_p", "top_n_sigma", "repeat_penalty",
    "presence_penalty", "frequency_penalty", "dry_multiplier", "xtc_probability", "mirostat",
    "samplers",
)  # fmt: skip


class LocalServer:
    """llama.cpp on loopback, in a process of its own that ends with this one.

    One request at a time, no reuse of earlier prompts and a fixed number of threads, so that the
    same request has the same answer.

    Args:
        weights: GGUF file
        context: tokens of request and reply; 0 for what the model was trained with

    Attributes:
        url: base URL of the OpenAI-compatible interface
        facts: what determines the answers: digests of weights and chat template, default sampler,
            version, context and threads

    Raises:
        UserError: without the extra `local`, and for a file that cannot be loaded
    """

    def __init__(self, weights: Path, context: int = 0) -> None:
        if not is_installed("xllamacpp"):
            raise UserError(
                "--local needs the package xllamacpp: pip install '.[local]' in a clone of ASIA"
            )
        if not weights.is_file():
            raise UserError(f"--local {weights}: no such file; expected a model in GGUF")
        threads = max(1, (os.cpu_count() or 1) // 2)
        words = [sys.executable, "-P", __file__, str(weights), str(context), str(threads)]
        with tempfile.TemporaryFile() as log:
            pipe = subprocess.PIPE
            self._process = subprocess.Popen(words, stdin=pipe, stdout=pipe, stderr=log)
            assert self._process.stdout is not None
            address = self._process.stdout.readline().decode().strip()
            if not address:
                self.close()
                log.seek(0)
                lines = log.read().decode("utf-8", "replace").strip().splitlines() or ["no message"]
                raise UserError(
                    f"--local {weights}: the server did not start: {lines[-1][:300]}; expected a "
                    "model in GGUF that fits into memory"
                )
        self.url = f"{address}/v1"
        # Never through a proxy.
        opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
        with opener.open(f"{address}/props", timeout=60.0) as answer:
            props: Any = json.load(answer)
        sampler = props["default_generation_settings"]["params"]
        with weights.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        self.facts: dict[str, Any] = {
            "file": weights.name,
            "sha256": digest,
            "template_sha256": hashlib.sha256(props["chat_template"].encode()).hexdigest(),
            "sampler": {name: sampler[name] for name in _SAMPLER if name in sampler},
            "server": f"xllamacpp {version_of('xllamacpp')}",
            "context": props["default_generation_settings"]["n_ctx"],
            "threads": threads,
        }

    def close(self) -> None:
        """End the server."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.close()
        self._process.stdout.close()
        try:
            self._process.wait(10.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def _serve(weights: str, context: int, threads: int) -> None:
    """Print the address and serve until the standard input ends."""
    xllamacpp: Any = library("xllamacpp")

    params: Any = xllamacpp.CommonParams()
    params.model.path = weights
    params.n_ctx, params.n_parallel = context, 1
    params.cache_prompt, params.cache_ram_mib, params.ui = False, 0, False
    params.cpuparams.n_threads = params.cpuparams_batch.n_threads = threads
    params.verbosity = 1
    server: Any = xllamacpp.Server(params)
    sys.stdout.buffer.write(f"{server.listening_address}\n".encode())
    sys.stdout.buffer.flush()
    sys.stdin.buffer.read()
    os._exit(0)


if __name__ == "__main__":
    _serve(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))
