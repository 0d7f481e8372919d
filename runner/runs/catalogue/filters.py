"""Filters: expressions over the columns of a run, as conditions on the index; or words to search for.

    status == "finished" and config.discount > 0.9 and "keep" not in tags
    created >= "2026-01-01" and (like(name, "tutorial*") or 0 < seed <= 9)
    patient

Words are searched for in id, name, configuration's name, tags and note; so is a text alone in an expression.
Case is ignored. A missing value matches no comparison, so that its `not` does, as does `!=`. Values of a
filter reach SQL only as parameters.
"""

from __future__ import annotations

import ast
import functools
import glob
import math
import re
import sys
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import accumulate
from typing import Any, Final

from runner.errors import RunnerError, nearest
from runner.runs.catalogue.columns import SETTING, STATUSES, TEXT_KINDS, Column, ColumnKind, field_of
from runner.runs.catalogue.database import SEED_SHIFT, Sql
from runner.util.expressions import CONDITION, NUMBER, Operation, Parser, Term

MAX_DEPTH: Final = 16
"""How deep parentheses may be nested in SQL: SQLite's parser may have a stack of 100 entries."""
_SIGNS: Final = re.compile(r"""["'()\[\]{}<>=!:,&|]""")
_WORDS: Final = frozenset(("and", "or", "not", "in", "is", "AND", "OR", "NOT"))
"""A text with none of these signs and words is no expression, but words to search for."""
_OLD: Final = re.compile(r"""(?<![^\s(+-])([A-Za-z_][\w.-]*):([<>]=?)?([\[{]|"[^"]*"|[^\s()]*)""")
"""A term in the Lucene syntax of former versions: `seed:3`, `age:<12h`, and where `steps:[1 TO 9}` begins."""
_FLIPPED: Final[dict[type[ast.cmpop], type[ast.cmpop]]] = {
    ast.Lt: ast.Gt,
    ast.LtE: ast.GtE,
    ast.Gt: ast.Lt,
    ast.GtE: ast.LtE,
}
_NUMBERS: Final = (ColumnKind.NUMBER, ColumnKind.SIZE, ColumnKind.AGE)
_SEEDS: Final = range(2 * SEED_SHIFT)
_AMOUNT: Final = re.compile(r"(\d{1,15}(?:\.\d+)?)\s*([a-z]*)", re.IGNORECASE)
_SECONDS: Final = {"s": 1, "m": 60, "min": 60, "h": 3600, "d": 86400, "w": 7 * 86400}
_BYTES: Final = {"": 1, "k": 10**3, "m": 10**6, "g": 10**9, "t": 10**12}


@dataclass(frozen=True)
class Filter:
    """A parsed filter."""

    condition: Sql | None
    """The condition on a row; None if any row matches."""
    settings: frozenset[tuple[str, str]] = frozenset()
    """The paths of configurations in it, and the lines of an error that mark each."""

    def also(self, condition: Sql) -> Filter:
        """Return the filter for rows that match another condition as well."""
        return Filter(_sql("({} AND {})", condition, self.condition or Sql("TRUE")), self.settings)


ANY_RUN: Final = Filter(None)


def parse(text: str, now: datetime | None = None) -> Filter:
    """Return the filter in a text; an empty one matches every run.

    Args:
        now: the time from which ages are counted; the present by default.

    Raises:
        RunnerError: it is no filter, or has an unknown field; the message shows the place.
    """
    return FilterParser(text, now or datetime.now(UTC)).parse() if text.strip() else ANY_RUN


def is_expression(text: str) -> bool:
    """Return whether a text is an expression, not words to search for."""
    return bool(_SIGNS.search(text) or _WORDS & set(text.split()))


@dataclass(frozen=True)
class FilterPart(Term):
    """A part of a filter in SQL."""

    sql: Sql
    column: Column | None = None
    """The column, if it is one alone."""
    stored: Sql = Sql("")  # noqa: RUF009 - frozen
    """Its value as it is stored."""


