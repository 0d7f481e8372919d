"""Filters: the Lucene query syntax, parsed by luqum, as conditions on the index.

    status:finished AND config.discount:>0.9 NOT tag:keep
    created:[2026-01-01 TO *] (name:tutorial* OR seed:{0 TO 9])
    patient

Words beside one another are joined by AND, which binds less than a written AND or OR. A word without a
field is looked for in id, name, configuration's name, tags and note. Upper and lower case are one.
What is not known of a run fits no comparison, so that NOT of it does. Nothing of a filter becomes SQL
but as a parameter.
"""

from __future__ import annotations

import functools
import glob
import operator
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Final

from peewee import Value, fn

from runner.errors import RunnerError, nearest
from runner.runs.catalogue.fields import FIELDS, SETTING, STATUSES, Field, Kind, field_of
from runner.runs.catalogue.rows import Row
from runner.runs.catalogue.values import Span, date_span, number_of, size_of, span_seconds, whole_of
from runner.util.values import is_utf8

if TYPE_CHECKING:
    from luqum.tree import Item

MAX_LENGTH: Final = 10_000
MAX_DEPTH: Final = 50
"""Characters of a filter, and how deep its parentheses go."""

_PIECE: Final = re.compile(r"\\(.)|([*?])|([^\\*?]+)|(\\)", re.DOTALL)
_PLACE: Final = re.compile(
    r"(?:Syntax error in input : )?\s*(.*?)(?: at (?:position (\d+)|the end))!?", re.DOTALL
)
_MISTAKEN: Final = {"and": "AND", "or": "OR", "not": "NOT", "&&": "AND", "||": "OR", "&": "AND", "|": "OR"}
_COMPARED: Final = re.compile(r"([A-Za-z_][\w.-]*)\s*([<>]=?|!=|==?)(.*)", re.DOTALL)
_COMPARE: Final[dict[str, Callable[[Any, Any], Any]]] = {
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
}


@dataclass(frozen=True)
class Filter:
    """A filter, understood."""

    condition: Any
    """What a row must fit, for peewee; None if any does."""
    settings: frozenset[str] = frozenset()
    """The paths in configurations that it asks for."""

    def also(self, condition: Any) -> Filter:
        """Return the filter that lets through what fits another condition as well."""
        return Filter(condition if self.condition is None else condition & self.condition, self.settings)


def parse(text: str, now: datetime | None = None) -> Filter:
    """Return the filter in a text; an empty one lets everything through.

    Args:
        text: in the Lucene query syntax.
        now: what ages are counted from.

    Raises:
        RunnerError: it is no filter, or asks for a field that there is none of; where, and what was meant.
    """
    if not text.strip():
        return Filter(None)
    if not is_utf8(text):
        raise RunnerError(f"filter: found {text[:100]!r}, expected text in UTF-8.")
    if len(text) > MAX_LENGTH:
        raise RunnerError(f"filter: found {len(text):,} characters, expected at most {MAX_LENGTH:,}.")
    from luqum.exceptions import ParseError
    from luqum.parser import parser

    try:
        tree = parser.parse(text)
    except ParseError as error:
        raise _unparsed(text, str(error)) from None
    except ArithmeticError:  # of a weight that is no number
        raise RunnerError("filter: found '^' or '~' and no number; put such a text in quotes.") from None
    reading = _Reading(text, now or datetime.now(UTC))
    return Filter(reading.condition(tree), frozenset(reading.settings))


