"""Filters: the Lucene query syntax, parsed by luqum, as conditions on the index.

    status:finished AND config.discount:>0.9 NOT tag:keep
    created:[2026-01-01 TO *] (name:tutorial* OR seed:{0 TO 9])
    patient

Adjacent words are joined by AND, which binds less than a written AND or OR. A word without a field is
searched for in id, name, configuration's name, tags and note. Case is ignored. A missing value matches no
comparison, so that its NOT does. Values of a filter reach SQL only as parameters.
"""

from __future__ import annotations

import functools
import glob
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Final

from runner.errors import RunnerError, nearest
from runner.runs.catalogue.columns import FIELDS, SETTING, STATUSES, TEXT_KINDS, Column, Kind, field_of
from runner.runs.catalogue.rows import SEED_SHIFT, Sql
from runner.util.values import is_utf8

if TYPE_CHECKING:
    from luqum.tree import Item

MAX_LENGTH: Final = 10_000
"""Characters of a filter."""
MAX_DEPTH: Final = 50
"""How deep the parentheses of a filter may be nested."""

_PIECE: Final = re.compile(r"\\(.)|([*?])|([^\\*?]+)|(\\)", re.DOTALL)
_PLACE: Final = re.compile(
    r"(?:Syntax error in input : )?\s*(.*?)(?: at (?:position (\d+)|the end))!?", re.DOTALL
)
_MISTAKEN: Final = {"and": "AND", "or": "OR", "not": "NOT", "&&": "AND", "||": "OR", "&": "AND", "|": "OR"}
_COMPARISON: Final = re.compile(r"([A-Za-z_][\w.-]*)\s*([<>]=?|!=|==?)(.*)", re.DOTALL)
_OPPOSITE: Final = {"<": ">", "<=": ">=", ">": "<", ">=": "<="}
_SPAN: Final = re.compile(r"(\d+(?:\.\d+)?)\s*(s|min|m|h|d|w)")
_SECONDS: Final = {"s": 1, "m": 60, "min": 60, "h": 3600, "d": 86400, "w": 7 * 86400}
_SIZE: Final = re.compile(r"(\d+(?:\.\d+)?)\s*([kMGT]?)B?", re.IGNORECASE)
_BYTES: Final = {"": 1, "k": 10**3, "m": 10**6, "g": 10**9, "t": 10**12}


@dataclass(frozen=True)
class Filter:
    """A parsed filter."""

    condition: Sql | None
    """The condition on a row; None if any row matches."""
    settings: frozenset[str] = frozenset()
    """The paths of configurations in it."""

    def also(self, condition: Sql) -> Filter:
        """Return the filter for rows that match another condition as well."""
        own = [] if self.condition is None else [self.condition]
        return Filter(_joined("AND", [condition, *own]), self.settings)


ANY_RUN: Final = Filter(None)


def parse(text: str, now: datetime | None = None) -> Filter:
    """Return the filter in a text; an empty one matches every run.

    Args:
        now: the time from which ages are counted; the present by default.

    Raises:
        RunnerError: it is no filter, or has an unknown field; the message shows the place.
    """
    if not text.strip():
        return ANY_RUN
    if not is_utf8(text):
        raise RunnerError(f"filter: found {text[:100]!r}, expected text in UTF-8.")
    if len(text) > MAX_LENGTH:
        raise RunnerError(f"filter: found {len(text):,} characters, expected at most {MAX_LENGTH:,}.")
    from luqum.exceptions import ParseError
    from luqum.parser import parser

    try:
        tree = parser.parse(text)
    except ParseError as error:
        raise _syntax_error(text, str(error)) from None
    except ArithmeticError:  # of a weight that is no number
        raise RunnerError("filter: found '^' or '~' and no number; put such a text in quotes.") from None
    translation = _Translation(text, now or datetime.now(UTC))
    return Filter(translation.condition(tree), frozenset(translation.settings))


