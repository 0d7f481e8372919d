"""Expressions in Python's syntax over named columns, for filters of runs and conditions on training.

    status == "finished" and 400 < mean_return
    max(q[300]) > 20 and visits[300] >= 100

Python's parser reads them, a whitelist checks them, and they are never run as Python: a subclass of `Parser`
turns each part into a term of its own, such as a condition in SQL, or a function of arrays.
"""

from __future__ import annotations

import ast
import re
import warnings
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Final, Generic, TypeVar

from runner.errors import RunnerError, nearest

NUMBER: Final = "a number"
TEXT: Final = "text"
CONDITION: Final = "a condition"

Operation = type[ast.AST] | str
"""An operator of a syntax tree, or the name of a function."""

_CONTROL: Final = re.compile(r"[\x00-\x1f\x7f-\x9f\ud800-\udfff]")
"""Control characters and halves of surrogate pairs."""
_AROUND: Final = 500
"""How many characters before and after a mistake an error shows."""
_INSTEAD: Final[dict[type, str]] = {
    ast.BitAnd: " (write `and`)",
    ast.BitOr: " (write `or`)",
    ast.Invert: " (write `not`)",
}
"""What to write in place of an operator."""
_HINTS: Final = {
    "=": "equality is ==",
    "&": "write `and`",
    "|": "write `or`",
    "!": "write `not`, or !=",
    ":": "a text is put in quotes",
    "AND": "write `and`",
    "OR": "write `or`",
    "NOT": "write `not`",
}
"""What to write in place of a sign or a word that is no syntax."""
_OPPOSITE: Final[dict[type[ast.cmpop], type[ast.cmpop]]] = {
    ast.NotEq: ast.Eq,
    ast.NotIn: ast.In,
    ast.IsNot: ast.Is,
}


@dataclass(frozen=True)
class Term:
    """A part of an expression."""

    kind: str
    """`NUMBER`, `CONDITION`, `TEXT`, or another kind as an error calls it."""


Part = TypeVar("Part", bound=Term)