class FilterParser(Parser[FilterPart]):
    """Parses one filter."""

    what = "filter"
    needed = "a field in it"
    example = 'status == "finished"'
    max_length = max_nodes = 10_000
    max_number = sys.float_info.max
    operations = {  # noqa: RUF012 - declared in the base class
        ast.And: "({} AND {})",
        ast.Or: "({} OR {})",
        ast.Not: "(NOT {})",
        ast.UAdd: "{}",
        ast.USub: "(- {})",
        ast.Add: "({} + {})",
        ast.Sub: "({} - {})",
        ast.Mult: "({} * {})",
        ast.Div: "(1.0 * {} / {})",
        ast.Lt: "COALESCE({} < {}, 0)",
        ast.LtE: "COALESCE({} <= {}, 0)",
        ast.Gt: "COALESCE({} > {}, 0)",
        ast.GtE: "COALESCE({} >= {}, 0)",
        ast.Eq: "COALESCE({} = {}, 0)",
        "max": "MAX({}, {})",
        "min": "MIN({}, {})",
        "abs": "ABS(1.0 * {})",  # of an integer it may overflow
        "like": "matches({}, {})",
    }
    expected = "expected comparisons, and, or, not, in, is, + - * /, max(), min(), abs() and like()"

    def __init__(self, text: str, now: datetime) -> None:
        super().__init__(text)
        self._now = now
        self._settings: set[tuple[str, str]] = set()

    def parse(self) -> Filter:
        """Return the parsed filter."""
        if is_expression(self.text):
            condition = self.whole()
            if max(accumulate((sign == "(") - (sign == ")") for sign in condition.sql.text)) > MAX_DEPTH:
                raise RunnerError("filter: is nested too deeply.")
        else:
            for word in re.finditer(
                r"(?<!\S)[+-]\S+", self.text
            ):  # as Lucene's syntax demands or excludes it
                wanted = f'{"" if word[0][0] == "+" else "not "}"{word[0][1:]}"'
                raise self.marked(word.start(), len(word[0]), f"found {word[0]}, expected {wanted}")
            condition = self.joined(CONDITION, ast.And, list(map(self._anywhere, self.text.split())))
        return Filter(condition.sql, frozenset(self._settings))

    def syntax_error(self, error: SyntaxError) -> RunnerError:
        """Return the error for a text that is no syntax, with the new form of Lucene's syntax."""
        for term in _OLD.finditer(self.text):
            try:
                message = f"found {term[0]}, expected {_new_form(*term.groups())}"
            except RunnerError as unknown:
                message = str(unknown)
                if "Did you mean" not in message:
                    continue
            return self.marked(term.start(), len(term[0]), message)
        if "decimal" in error.msg:
            error.msg += " (a date, an age or a size is put in quotes)"
        if '"' not in self.text and ("unterminated" in error.msg or not _SIGNS.search(self.text)):
            error.msg += f' (put words to search for in quotes: "{self.text}")'
        return super().syntax_error(error)

    def fixed(self, kind: str, value: float | str) -> FilterPart:
        """Return a number or a text as a parameter; True and False are conditions."""
        if kind == NUMBER and not -SEED_SHIFT <= value < SEED_SHIFT:  # type: ignore[operator]
            value = float(value)
        return FilterPart(kind, Sql("?", (value,)))

    def applied(self, kind: str, operation: Operation, *parts: FilterPart) -> FilterPart:
        """Return an operation on one or two terms."""
        return FilterPart(kind, _sql(self.operations[operation], *(part.sql for part in parts)))

    def condition(self, node: ast.expr) -> FilterPart:
        """Return a condition; a text alone is searched for."""
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            return self._anywhere(glob.escape(node.value))
        return super().condition(node)

    def call(self, node: ast.Call, name: str) -> FilterPart:
        """Return the term of a call; like() matches wildcards."""
        if name != "like":
            return super().call(node, name)
        match node.args, node.keywords:
            case [field, ast.Constant(value=str() as pattern)], []:
                return self._matching(field, self.term(field), pattern)
        raise self.error(
            node, 'expected like() of a field and a text with * ? [abc], as in like(name, "a*").'
        )

    def compared(
        self, node: ast.Compare, left: ast.expr, operator: type[ast.cmpop], right: ast.expr
    ) -> FilterPart:
        """Return the condition that compares a column with a constant, or two numbers."""
        if operator is ast.In:
            if not (isinstance(left, ast.Constant) and isinstance(left.value, str)):
                raise self.error(
                    left,
                    f'found {self.text_of(left)}, expected a text, as in "keep" in tags; put words to search '
                    "for in quotes.",
                )
            term, pattern = self.term(right), glob.escape(left.value)
            is_tags = term.column and term.column.kind is ColumnKind.TAGS
            return self._matching(right, term, pattern if is_tags else f"*{pattern}*")
        if isinstance(left, ast.Constant):
            left, operator, right = right, _FLIPPED.get(operator, operator), left
        term = self.term(left)
        value = right.value if isinstance(right, ast.Constant) else right
        column = term.column
        if operator is ast.Is:
            if column is None or value is not None:
                raise self.error(node, "found `is`, expected FIELD is None, or ==.")
            return FilterPart(CONDITION, _sql("({} IS NULL)", term.stored))
        if column is None or (term.kind == NUMBER and not isinstance(value, str | bool | None)):
            return super().compared(node, left, operator, right)
        try:
            return self._compared_column(node, term, column, operator, value)
        except ValueError as error:
            found = f"{column.name}: found {self.text_of(right)}, expected {error}"
            raise self.error(right, found if found.endswith("?") else f"{found}.") from None

    # --- columns ----------------------------------------------------------------------------------------

    def named(self, node: ast.expr) -> FilterPart:
        """Return a column."""
        name = self._path(node)
        try:
            column = _column(name)
        except RunnerError as error:
            raise self.error(node, f"{error} A text is put in quotes.") from None
        if column.name.startswith(SETTING):
            path = column.name.removeprefix(SETTING)
            self._settings.add((path, self.lines_of(node)))
            at = setting_path(path)
            stored, kind = Sql("json_extract(settings, ?)", (at,)), Sql("json_type(settings, ?)", (at,))
            number = _sql("CASE WHEN {} IN ('integer', 'real') THEN {} END", kind, stored)
            return FilterPart(NUMBER, number, column, stored)
        sql = stored = Sql(column.stored[0])
        if column.kind is ColumnKind.AGE:
            sql = Sql(f"((? - {sql.text}) / 1000.0)", (self._now.timestamp() * 1000,))
        elif column.kind in TEXT_KINDS:
            stored = Sql(f"NULLIF({sql.text}, '')")
        return FilterPart(NUMBER if column.kind in _NUMBERS else column.name, sql, column, stored)

    def _path(self, node: ast.expr) -> str:
        """Return the name of a column, with dots for brackets: `config["lambda"]`, `config.branches[0]`."""
        match node:
            case ast.Name(id=name):
                return name
            case ast.Attribute(value=value, attr=name):
                return f"{self._path(value)}.{name}"
            case ast.Subscript(value=value, slice=ast.Constant(value=int() | str() as item)):
                return f"{self._path(value)}.{item}"
        wrong = node.slice if isinstance(node, ast.Subscript) else node
        raise self.error(
            wrong,
            f"found {self.text_of(wrong)}, expected a field; a key or an item of the configuration is "
            'written config["KEY"] or config.KEY[0].',
        )

    def _compared_column(
        self, node: ast.Compare, term: FilterPart, column: Column, operator: type[ast.cmpop], value: Any
    ) -> FilterPart:
        """Return the condition that a column compares so with a value that is no plain number.

        Raises:
            ValueError: the value is not of the column's kind; the message says what is expected.
        """
        kind = column.kind
        assert kind is not None
        is_equal = operator is ast.Eq
        if term.kind == NUMBER and kind in TEXT_KINDS and is_equal and not isinstance(value, str):
            types = {None: "null", True: "true", False: "false"}
            path = setting_path(column.name.removeprefix(SETTING))
            return FilterPart(CONDITION, Sql("(json_type(settings, ?) IS ?)", (path, types[value])))
        if kind in TEXT_KINDS and isinstance(value, str):
            if not is_equal:
                raise self.error(node, f"{column.name}: text has no order, expected == or !=.")
            if kind is ColumnKind.STATUS and value.casefold() not in STATUSES:
                raise ValueError(f"{kind.value}.{nearest(value, STATUSES)}".removesuffix("."))
            return self._matching(node, term, glob.escape(value))
        if kind is ColumnKind.AGE and is_equal:
            raise ValueError(kind.value)
        first, last = (self.fixed(NUMBER, number) for number in _range_of(kind, value))
        if is_equal:
            from_first = self.applied(CONDITION, ast.GtE, term, first)
            return self.applied(CONDITION, ast.And, from_first, self.applied(CONDITION, ast.LtE, term, last))
        return self.applied(CONDITION, operator, term, first if operator in (ast.Lt, ast.GtE) else last)

    def _matching(self, node: ast.expr, term: FilterPart, pattern: str) -> FilterPart:
        """Return the condition that a column of text matches a pattern of `fnmatch`."""
        if term.column is None or term.column.kind not in TEXT_KINDS:
            raise self.error(node, f"found {self.text_of(node)}, expected a field of text.")
        return FilterPart(CONDITION, _sql(self.operations["like"], term.stored, Sql("?", (pattern,))))

    def _anywhere(self, pattern: str) -> FilterPart:
        """Return the condition that a word is in the id, the names, the tags or the note of a run."""
        self.is_constant = False
        return FilterPart(CONDITION, Sql("matches(words, ?)", (f"*{pattern}*",)))


