"""Expressions over quantities that change in training, parsed by Python's parser with a whitelist.

    q[300, "north + east"] > q[300, "west + east"] and visits[300] >= 100

They are never evaluated as Python: each becomes a tree of NumPy operations over columns, a column for each
quantity, a row for each moment. All numbers are float64, so a division by zero is infinite or NaN.
"""

from __future__ import annotations

import ast
import functools
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from runner.environments.naming import spoken
from runner.errors import RunnerError, nearest

MAX_CHARACTERS: Final = 1_000
MAX_NODES: Final = 300
"""The most nodes of a syntax tree."""
MAX_NUMBER: Final = 2**53
"""Numbers up to it are exact as float64."""

Array = NDArray[Any]
"""Numbers as float64, conditions as bool."""
Columns = Mapping[Any, Array]
"""The values of each quantity, [moments]; those of a row [moments, values]."""
Evaluate = Callable[[Columns], Array]

_ARITHMETIC: Final[dict[type[ast.operator], np.ufunc]] = {
    ast.Add: np.add,
    ast.Sub: np.subtract,
    ast.Mult: np.multiply,
    ast.Div: np.divide,
    ast.FloorDiv: np.floor_divide,
    ast.Mod: np.remainder,
}
_COMPARISONS: Final[dict[type[ast.cmpop], np.ufunc]] = {
    ast.Lt: np.less,
    ast.LtE: np.less_equal,
    ast.Gt: np.greater,
    ast.GtE: np.greater_equal,
    ast.Eq: np.equal,
    ast.NotEq: np.not_equal,
}
_REFUSED: Final[dict[type[ast.operator], str]] = {
    ast.Pow: "**",
    ast.MatMult: "@",
    ast.LShift: "<<",
    ast.RShift: ">>",
    ast.BitAnd: "& (write `and`)",
    ast.BitOr: "| (write `or`)",
    ast.BitXor: "^",
}
_HINTS: Final = {"=": "equality is ==", "&": "write `and`", "|": "write `or`", "!": "write `not`, or !="}
"""What to write in place of a sign that is no syntax."""
_CALLED: Final[dict[type[ast.expr], str]] = {
    ast.Lambda: "lambda",
    ast.IfExp: "if ... else",
    ast.NamedExpr: ":=",
    ast.Starred: "*",
    ast.JoinedStr: "an f-string",
    ast.List: "a list",
    ast.Tuple: "several values",
    ast.Set: "a set",
    ast.Dict: "a dictionary",
    ast.Slice: "a slice",
}
"""What people call a kind of node."""
_EXPECTED: Final = "expected comparisons, and, or, not, + - * / // %, max(), min() and abs()"


@dataclass(frozen=True)
class Term:
    """A part of an expression, which has a value at each moment."""

    kind: Literal["number", "condition", "row", "action"]
    """A row is several numbers, of which max() and min() are taken; an action is only equal, or not."""
    evaluate: Evaluate
    names: Sequence[str] = ()
    """The names of its values, if they are actions."""
    is_whole: bool = False
    """Whether its values are whole numbers."""
    text: str = ""
    """The part's own text."""


@dataclass(frozen=True)
class Expression:
    """A condition."""

    text: str
    condition: Term
    terms: tuple[Term, ...]
    """The quantities in it, and the conditions that it combines: what explains its value."""


Resolve = Callable[["Parser", ast.expr], Term]
"""Return the quantity that a name, an attribute or a subscript stands for."""


