"""The command `asia`, also `python -m asia`."""

import os


def main() -> None:
    """Run the command line with one thread of BLAS, unless the environment names a number.

    Matrices here are small: threads gain little, and on busy cores they wait for each other.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read when NumPy is loaded
    from asia.interfaces.cli import main as command_line

    command_line()


if __name__ == "__main__":
    main()
