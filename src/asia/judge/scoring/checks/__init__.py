"""Validation report: the checks of a model before its use.

Every check is a function of arrays: measured and simulated outputs, or answers of a simulator. A
residual is judged by the share that regressors explain significantly, corrected for its own
correlation, and only where that share is large enough to matter."""