class Parser:
    """Parses one expression."""

    def __init__(self, text: str, resolve: Resolve) -> None:
        self.text = " ".join(text.split("\n")).strip()
        self._resolve = resolve
        self._quantities: dict[str, Term] = {}
        self._conditions: dict[str, Term] = {}

    def parse(self) -> Expression:
        """Return the parsed expression.

        Raises:
            RunnerError: it is no condition over quantities, or too large; a line marks the place.
        """
        condition = self._condition(self._tree())
        if not self._quantities:
            raise RunnerError(f"expression: found {self.text}, expected a quantity in it that changes.")
        parts = self._conditions if len(self._conditions) > 1 else {}
        return Expression(self.text, condition, tuple((self._quantities | parts).values()))

    def error(self, node: ast.expr, message: str) -> RunnerError:
        """Return the error that marks a node in the expression."""
        return self._error(*self._span(node), message)

    def text_of(self, node: ast.expr) -> str:
        """Return a node's own text."""
        return self.text[slice(*self._span(node))]

    # --- the tree ---------------------------------------------------------------------------------------

    def _tree(self) -> ast.expr:
        if len(self.text) > MAX_CHARACTERS:
            raise RunnerError(
                f"expression: found {len(self.text):,} characters, expected {MAX_CHARACTERS:,} at most."
            )
        if not self.text.isprintable() or not self.text:
            raise RunnerError(f"expression: found {self.text!r}, expected one such as max(q[300]) > 20.")
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                tree = ast.parse(self.text, mode="eval").body
        except SyntaxError as error:
            at = min(max((error.offset or 1) - 1, 0), len(self.text) - 1)
            hint = _HINTS.get(self.text[at])
            raise self._error(at, at + 1, f"{error.msg} ({hint})" if hint else error.msg) from None
        except (MemoryError, RecursionError, ValueError):
            raise RunnerError("expression: is nested too deeply.") from None
        nodes = sum(1 for _ in ast.walk(tree))
        if nodes > MAX_NODES:
            raise RunnerError(f"expression: has {nodes:,} parts, expected {MAX_NODES} at most.")
        return tree

    def _span(self, node: ast.expr) -> tuple[int, int]:
        """Return where the text of a node begins and ends, in characters; the parser counts bytes."""
        data = self.text.encode()
        return len(data[: node.col_offset].decode()), len(data[: node.end_col_offset].decode())

    def _error(self, start: int, end: int, message: str) -> RunnerError:
        marks = " " * start + "^" * max(end - start, 1)
        return RunnerError(f"expression: {message}\n  {self.text}\n  {marks}")

    # --- terms ------------------------------------------------------------------------------------------

    def _condition(self, node: ast.expr) -> Term:
        term = self._term(node)
        if term.kind != "condition":
            kind = "an action" if term.kind == "action" else "a number"
            raise self.error(node, f"found {kind}, expected a condition, such as a comparison with > or ==.")
        return term

    def _number(self, node: ast.expr) -> Evaluate:
        """Return what evaluates a number; a condition counts as 0 or 1."""
        term = self._term(node)
        if term.kind == "row":
            raise self.error(
                node, "found the values of all actions, expected one, or max() or min() of them."
            )
        if term.kind == "action":
            raise self.error(
                node, "found an action, expected a number; an action is compared, with == or !=, to its name."
            )
        return lambda columns: np.asarray(term.evaluate(columns), np.float64)

    def _term(self, node: ast.expr) -> Term:  # noqa: PLR0911 - one line a kind
        match node:
            case ast.BoolOp():
                return self._combined(node)
            case ast.UnaryOp():
                return self._unary(node)
            case ast.BinOp():
                return self._binary(node)
            case ast.Compare():
                return self._comparison(node)
            case ast.Call():
                return self._call(node)
            case ast.Constant():
                return self._constant(node)
            case ast.Name() | ast.Attribute() | ast.Subscript():
                term = self._resolve(self, node)
                return self._seen(term, node) if term.kind != "row" else term
        called = _CALLED.get(type(node), "Python that is not allowed here")
        raise self.error(node, f"found {called}, {_EXPECTED}.")

    def _seen(self, term: Term, node: ast.expr) -> Term:
        text = self.text_of(node)
        term = Term(term.kind, term.evaluate, term.names, term.is_whole, text)
        self._quantities.setdefault(text, term)
        return term

    def _combined(self, node: ast.BoolOp) -> Term:
        combine = np.logical_and if isinstance(node.op, ast.And) else np.logical_or
        return _reduced("condition", combine, [self._condition(value).evaluate for value in node.values])

    def _unary(self, node: ast.UnaryOp) -> Term:
        if isinstance(node.op, ast.Not):
            negated = self._condition(node.operand).evaluate
            return Term("condition", lambda columns: np.logical_not(negated(columns)))
        if isinstance(node.op, ast.Invert):
            raise self.error(node, f"found ~ (write `not`), {_EXPECTED}.")
        sign = -1.0 if isinstance(node.op, ast.USub) else 1.0
        value = self._number(node.operand)
        return Term("number", lambda columns: sign * value(columns))

    def _binary(self, node: ast.BinOp) -> Term:
        operation = _ARITHMETIC.get(type(node.op))
        if operation is None:
            raise self.error(node, f"found the operator {_REFUSED[type(node.op)]}, {_EXPECTED}.")
        return _reduced("number", operation, [self._number(node.left), self._number(node.right)])

    def _comparison(self, node: ast.Compare) -> Term:
        nodes = [node.left, *node.comparators]
        terms = [None if _is_text(each) else self._term(each) for each in nodes]
        names = [() if term is None else term.names for term in terms]
        values = []
        for k, (each, term) in enumerate(zip(nodes, terms, strict=True)):
            near = next(filter(None, names[max(k - 1, 0) : k + 2]), ())
            if not near:
                values.append(self._number(each))
            elif term is None or not term.names:
                values.append(_fixed(self.number_of(each, near, "action")).evaluate)
            elif term.names != near:
                raise self.error(node, "found a joint action and one agent's, which are not comparable.")
            else:
                values.append(term.evaluate)
        compare = []
        for k, operator in enumerate(node.ops):
            if type(operator) not in _COMPARISONS:
                raise self.error(node, "found `in` or `is`, expected one of < <= > >= == !=.")
            if any(names[k : k + 2]) and not isinstance(operator, ast.Eq | ast.NotEq):
                raise self.error(node, "found an order of actions, expected == or !=.")
            compare.append(_COMPARISONS[type(operator)])

        def evaluate(columns: Columns) -> Array:
            numbers = [value(columns) for value in values]
            pairs = zip(compare, numbers, numbers[1:], strict=False)
            return functools.reduce(np.logical_and, [each(a, b) for each, a, b in pairs])

        text = self.text_of(node)
        return self._conditions.setdefault(text, Term("condition", evaluate, text=text))

    def _call(self, node: ast.Call) -> Term:
        name = node.func.id if isinstance(node.func, ast.Name) else ""
        if name not in ("max", "min", "abs"):
            hint = nearest(name, ["max", "min", "abs"]) if name else ""
            raise self.error(node.func, f"found a call, expected max(), min() or abs().{hint}")
        if node.keywords or not node.args:
            raise self.error(node, f"expected {name}() of values, separated by commas.")
        if name == "abs":
            if len(node.args) > 1:
                raise self.error(node, "found several values, expected abs() of one.")
            size = self._number(node.args[0])
            return Term("number", lambda columns: np.abs(size(columns)))
        choose = np.maximum if name == "max" else np.minimum
        if len(node.args) == 1:
            row = self._term(node.args[0])
            if row.kind != "row":
                raise self.error(node.args[0], f"found one value, expected {name}(q[STATE]), or several.")
            own = row.evaluate
            return self._seen(Term("number", lambda columns: choose.reduce(own(columns), axis=1)), node)
        return _reduced("number", choose, list(map(self._number, node.args)))

    def _constant(self, node: ast.Constant) -> Term:
        value = node.value
        if isinstance(value, bool):
            return Term("condition", lambda _: np.array(value))
        if isinstance(value, str):
            raise self.error(node, "found text, expected it next to an action: greedy[...] == TEXT.")
        if not isinstance(value, int | float):
            raise self.error(node, f"found {self.text_of(node)}, expected a number.")
        if not abs(value) <= MAX_NUMBER:
            raise self.error(node, "found a number that is too large.")
        return _fixed(value)

    # --- names ------------------------------------------------------------------------------------------

    def number_of(self, node: ast.expr, names: Sequence[str], what: str) -> int:
        """Return the state or action that a number or a name stands for, among all names by number.

        `what` is `state` or `action`, for errors.
        """
        constant = node.operand if isinstance(node, ast.UnaryOp) else node
        value = constant.value if isinstance(constant, ast.Constant) else None
        if isinstance(value, int) and not isinstance(value, bool):
            if constant is not node or value >= len(names):
                given = self.text_of(node)
                raise self.error(node, f"found {what} {given}, expected one of 0 to {len(names) - 1}.")
            return value
        if constant is not node or not isinstance(value, str):
            article = "an" if what == "action" else "a"
            given_text = self.text_of(node)
            raise self.error(
                node, f"found {given_text}, expected a whole number or a name of {article} {what}."
            )
        wanted = _plain(value)
        named = [k for k, name in enumerate(names) if _plain(name) == wanted]
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


def _reduced(kind: Literal["number", "condition"], operation: np.ufunc, parts: Sequence[Evaluate]) -> Term:
    """Return the term whose value is an operation on those of its parts, from left to right."""
    return Term(kind, lambda columns: functools.reduce(operation, [part(columns) for part in parts]))


def _fixed(value: float) -> Term:
    number = np.array(value, np.float64)
    return Term("number", lambda _: number)


def _is_text(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, str)


def _plain(name: str) -> str:
    """Return a name of a state or action in one spelling."""
    return spoken(" + ".join(part.strip() for part in name.split("+")))