class _Translation:
    """The translation of a filter's tree into a condition."""

    def __init__(self, text: str, now: datetime) -> None:
        self._text, self._now = text, now
        self.settings: set[str] = set()

    def condition(self, item: Item, field: Column | None = None, depth: int = 0) -> Sql:
        """Return the condition of a node on a field, or on the whole run."""
        from luqum import tree

        if depth > MAX_DEPTH:
            raise RunnerError(f"filter: is nested more than {MAX_DEPTH} deep.")
        within = functools.partial(self.condition, field=field, depth=depth + 1)
        match item:
            case tree.Prohibit() if field is not None and isinstance(item.a, tree.Word):
                return self._compare(field, "=", item, "-" + item.a.value)
            case tree.Not() | tree.Prohibit():
                negated = within(item.a)
                return Sql(f"NOT {negated.text}", negated.values)
            case tree.Plus() | tree.Group() | tree.FieldGroup():
                return within(item.children[0])
            case tree.BaseOperation():
                how = "OR" if isinstance(item, tree.OrOperation) else "AND"
                return _joined(how, [within(part) for part in item.children])
            case tree.SearchField():
                return self.condition(item.expr, self._field(item, field), depth + 1)
        return self._anywhere(item) if field is None else self._leaf(item, field)

    def _leaf(self, item: Item, field: Column) -> Sql:
        from luqum import tree

        match item:
            case tree.Word() | tree.Phrase():
                return self._compare(field, "=", item, item.value)
            case tree.From() | tree.To():
                sign = (">" if isinstance(item, tree.From) else "<") + ("=" if item.include else "")
                return self._compare(field, sign, item, item.a.value)
            case tree.Range():
                low, high = (
                    "-" + end.a.value if isinstance(end, tree.Prohibit) else str(end.value)
                    for end in (item.low, item.high)
                )
                ends = (
                    (low, ">=" if item.include_low else ">", item.low),
                    (high, "<=" if item.include_high else "<", item.high),
                )
                parts = [self._compare(field, sign, at, end) for end, sign, at in ends if end != "*"]
                return _joined("AND", parts) if parts else self._compare(field, "=", item, "*")
        raise self._unexpected(item)

    def _field(self, item: Item, outer: Column | None) -> Column:
        if outer is not None:
            raise self._error(
                item,
                f"found {item.name}: after {outer.name}:, expected a value; one that holds ':' in quotes",
            )
        if item.name.startswith(SETTING):
            self.settings.add(item.name.removeprefix(SETTING))
            return Column(item.name, Kind.TEXT, "a value of the configuration")
        try:
            return field_of(item.name)
        except RunnerError as error:
            raise self._error(item, str(error).removesuffix(".")) from None

    def _anywhere(self, item: object) -> Sql:
        """Return the condition that a word is in the id, the names, the tags or the note of a run."""
        from luqum import tree

        if isinstance(item, tree.From | tree.To | tree.Range):
            raise self._error(item, "found a comparison, expected a field before it, as in seed:>3")
        if not isinstance(item, tree.Word | tree.Phrase):
            raise self._unexpected(item)
        if item.value in _MISTAKEN:
            meant = _MISTAKEN[item.value]
            raise self._error(item, f"found {item.value!r}, expected {meant}; or the word in quotes")
        compared = _COMPARISON.fullmatch(item.value)
        if compared and (compared[1] in FIELDS or compared[1].startswith(SETTING)):
            sign = compared[2].strip("=!") + ("=" if compared[2] in ("<=", ">=") else "")
            before = "NOT " if compared[2] == "!=" else ""
            raise self._error(
                item, f"found {item.value!r}, expected {before}{compared[1]}:{sign}{compared[3] or 'VALUE'}"
            )
        return Sql("matches(words, ?)", (f"*{_pattern(item.value)}*",))

    def _compare(self, field: Column, sign: str, item: Item, value: str) -> Sql:
        """Return the condition that a field compares so with a value; `item` is its place in the text."""
        try:
            if field.name.startswith(SETTING):
                condition = _setting_condition(field.name.removeprefix(SETTING), sign, value)
            else:
                column = field.stored[0]
                if sign == "=" and value == "*":
                    not_empty = f" AND {column} != ''" if field.kind in TEXT_KINDS else ""
                    return Sql(f"({column} IS NOT NULL{not_empty})")
                condition = _condition(field, column, sign, value, self._now)
        except ValueError as error:
            raise self._error(item, f"{field.name}: found {value!r}, expected {error}") from None
        return Sql(
            f"(COALESCE({condition.text}, 0) = 1)", condition.values
        )  # false, not unknown, where there is no value

    def _unexpected(self, item: Item) -> RunnerError:
        found = str(item).strip()
        return self._error(
            item, f"found {found!r}, expected a word, a text in quotes, a comparison or a range"
        )

    def _error(self, item: Item, message: str) -> RunnerError:
        return _error_at(self._text, item.pos or 0, message)


