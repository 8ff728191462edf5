"""python -m asia.search DIRECTORY: the process behind a workspace or a server."""

import sys
from pathlib import Path

from asia.errors import UserError
from asia.report import write_report
from asia.search._serve import serve

if __name__ == "__main__":
    try:
        serve(Path(sys.argv[1]))
    except UserError as error:
        sys.exit(f"asia: {error}")
    write_report(Path(sys.argv[1]))
