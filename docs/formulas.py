"""Formulas of docstrings, set as such: ``y = r + discount Qbar_n(s', a')`` becomes MathML, which browsers draw alone.

What docstrings write: a product is a space, ``x_i`` and ``x_(t+1)`` are subscripts, ``x^2`` is a superscript, Greek
letters have their names, ``Qbar``, ``phat`` and ``h~`` are accents, ``<-`` an assignment and ``a ~ p`` a draw. What is
in brackets at a line's end, behind two spaces, is its label.

MkDocs calls ``on_page_markdown``.
"""

import re
from html import escape
from typing import Any

_GREEK = dict(
    zip(
        "alpha beta gamma delta epsilon eta theta kappa lambda mu pi rho sigma tau phi omega".split(),
        "αβγδεηθκλμπρστφω",
        strict=True,
    )
)
_ACCENTS = {"bar": "¯", "hat": "^"}
_BELOW = {"sum": "∑", "min": "min", "max": "max", "mean": "mean"}  # what stands below these is their range
_SIGNS = {"<-": "←", "<=": "≤", ">=": "≥", "*": "·", ".": "·", "...": "…"}
_SIGNS |= {"-": "\N{MINUS SIGN}", "~": "\N{TILDE OPERATOR}"}
_PRIME = "\N{PRIME}"
_UPRIGHT = ("log", "exp", "sin", "cos", "sinh", "cosh", "tanh", "sqrt", "clip", "softmax", "relu", "sg", "grad")
_TOKEN = re.compile(r"(\s*)(\d+(?:\.\d+)?|Gram-Schmidt|[A-Za-z]+\d*~?|\.\.\.|<-|<=|>=|'+|\S)")
_PROSE = 5  # words in a row that make a line a sentence


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Set the blocks of a page that hold formulas."""
    return re.sub(r"(?ms)^```text\n(.*?)\n```$", _set, markdown)


def _set(block: re.Match[str]) -> str:
    lines = block[1].splitlines()
    return display(lines) if is_formula(lines) else block[0]


def is_formula(lines: list[str]) -> bool:
    """Return whether lines are formulas and not sentences."""
    plain = (_label(line)[0] for line in lines)
    words = rf"(?:\b(?!(?:{'|'.join((*_UPRIGHT, *_GREEK, *_BELOW))})\b)[A-Za-z][a-z-]+[ ,]+){{{_PROSE}}}"
    return not any("``" in line or re.search(words, f"{line} ") for line in plain)


def display(lines: list[str]) -> str:
    """Return lines of formulas as HTML, each with its label."""
    rows = []
    for line in lines:
        formula, label = _label(line)
        beside = f"<span>{escape(label)}</span>" if label else ""
        rows.append(f'<div class="formula"><span>{to_mathml(formula)}</span>{beside}</div>')
    return "\n".join(rows)


def to_mathml(formula: str) -> str:
    """Return a formula as a MathML element, whose ``alttext`` is the formula as it was written."""
    text = formula.strip().rstrip(",.")
    inside = _Reader(text).sequence()
    return f'<math alttext="{escape(text)}"><mstyle displaystyle="true">{inside}</mstyle></math>'


def _label(line: str) -> tuple[str, str]:
    found = re.match(r"(.*?)\s{2,}\(([^=]*)\)$", line)
    return (found[1], found[2]) if found else (line, "")


class _Reader:
    """Reads the tokens of a formula, from left to right."""

    def __init__(self, formula: str):
        self.tokens = [(len(space), token) for space, token in _TOKEN.findall(formula)]
        self.at = 0

    def peek(self) -> str:
        """Return the next token if no space is before it."""
        return self.tokens[self.at][1] if self.at < len(self.tokens) and not self.tokens[self.at][0] else ""

    def sequence(self, end: str = "") -> str:
        """Return all up to a closing bracket, which is read and left out."""
        made, joins = "", False  # whether what comes next would touch what was last
        while self.at < len(self.tokens):
            space, token = self.tokens[self.at]
            if token == end:
                self.at += 1
                break
            angle = token == "<" and self.tokens[self.at + 1 :] and not self.tokens[self.at + 1][0]
            sign = not (token[0].isalnum() or token in "([{|" or angle)
            if joins and space and not sign:
                made += '<mspace width="0.25em"/>'
            elif space > 1 and made:
                made += '<mspace width="1em"/>'
            made, joins = made + self.item(), not sign or token in ")]}|"
        return f"<mrow>{made}</mrow>"

    def item(self) -> str:
        """Return the next token with what hangs on it: primes, subscripts and superscripts."""
        _, token = self.tokens[self.at]
        self.at += 1
        base, below = self.atom(token), ""
        if word := re.fullmatch(r"([A-Za-z])(\d+)", token):
            base, below = self.atom(word[1]), f"<mn>{word[2]}</mn>"
        above = ""
        while (mark := self.peek()) and (mark in "_^" or mark[0] == "'"):
            self.at += 1
            if mark == "_":
                below = self.script()
            elif mark == "^":
                above = self.script()
            else:
                base = f'<mrow>{base}<mo lspace="0" rspace="0">{len(mark) * _PRIME}</mo></mrow>'
        return _hung(base, below, above, under=token in _BELOW)

    def script(self) -> str:
        """Return what is raised or lowered: a bracket's inside, or one token with subscripts of its own."""
        _, token = self.tokens[self.at]
        self.at += 1
        if token in "({":
            return self.sequence(")" if token == "(" else "}")
        made = self.atom(token)
        if self.peek() == "_":
            self.at += 1
            return _hung(made, self.script(), "")
        return made

    def atom(self, token: str) -> str:
        """Return one token, or a bracket with its inside."""
        if token in "([" or (token == "<" and self.peek()):
            close = {"(": ")", "[": "]", "<": ">"}[token]
            left, right = ("⟨", "⟩") if token == "<" else (token, close)
            return f"<mrow>{_sign(left)}{self.sequence(close)}{_sign(right)}</mrow>"
        if token == "{":
            return self.sequence("}")
        if token == "sqrt" and self.peek() == "(":
            self.at += 1
            return f"<msqrt>{self.sequence(')')}</msqrt>"
        if token[0].isdigit():
            return f"<mn>{token}</mn>"
        return _word(token) if token[0].isalpha() else _sign(_SIGNS.get(token, token))


def _word(word: str) -> str:
    if word.endswith("~"):
        return f"<mover>{_word(word[:-1])}<mo>~</mo></mover>"
    for name, accent in _ACCENTS.items():
        letter = word.removesuffix(name)
        if letter != word and (letter in _GREEK or (len(letter) == 1 and word != "that")):
            return f"<mover>{_word(letter)}<mo>{accent}</mo></mover>"
    if word in _GREEK:
        return f"<mi>{_GREEK[word]}</mi>"
    if word in _BELOW:
        return f"<mo>{_BELOW[word]}</mo>"
    if word == "grad":
        return "<mo>∇</mo>"
    return f"<mi>{word}</mi>" if len(word) == 1 or word in _UPRIGHT else f"<mtext>{word}</mtext>"


def _sign(sign: str) -> str:
    return f'<mo stretchy="false">{escape(sign)}</mo>'


def _hung(base: str, below: str, above: str, under: bool = False) -> str:
    if below and above:
        return f"<msubsup>{base}{below}{above}</msubsup>"
    if below:
        tag = "munder" if under else "msub"
        return f"<{tag}>{base}{below}</{tag}>"
    return f"<msup>{base}{above}</msup>" if above else base
