"""Lessons: what moves brought in earlier searches, as a prior over the moves of this one."""

from asia.agents._lesson import FIRST_FIT, Lesson, merge
from asia.agents.lessons.learn import kind_of, learn
from asia.agents.lessons.notebook import (
    FOLDER_VARIABLE,
    decode_lessons,
    encode_lessons,
    forget_lessons,
    keep_lessons,
    kept_lessons,
    notebook_path,
    shipped_lessons,
)
from asia.agents.lessons.summary import Summary, summaries, summary_lines
from asia.agents.lessons.weights import LessonWeights

__all__ = [
    "FIRST_FIT",
    "FOLDER_VARIABLE",
    "Lesson",
    "LessonWeights",
    "Summary",
    "decode_lessons",
    "encode_lessons",
    "forget_lessons",
    "keep_lessons",
    "kept_lessons",
    "kind_of",
    "learn",
    "merge",
    "notebook_path",
    "shipped_lessons",
    "summaries",
    "summary_lines",
]
