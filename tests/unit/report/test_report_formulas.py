"""Equations as MathML: the order that the person wrote, and no parenthesis lost."""

from __future__ import annotations

import re

import pytest

from asia.problem.physics import parse_expression
from asia.report.page.formulas import formula, symbol


def words(text: str) -> str:
    """The formula as a reader sees it, fractions as a / b, powers as a ^ b."""
    shown = str(formula(parse_expression(text, "test")))
    for name, sign in (("mfrac", "/"), ("msup", "^")):
        pattern = rf"<{name}><mrow>((?:(?!<{name}>).)*?)</mrow><mrow>(.*?)</mrow></{name}>"
        while re.search(pattern, shown):
            shown = re.sub(pattern, rf"{{\1 {sign} \2}}", shown, count=1)
    return re.sub(r"<[^>]+>", "", shown).replace("\N{INVISIBLE TIMES}", "")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a + b - c", "a+b−c"),
        ("a - (b - c)", "a−(b−c)"),
        ("a - (b + c)", "a−(b+c)"),
        ("a * (b + c)", "a(b+c)"),
        ("-(a + b)", "−(a+b)"),
        ("-a * b", "−ab"),
        ("(a + b) / c", "{a+b / c}"),
        ("(a + b)**2", "{(a+b) ^ 2}"),
        ("(-a)**2", "{(−a) ^ 2}"),
        ("a * 3", "a·3"),
        ("mass * speed", "mass·speed"),
        ("max(a, b)", "max(a,b)"),
        ("abs(a)", "|a|"),
    ],
)
def test_terms_keep_their_order_and_parentheses(text: str, expected: str) -> None:
    assert words(text) == expected


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("k1", "<msub><mi>k</mi><mn>1</mn></msub>"),
        ("x", "<mi>x</mi>"),
        ("theta", "<mi>θ</mi>"),
        ("omega2", "<msub><mi>ω</mi><mn>2</mn></msub>"),
        ("tau_h", "<msub><mi>τ</mi><mi>h</mi></msub>"),
        ("pump_voltage", '<mi mathvariant="normal">pump voltage</mi>'),
    ],
)
def test_names_are_typeset(name: str, expected: str) -> None:
    assert symbol(name) == expected