def _new_form(field: str, operator: str | None, value: str) -> str:
    """Return a term in Lucene's syntax as an expression."""
    kind = _column(field).kind
    text = value if value.startswith('"') else f'"{value or "VALUE"}"'
    if value == "*":
        return f"{field} is not None"
    if value in ("[", "{"):
        return f"LOW <= {field} <= HIGH"
    if kind not in TEXT_KINDS or field.startswith(SETTING):
        value = {"true": "True", "false": "False", "null": "None"}.get(value, value)
        is_plain = re.fullmatch(r"-?[\d.]+(e\d+)?|True|False|None", value)
        return f"{field} {operator or '=='} {value if is_plain else text}"
    if kind in (ColumnKind.TAGS, ColumnKind.PROSE):
        return f"{text} in {field}"
    if kind is ColumnKind.START:
        text = f'{text[:-1]}*"'
    if kind is ColumnKind.START or set("*?") & set(value):
        return f"like({field}, {text})"
    return f"{field} == {text}"


def _column(name: str) -> Column:
    if name.startswith(SETTING):
        return Column(name, ColumnKind.TEXT, "a value of the configuration")
    return field_of(name)


def _sql(template: str, *parts: Sql) -> Sql:
    """Return a template with the texts of its parts, and their values."""
    values = tuple(value for part in parts for value in part.values)
    return Sql(template.format(*(part.text for part in parts)), values)