def _syntax_error(text: str, message: str) -> RunnerError:
    """Return the error for a text that is no filter, given the parser's message."""
    match = _PLACE.fullmatch(message)
    if match is None:
        return RunnerError(f"filter: {message}")
    what = " ".join(match[1].split())
    at = int(match[2]) if match[2] else len(text)
    if "maybe due to unmatched" in what:
        what = "ends where a value or a ')' is expected"
    elif text[at : at + 1] == "-":
        what += "; a negative number is put in quotes"
    elif text[at : at + 1] == '"':
        what = "a quote that is not closed"
    return _error_at(text, at, what)


def _error_at(text: str, at: int, message: str) -> RunnerError:
    """Return an error that shows the place in the filter."""
    start = max(0, at - 60)
    shown = text[start : at + 40].replace("\n", " ").replace("\t", " ")
    end = "" if message.endswith("?") else "."
    return RunnerError(f"filter: {message}{end}\n  {shown}\n  {' ' * (at - start)}^")


def _joined(how: str, parts: Sequence[Sql]) -> Sql:
    """Return conditions joined in pairs, so that many of them do not nest deeply."""
    if len(parts) == 1:
        return parts[0]
    middle = len(parts) // 2
    first, second = _joined(how, parts[:middle]), _joined(how, parts[middle:])
    return Sql(f"({first.text} {how} {second.text})", first.values + second.values)


def _plain(value: str) -> str:
    """Return the text of a word or a phrase, without quotes and backslashes."""
    if len(value) > 1 and value[0] == value[-1] == '"':
        value = value[1:-1]
    return re.sub(r"\\(.)", r"\1", value, flags=re.DOTALL)


def _pattern(value: str) -> str:
    """Return a word as a pattern for `matches`; * and ? are wildcards unless quoted or escaped."""
    if len(value) > 1 and value[0] == value[-1] == '"':
        return glob.escape(_plain(value))
    pieces = (match.groups() for match in _PIECE.finditer(value))
    return "".join(wild or glob.escape(escaped or plain or stray) for escaped, wild, plain, stray in pieces)


def _condition(field: Column, column: str, sign: str, value: str, now: datetime) -> Sql:
    """Return the condition that a column compares so with a value.

    Raises:
        ValueError: the value is not of the field's kind; the message says what is expected.
    """
    plain = _plain(value)
    match field.kind:
        case Kind.WHOLE:
            return Sql(f"{column} {sign} ?", (seed_of(plain) - SEED_SHIFT,))
        case Kind.NUMBER | Kind.SIZE:
            bound = size_of(plain) if field.kind is Kind.SIZE else number_of(plain)
            return Sql(f"{column} {sign} ?", (bound,))
        case Kind.DATE:
            start, stop = date_span(plain)
            if sign == "=":
                return Sql(f"({column} >= ? AND {column} < ?)", (start, stop))
            return Sql(f"{column} {sign[0].replace('>', '>=')} ?", (start if sign in ("<", ">=") else stop,))
        case Kind.AGE:
            then = int((now.timestamp() - seconds_of(plain)) * 1000)
            if sign == "=":
                raise ValueError(f"{Kind.AGE.value}, as in {field.name}:<{value}")
            return Sql(f"{column} {_OPPOSITE[sign]} ?", (then,))
    assert field.kind is not None
    if sign != "=":
        raise ValueError(f"{field.kind.value}: text has no order")
    if field.kind is Kind.STATUS and not set("*?") & set(value) and plain.casefold() not in STATUSES:
        raise ValueError(f"{field.kind.value}.{nearest(plain, STATUSES)}".removesuffix("."))
    before, after = {Kind.PROSE: ("*", "*"), Kind.START: ("", "*")}.get(field.kind, ("", ""))
    return Sql(f"matches({column}, ?)", (f"{before}{_pattern(value)}{after}",))


