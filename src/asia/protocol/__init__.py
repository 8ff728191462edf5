"""How a search is judged: folds, past windows, normalisation. The sealed test has one opener."""

from asia.protocol._folds import Block, Case, Fold, cut, make_folds, whole

__all__ = ["Block", "Case", "Fold", "cut", "make_folds", "whole"]