class Parser(ABC, Generic[Part]):
    """Parses one expression."""

    what: ClassVar[str]
    """What an error calls the expression."""
    example: ClassVar[str]
    max_length: ClassVar[int]
    max_nodes: ClassVar[int]
    """The most nodes of the syntax tree."""
    max_number: ClassVar[float]
    operations: ClassVar[Mapping[Operation, Any]]
    """The operators and functions over numbers and conditions, by what makes a term of them."""
    expected: ClassVar[str]
    """The operators and functions, for errors."""
    not_numbers: ClassVar[Mapping[str, str]] = {}
    """What an error expects in place of terms of other kinds."""
    needed: ClassVar[str] = ""
    """What an expression must have, for errors; empty if it may be constant."""

    def __init__(self, text: str) -> None:
        self.text = re.sub(r"\s", " ", text).strip()
        self.is_constant = True
        if len(self.text) > self.max_length:
            raise RunnerError(
                f"{self.what}: found {len(self.text):,} characters, expected {self.max_length:,} at most."
            )
        if not self.text or _CONTROL.search(self.text):
            raise RunnerError(f"{self.what}: found {self.text[:100]!r}, expected one such as {self.example}.")

    @abstractmethod
    def named(self, node: ast.expr) -> Part:
        """Return the term that a name, an attribute or a subscript stands for."""

    @abstractmethod
    def fixed(self, kind: str, value: float | str) -> Part:
        """Return the term of a `NUMBER`, a `TEXT`, or a `CONDITION`, which is True or False."""

    @abstractmethod
    def applied(self, kind: str, operation: Operation, *parts: Part) -> Part:
        """Return the term of an operation on one or two terms."""

    def compared(self, node: ast.Compare, left: ast.expr, operator: type[ast.cmpop], right: ast.expr) -> Part:
        """Return the condition that compares two neighbours in a chain, here numbers; not `!=`."""
        if operator not in self.operations:
            raise self.error(node, "found `in` or `is`, expected one of < <= > >= == !=.")
        return self.applied(CONDITION, operator, self.number(left), self.number(right))

    def whole(self, kind: str = CONDITION) -> Part:
        """Return the term of the whole expression, a `CONDITION` or a `NUMBER`.

        Raises:
            RunnerError: it is none, or too large; a line marks the place.
        """
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                tree = ast.parse(self.text, mode="eval").body
            nodes = sum(1 for _ in ast.walk(tree))
            if nodes > self.max_nodes:
                raise RunnerError(f"{self.what}: has {nodes:,} parts, expected {self.max_nodes:,} at most.")
            term = self.condition(tree) if kind == CONDITION else self.number(tree)
        except SyntaxError as error:
            raise self.syntax_error(error) from None
        except (MemoryError, RecursionError):
            raise RunnerError(f"{self.what}: is nested too deeply.") from None
        if self.needed and self.is_constant:
            raise RunnerError(f"{self.what}: found {self.text}, expected {self.needed}.")
        return term

    # --- errors -----------------------------------------------------------------------------------------

    def syntax_error(self, error: SyntaxError) -> RunnerError:
        """Return the error for a text that is no syntax."""
        at = (error.offset or len(self.text)) - 1
        hints = [f" ({hint})" for sign, hint in _HINTS.items() if self.text.startswith(sign, at)]
        return self.marked(at, 1, error.msg + "".join(hints))

    def error(self, node: ast.expr, message: str) -> RunnerError:
        """Return the error that marks a node in the expression."""
        return RunnerError(f"{self.what}: {message}{self.lines_of(node)}")

    def marked(self, start: int, length: int, message: str) -> RunnerError:
        """Return the error that marks a place in the expression."""
        return RunnerError(f"{self.what}: {message}{self._lines(start, length)}")

    def lines_of(self, node: ast.expr) -> str:
        """Return the lines with which an error shows the expression, and marks a node in it."""
        before = self.text.encode()[: node.col_offset].decode()  # the parser counts bytes
        return self._lines(len(before), len(self.text_of(node)))

    def _lines(self, start: int, length: int) -> str:
        first = max(0, start - _AROUND)
        line = self.text[first : start + _AROUND]
        marks = "^" * min(length, _AROUND)
        return f"\n  {line}\n  {' ' * (start - first)}{marks}"

    def text_of(self, node: ast.expr) -> str:
        """Return a node's own text."""
        return ast.get_source_segment(self.text, node) or ""

    # --- terms ------------------------------------------------------------------------------------------

    def condition(self, node: ast.expr) -> Part:
        """Return the term of a condition."""
        term = self.term(node)
        if term.kind != CONDITION:
            raise self.error(
                node, f"found {term.kind}, expected a condition, such as a comparison with > or ==."
            )
        return term

    def number(self, node: ast.expr) -> Part:
        """Return the term of a number; a condition counts as 0 or 1."""
        term = self.term(node)
        if term.kind not in (NUMBER, CONDITION):
            raise self.error(node, f"found {term.kind}, expected {self.not_numbers.get(term.kind, NUMBER)}.")
        return term

    def term(self, node: ast.expr) -> Part:  # noqa: PLR0911 - one line a kind
        """Return the term of a node."""
        match node:
            case ast.BoolOp():
                return self.joined(CONDITION, type(node.op), list(map(self.condition, node.values)))
            case ast.UnaryOp(op=ast.Not()):
                return self.applied(CONDITION, ast.Not, self.condition(node.operand))
            case ast.UnaryOp() if type(node.op) in self.operations:
                return self.applied(NUMBER, type(node.op), self.number(node.operand))
            case ast.BinOp() if type(node.op) in self.operations:
                return self.applied(NUMBER, type(node.op), self.number(node.left), self.number(node.right))
            case ast.Compare():
                operands = [node.left, *node.comparators]
                pairs = zip(operands, map(type, node.ops), operands[1:], strict=False)
                return self.joined(CONDITION, ast.And, [self._pair(node, *pair) for pair in pairs])
            case ast.Call():
                return self.call(node, node.func.id if isinstance(node.func, ast.Name) else "")
            case ast.Constant():
                return self.constant(node)
            case ast.Name() | ast.Attribute() | ast.Subscript():
                self.is_constant = False
                return self.named(node)
        hint = _INSTEAD.get(type(getattr(node, "op", None)), "")
        raise self.error(node, f"found {self.text_of(node)[:60]}{hint}, {self.expected}.")

    def joined(self, kind: str, operation: Operation, parts: Sequence[Part]) -> Part:
        """Return an operation on one or more terms, in pairs, so that many of them do not nest deeply."""
        if len(parts) == 1:
            return parts[0]
        middle = len(parts) // 2
        halves = (self.joined(kind, operation, half) for half in (parts[:middle], parts[middle:]))
        return self.applied(kind, operation, *halves)

    def _pair(self, node: ast.Compare, left: ast.expr, operator: type[ast.cmpop], right: ast.expr) -> Part:
        if operator in _OPPOSITE:
            return self.applied(CONDITION, ast.Not, self._pair(node, left, _OPPOSITE[operator], right))
        if operator is ast.In and isinstance(right, ast.Tuple | ast.List) and right.elts:
            equal = [self.compared(node, left, ast.Eq, value) for value in right.elts]
            return self.joined(CONDITION, ast.Or, equal)
        return self.compared(node, left, operator, right)

    def call(self, node: ast.Call, name: str) -> Part:
        """Return the term of a call of a function."""
        if name not in self.operations:
            hint = nearest(name, [key for key in self.operations if isinstance(key, str)])
            raise self.error(node.func, f"found a call, {self.expected}.{hint}")
        if node.keywords or not node.args or (name == "abs") != (len(node.args) == 1):
            values = "one value" if name == "abs" else "values, separated by commas"
            raise self.error(node, f"expected {name}() of {values}.")
        numbers = list(map(self.number, node.args))
        return self.applied(NUMBER, name, *numbers) if name == "abs" else self.joined(NUMBER, name, numbers)

    def constant(self, node: ast.Constant) -> Part:
        """Return the term of a number, a text, of True or of False."""
        value = node.value
        if not isinstance(value, int | float | str):
            raise self.error(node, f"found {self.text_of(node)}, expected a number.")
        if not isinstance(value, str) and not abs(value) <= self.max_number:
            raise self.error(node, "found a number that is too large.")
        return self.fixed({bool: CONDITION, str: TEXT}.get(type(value), NUMBER), value)

    def numbered(self, node: ast.expr, names: Sequence[str], what: str) -> int:
        """Return the number that a number or a name stands for, among names in any spelling.

        Args:
            what: what has these names, for errors: a `state` or an `action`.
        """
        value = node.value if isinstance(node, ast.Constant) else None
        if type(value) is int and value < len(names):
            return value
        if not isinstance(value, str):
            raise self.error(
                node,
                f"found {what} {self.text_of(node)}, expected one of 0 to {len(names) - 1}, or its name.",
            )
        wanted = spelt(value)
        named = [k for k, name in enumerate(names) if name == value]
        named = named or [k for k, name in enumerate(names) if spelt(name) == wanted]
        if len(named) == 1:
            return named[0]
        if named:
            raise self.error(node, f"found a name of {len(named)} {what}s, expected a number.")
        parts = names[0].count(" + ") + 1
        hint = nearest(value, names) or nearest(" + ".join([value] * parts), names)
        raise self.error(
            node,
            f"found {what} {value[:60]!r}, expected one of {len(names):,}, by number or by name, such as "
            f"{names[0]!r}.{hint}",
        )


def spelt(name: str) -> str:
    """Return a name in one spelling: `drop-off` and `drop_off`, `q[1]` and `q_1` are alike."""
    return re.sub(r"(?:[^\w-]|_)+|(?<=\w)-(?=[a-z])", "_", name).strip("_")