def setting_path(path: str) -> str:
    """Return the path of a configuration's value for SQLite's JSON functions, as a parameter."""
    return '$."' + path.replace("\\", "").replace('"', "") + '"'


def _setting_condition(path: str, sign: str, value: str) -> Sql:
    """Return the condition that a value of the configuration compares so."""
    kind, setting = "json_type(settings, ?)", "json_extract(settings, ?)"
    at, plain = setting_path(path), _plain(value)
    try:
        number = number_of(plain)
    except ValueError:
        number = None
    if sign != "=" and number is None:
        raise ValueError("a number: text has no order")
    numeric = Sql(f"({kind} IN ('integer', 'real') AND {setting} {sign} ?)", (at, at, number))
    if sign != "=":
        return numeric
    if value == "*":
        return Sql(f"({kind} IS NOT NULL)", (at,))
    as_text = Sql(f"({kind} = 'text' AND matches({setting}, ?))", (at, at, _pattern(value)))
    if number is not None:
        return _joined("OR", [as_text, numeric])
    named = [Sql(f"{kind} = ?", (at, plain))] if plain in ("true", "false", "null") else []
    return _joined("OR", [as_text, *named])


def number_of(text: str) -> int | float:
    """Return a finite number; a whole one exactly, if SQLite can hold it.

    Raises:
        ValueError: it is none; so do the functions below.
    """
    if re.fullmatch(r"[+-]?\d{1,18}", text, re.ASCII):
        return int(text)
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number) or "_" in text:
        raise ValueError(Kind.NUMBER.value)
    return number


def seed_of(text: str) -> int:
    """Return a seed: a whole number from 0 to 2^64 - 1."""
    if not re.fullmatch(r"\d{1,20}", text, re.ASCII) or int(text) >= 2 * SEED_SHIFT:
        raise ValueError(f"{Kind.WHOLE.value} from 0 to {2 * SEED_SHIFT - 1}")
    return int(text)


def size_of(text: str) -> float:
    """Return a number of bytes: `1500`, `10MB`, `1.5 GB`."""
    match = _SIZE.fullmatch(text)
    if match is None:
        raise ValueError(Kind.SIZE.value)
    return float(match[1]) * _BYTES[match[2].lower()]


def date_span(text: str) -> tuple[int, int]:
    """Return first and next millisecond since 1970 of a day, minute, second or millisecond, in UTC."""
    try:
        moment = datetime.fromisoformat(text)
        moment = moment.replace(tzinfo=UTC) if moment.tzinfo is None else moment.astimezone(UTC)
        start = math.floor(moment.timestamp() * 1000)
    except (ValueError, OverflowError):
        raise ValueError(Kind.DATE.value) from None
    if re.fullmatch(r"\d{4}-\d{2}-\d{2}", text):
        return start, start + 86_400_000
    return start, start + (1 if "." in text else 1000 if text.count(":") > 1 else 60_000)


def seconds_of(text: str) -> float:
    """Return a time span in seconds: `90s`, `12h`, `30d`, `2w`."""
    match = _SPAN.fullmatch(text)
    if match is None or len(match[1]) > 12:
        raise ValueError(Kind.AGE.value)
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
