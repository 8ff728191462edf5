"""python -m asia.interfaces.workspace DIRECTORY: the process behind a workspace or a server."""

import signal
import sys
from pathlib import Path

from asia.errors import UserError
from asia.interfaces.workspace.process import attending, serve
from asia.report.files import write_report

if __name__ == "__main__":
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    directory = Path(sys.argv[1])
    # Hold until the pictures are drawn: a process that waits for the end draws the same ones.
    with attending(directory):
        try:
            serve(directory)
        except UserError as error:
            sys.exit(f"asia: {error}")
        write_report(directory)