def _range_of(kind: ColumnKind, value: object) -> tuple[float, float]:
    """Return the first and the last number in a column that a value of a filter stands for.

    Raises:
        ValueError: it is not of the column's kind; so do the functions below.
    """
    if kind is ColumnKind.WHOLE:
        if type(value) is not int or value not in _SEEDS:
            raise ValueError(f"{kind.value} from 0 to {_SEEDS[-1]}")
        return value - SEED_SHIFT, value - SEED_SHIFT
    reads = {ColumnKind.DATE: date_range, ColumnKind.SIZE: size_of, ColumnKind.AGE: seconds_of}
    if kind not in reads or not isinstance(value, str):
        raise ValueError(kind.value)
    number = reads[kind](value)
    return number if isinstance(number, tuple) else (number, number)


def setting_path(path: str) -> str:
    """Return the path of a configuration's value for SQLite's JSON functions, as a parameter."""
    return '$."' + path.replace("\\", "").replace('"', "") + '"'


def size_of(text: str) -> float:
    """Return a number of bytes: `1500`, `10MB`, `1.5 GB`."""
    match = _AMOUNT.fullmatch(text)
    unit = match[2].lower().removesuffix("b") if match else None
    if match is None or unit not in _BYTES:
        raise ValueError(ColumnKind.SIZE.value)
    return float(match[1]) * _BYTES[unit]


def date_range(text: str) -> tuple[int, int]:
    """Return first and last millisecond since 1970 of a day, minute, second or millisecond, in UTC."""
    try:
        moment = datetime.fromisoformat(text)
        moment = moment.replace(tzinfo=UTC) if moment.tzinfo is None else moment.astimezone(UTC)
        start = math.floor(moment.timestamp() * 1000)
    except (ValueError, OverflowError):
        raise ValueError(ColumnKind.DATE.value) from None
    if re.fullmatch(r"\d{4}-\d{2}-\d{2}", text):
        return start, start + 86_399_999
    return start, start + (0 if "." in text else 999 if text.count(":") > 1 else 59_999)


def seconds_of(text: str) -> float:
    """Return a time span in seconds: `90s`, `12h`, `30d`, `2w`."""
    match = _AMOUNT.fullmatch(text)
    if match is None or match[2] not in _SECONDS:
        raise ValueError(ColumnKind.AGE.value)
    return float(match[1]) * _SECONDS[match[2]]


@functools.lru_cache(256)
def _compiled(pattern: str) -> re.Pattern[str]:
    import fnmatch

    return re.compile(fnmatch.translate(pattern.casefold()))


def matches(value: object, pattern: str) -> bool:
    """Return whether a line of a text matches a pattern of `fnmatch`, ignoring case."""
    if not isinstance(value, str):
        return False
    fits = _compiled(pattern).match
    return any(fits(line) for line in value.casefold().split("\n"))
