"""Tools for the development of candidates in a workspace: the score as the evaluator computes it,
on any split of the training records, with residuals and parameters. `tools.py` in the folder calls
it.

Candidates run in the caller's own process, without a sandbox. No part of a search imports this
package.
"""

from asia.tools._command import main
from asia.tools._local import LocalFold, evaluate
from asia.tools._workspace import WorkspaceTools

__all__ = ["LocalFold", "WorkspaceTools", "evaluate", "main"]