class _Reading:
    """One reading of a filter's tree."""

    def __init__(self, text: str, now: datetime) -> None:
        self._text, self._now = text, now
        self.settings: set[str] = set()

    def condition(self, item: Item, field: Field | None = None, depth: int = 0) -> Any:
        """Return the condition of a part of the tree, asked of a field or of the whole run."""
        from luqum import tree

        if depth > MAX_DEPTH:
            raise RunnerError(f"filter: is nested more than {MAX_DEPTH} deep.")
        within = functools.partial(self.condition, field=field, depth=depth + 1)
        match item:
            case tree.Prohibit() if field is not None and isinstance(item.a, tree.Word):
                return self._compared(field, "=", item, "-" + item.a.value)
            case tree.Not() | tree.Prohibit():
                return ~within(item.a)
            case tree.Plus() | tree.Group() | tree.FieldGroup():
                return within(item.children[0])
            case tree.BaseOperation():
                how = operator.or_ if isinstance(item, tree.OrOperation) else operator.and_
                return _joined(how, [within(part) for part in item.children])
            case tree.SearchField():
                return self.condition(item.expr, self._field(item, field), depth + 1)
        return self._leaf(item, field)

    def _leaf(self, item: Item, field: Field | None) -> Any:
        from luqum import tree

        if field is None:
            return self._anywhere(item)
        match item:
            case tree.Word() | tree.Phrase():
                return self._compared(field, "=", item, item.value)
            case tree.From() | tree.To():
                sign = (">" if isinstance(item, tree.From) else "<") + ("=" if item.include else "")
                return self._compared(field, sign, item, item.a.value)
            case tree.Range():
                ends = (
                    (item.low, ">=" if item.include_low else ">"),
                    (item.high, "<=" if item.include_high else "<"),
                )
                asked = [(_end(end), sign, end) for end, sign in ends]
                parts = [self._compared(field, sign, at, end) for end, sign, at in asked if end != "*"]
                return _joined(operator.and_, parts) if parts else self._compared(field, "=", item, "*")
        raise self._unknown(item)

    def _unknown(self, item: Item) -> RunnerError:
        return self._wrong(
            item, f"found {str(item).strip()!r}, expected a word, a text in quotes, a comparison or a range"
        )

    def _field(self, item: Any, around: Field | None) -> Field:
        if around is not None:
            raise self._wrong(
                item,
                f"found {item.name}: behind {around.name}:, expected a value; one that holds ':' in quotes",
            )
        if item.name.startswith(SETTING):
            self.settings.add(item.name.removeprefix(SETTING))
            return Field(item.name, Kind.TEXT, "a value of the configuration")
        try:
            return field_of(item.name)
        except RunnerError as error:
            raise self._wrong(item, str(error).removesuffix(".")) from None

    def _anywhere(self, item: Any) -> Any:
        """Return the condition that a word is in what a run is called and said to be."""
        from luqum import tree

        if isinstance(item, tree.From | tree.To | tree.Range):
            raise self._wrong(item, "found a comparison, expected a field before it, as in seed:>3")
        if not isinstance(item, tree.Word | tree.Phrase):
            raise self._unknown(item)
        if item.value in _MISTAKEN:
            meant = _MISTAKEN[item.value]
            raise self._wrong(item, f"found {item.value!r}, expected {meant}; or the word in quotes")
        compared = _COMPARED.fullmatch(item.value)
        if compared and (compared[1] in FIELDS or compared[1].startswith(SETTING)):
            sign = compared[2].strip("=!") + ("=" if compared[2] in ("<=", ">=") else "")
            before = "NOT " if compared[2] == "!=" else ""
            raise self._wrong(
                item, f"found {item.value!r}, expected {before}{compared[1]}:{sign}{compared[3] or 'VALUE'}"
            )
        return fn.matches(Row.words, f"*{_pattern(item.value)}*")

    def _compared(self, field: Field, sign: str, item: Item, value: str) -> Any:
        """Return the condition that a field compares so with a value; `item` is where that stands."""
        try:
            if field.name.startswith(SETTING):
                return _known(_setting(field.name.removeprefix(SETTING), sign, value))
            if sign == "=" and value == "*":
                column = _column(field)
                return (
                    column.is_null(False) & (column != "") if field.kind in _TEXTS else column.is_null(False)
                )
            return _known(_CONDITIONS[field.kind](field, sign, value, self._now))
        except ValueError as error:
            raise self._wrong(item, f"{field.name}: found {value!r}, expected {error}") from None

    def _wrong(self, item: Item, told: str) -> RunnerError:
        return _pointed(self._text, item.pos or 0, told)


def _unparsed(text: str, told: str) -> RunnerError:
    """Return the error of a text that is no filter, from what the parser told."""
    found = _PLACE.fullmatch(told)
    if found is None:
        return RunnerError(f"filter: {told}")
    what = " ".join(found[1].split())
    at = int(found[2]) if found[2] else len(text)
    if "maybe due to unmatched" in what:
        what = "ends where a value or a ')' is expected"
    elif text[at : at + 1] == "-":
        what += "; a negative number is put in quotes"
    elif text[at : at + 1] == '"':
        what = "a quote that is not closed"
    return _pointed(text, at, what)


def _pointed(text: str, at: int, told: str) -> RunnerError:
    """Return an error that shows the place in the filter."""
    start = max(0, at - 60)
    shown = text[start : at + 40].replace("\n", " ").replace("\t", " ")
    end = "" if told.endswith("?") else "."
    return RunnerError(f"filter: {told}{end}\n  {shown}\n  {' ' * (at - start)}^")


def _joined(how: Callable[[Any, Any], Any], parts: Sequence[Any]) -> Any:
    """Return conditions joined in pairs, so that many of them do not nest deeply."""
    if len(parts) == 1:
        return parts[0]
    middle = len(parts) // 2
    return how(_joined(how, parts[:middle]), _joined(how, parts[middle:]))


def _known(condition: Any) -> Any:
    """Return a condition that is false, not unknown, where the value is not known."""
    return fn.COALESCE(condition, 0) == 1


def _end(item: Any) -> str:
    """Return the value at an end of a range."""
    from luqum.tree import Prohibit

    return "-" + item.a.value if isinstance(item, Prohibit) else str(item.value)


