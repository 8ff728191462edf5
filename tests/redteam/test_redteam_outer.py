"""The outer sandbox, from inside: attacks run bare in it."""

import json
import socket
import subprocess

import pytest

from asia.judge.sandbox.layers.environment import (
    SYSTEM_FILES,
    code_folders,
    interpreter,
    interpreter_links,
)
from tests.redteam.outside.outer_sandbox import SUITE, outer_command, why_no_outer

KINDS = [
    pytest.param(nested, marks=pytest.mark.skipif(reason is not None, reason=str(reason)))
    for nested, reason in ((n, why_no_outer(nested=n)) for n in (False, True))
]
CODE = ["/usr", "/bin", "/sbin", "/lib", "/lib32", "/lib64"]
CODE += [place for _, place in code_folders()] + [str(place) for place in SUITE]
LOOK = """
import glob, json, os, socket, sys
known, port = json.loads(sys.argv[1]), int(sys.argv[2])
with socket.socket() as client:
    network = client.connect_ex(("127.0.0.1", port)) == 0
processes = [open(path, "rb").read().decode() for path in glob.glob("/proc/[0-9]*/cmdline")]
files = []
for folder, below, names in os.walk("/"):
    below[:] = [n for n in below if os.path.join(folder, n) not in (*known, "/proc", "/dev")]
    files += [os.path.join(folder, name) for name in names]
writable = [place for place in ("/", *known) if os.access(place, os.W_OK)]
print(json.dumps([network, socket.if_nameindex(), processes, files, writable]))
"""


@pytest.mark.parametrize("nested", KINDS)
def test_the_outer_sandbox_shows_nothing_but_the_code(nested, tmp_path):
    (tmp_path / "data.csv").write_text("u,y\n0,1\n")
    with socket.create_server(("127.0.0.1", 0)) as server:
        look = [interpreter(), "-I", "-c", LOOK, json.dumps(CODE), str(server.getsockname()[1])]
        done = subprocess.run(
            [*outer_command(nested), "--", *look], capture_output=True, check=True, env={}, cwd="/"
        )
    network, cards, processes, files, writable = json.loads(done.stdout)
    assert not network
    assert cards == [[1, "lo"]]
    assert len(processes) <= 3
    assert [line for line in processes if LOOK not in line] == []
    links = {place for _, place in interpreter_links()}
    links |= set(CODE)  # a single file of the suite
    assert [f for f in files if not f.startswith(SYSTEM_FILES) and f not in links] == []
    assert writable == []