def _plain(value: str) -> str:
    """Return the text that a word or a phrase stands for, without quotes and backslashes."""
    if len(value) > 1 and value[0] == value[-1] == '"':
        value = value[1:-1]
    return re.sub(r"\\(.)", r"\1", value, flags=re.DOTALL)


def _pattern(value: str) -> str:
    """Return a word as a pattern for `matches`; * and ? count where no quotes or backslash hide them."""
    if len(value) > 1 and value[0] == value[-1] == '"':
        return glob.escape(_plain(value))
    pieces = (found.groups() for found in _PIECE.finditer(value))
    return "".join(wild or glob.escape(escaped or plain or stray) for escaped, wild, plain, stray in pieces)


def _column(field: Field) -> Any:
    return getattr(Row, field.column or field.name)


def _text_condition(field: Field, sign: str, value: str, _: datetime) -> Any:
    if sign != "=":
        raise ValueError(f"{field.kind.value}: text has no order")
    pattern = _pattern(value)
    if field.kind is Kind.PROSE:
        pattern = f"*{pattern}*"
    elif field.kind is Kind.START:
        pattern += "*"
    elif (
        field.kind is Kind.STATUS and not set("*?") & set(value) and _plain(value).casefold() not in STATUSES
    ):
        raise ValueError(f"{field.kind.value}.{nearest(_plain(value), STATUSES)}".removesuffix("."))
    return fn.matches(_column(field), pattern)


def _number_condition(field: Field, sign: str, value: str, _: datetime) -> Any:
    if field.kind is Kind.WHOLE:
        return _ordered(_column(field), sign, whole_of(_plain(value)))
    bound = size_of(_plain(value)) if field.kind is Kind.SIZE else number_of(_plain(value))
    return _ordered(_column(field), sign, Value(bound, converter=_unchanged))  # 1.5 steps stay 1.5


def _unchanged(value: Any) -> Any:
    return value


def _ordered(column: Any, sign: str, value: Any) -> Any:
    return column == value if sign == "=" else _COMPARE[sign](column, value)


def _date_condition(field: Field, sign: str, value: str, _: datetime) -> Any:
    return _within(_column(field), sign, date_span(_plain(value)))


def _within(column: Any, sign: str, span: Span) -> Any:
    """Return the condition that a moment is before, after or in a span of milliseconds."""
    match sign:
        case "=":
            return (column >= span.start) & (column < span.stop)
        case "<":
            return column < span.start
        case "<=":
            return column < span.stop
        case ">":
            return column >= span.stop
    return column >= span.start


def _age_condition(field: Field, sign: str, value: str, now: datetime) -> Any:
    moment = int((now.timestamp() - span_seconds(_plain(value))) * 1000)
    if sign == "=":
        raise ValueError(f"{field.kind.value}, as in {field.name}:<{value}")
    older = {"<": ">", "<=": ">=", ">": "<", ">=": "<="}[sign]
    return _COMPARE[older](_column(field), moment)


_TEXTS: Final = (Kind.START, Kind.TEXT, Kind.STATUS, Kind.PROSE, Kind.TAGS)
_CONDITIONS: Final[dict[Kind, Callable[[Field, str, str, datetime], Any]]] = {
    **dict.fromkeys(_TEXTS, _text_condition),
    **dict.fromkeys((Kind.WHOLE, Kind.NUMBER, Kind.SIZE), _number_condition),
    Kind.DATE: _date_condition,
    Kind.AGE: _age_condition,
}


def setting_path(path: str) -> str:
    """Return the path of a configuration's value as SQLite's JSON functions take it, to be a parameter."""
    return '$."' + path.replace("\\", "").replace('"', "") + '"'


def _setting(path: str, sign: str, value: str) -> Any:
    """Return the condition that a value of the configuration compares so."""
    kind = fn.json_type(Row.settings, setting_path(path))
    found = fn.json_extract(Row.settings, setting_path(path))
    plain = _plain(value)
    try:
        number = number_of(plain)
    except ValueError:
        number = None
    numeric = kind.in_(("integer", "real"))
    if sign != "=":
        if number is None:
            raise ValueError("a number: text has no order")
        return numeric & _ordered(found, sign, number)
    if value == "*":
        return kind.is_null(False)
    as_text = (kind == "text") & fn.matches(found, _pattern(value))
    if number is not None:
        return as_text | (numeric & (found == number))
    if plain in ("true", "false", "null"):
        return as_text | (kind == plain)
    return as_text


@functools.lru_cache(256)
def _compiled(pattern: str) -> re.Pattern[str]:
    import fnmatch

    return re.compile(fnmatch.translate(pattern.casefold()))


def matches(value: Any, pattern: str) -> bool:
    """Return whether a line of a text fits a pattern of `fnmatch`, whatever the case; no text does not."""
    if not isinstance(value, str):
        return False
    fits = _compiled(pattern).match
    return any(fits(line) for line in value.casefold().split("\n"))
