"""What a user can see or read by a program, as lines of text in which times, ids and sizes are masked."""

from __future__ import annotations

import inspect
import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, Final

from click.testing import CliRunner
from selenium.common.exceptions import TimeoutException
from selenium.webdriver.remote.webdriver import WebDriver

import runner
from runner.cli import cli
from tests.doors import walk
from tests.runner.service.served import wait

Lines = dict[str, list[str]]
"""What is inventoried -> its lines, sorted, each once."""

_MASKS: Final = (
    (r"\bdualtaxi_[\w-]{43}", "TOKEN"),
    (r"\b[0-9a-f]{8,}\b", "HEX"),
    (r"[+-]?\d[\d,.]*(e[+-]?\d+)?", "#"),
    (r"# (k|M|G)?B\b", "SIZE"),
    (r"# (ns|us|µs|ms|s|min|h|d|days?|hours?|minutes?|seconds?)\b", "TIME"),
    (r"(TIME ?)+( ago)?", "TIME"),
    (r"#[kMG]\b", "#"),  # how quick the machine is decides the unit
    (r"^\s*seconds\s+#\s+#\s*$", ""),  # of a difference, whose two times may be equal
    (r"^(stderr: )?Matplotlib is building the font cache.*", ""),  # on its first start
    (r"\bjust now\b|\bnow\b", "TIME"),
)
"""Patterns of what differs from run to run or machine to machine, and what stands for them."""


class Mask:
    """Replaces what differs between two runs of the same program.

    Args:
        names: texts to be replaced, such as ids and folders, and what stands for them.
    """

    def __init__(self, names: Mapping[str, str]) -> None:
        self._names = names

    def __call__(self, text: str) -> str:
        for found, name in self._names.items():
            text = text.replace(found, name)
        for pattern, name in _MASKS:
            text = re.sub(pattern, name, text)
        return re.sub(r"\s+", " ", text).strip()

    def lines(self, texts: Iterable[str]) -> list[str]:
        """Return masked lines, sorted, each once."""
        return sorted({line for line in map(self, texts) if line})


# --- pages ----------------------------------------------------------------------------------------------

COUNT_REQUESTS: Final = """
window.requestsUnderWay = 0;
const request = window.fetch;
window.fetch = async (...words) => {
    window.requestsUnderWay += 1;
    try {
        const response = await request(...words);
        const isRead = response.clone().blob().catch(() => {});
        isRead.finally(() => setTimeout(() => { window.requestsUnderWay -= 1; }));
        return response;
    } catch (error) {
        window.requestsUnderWay -= 1;
        throw error;
    }
};
"""
"""Counts the requests of a page whose responses were not read to their end; runs before its own scripts."""
READ_PAGE: Final = """
return (async () => {
const frame = () => new Promise((resolve) => requestAnimationFrame(() => setTimeout(resolve)));
const isBusy = () => document.readyState !== "complete" || window.requestsUnderWay > 0 ||
    document.querySelector("[aria-busy]") || [...document.images].some((image) => !image.complete);
for (const node of document.querySelectorAll("details:not([open])")) {
    node.open = node.dataset.wasClosed = true;
}
await frame();
await frame();  // in which what is seen for the first time begins to load
if (isBusy()) return null;
const lines = [];
const text = (node) => (node.innerText || node.textContent || "").trim();
const each = (selector, describe) => {
    const shown = [...document.querySelectorAll(selector)].filter((node) => node.checkVisibility());
    lines.push(...shown.map(describe).filter((line) => !/^\\w+: *$/.test(line)));
};
lines.push("title: " + document.title);
each("h1, h2, h3, h4", (node) => "heading: " + text(node));
each("th", (node) => "column: " + text(node));
each("caption, figcaption, legend, summary", (node) => "caption: " + text(node));
each("a[href]", (node) => "link: " + text(node) + " -> " + decodeURIComponent(node.getAttribute("href")));
each("button", (node) => "button: " + (text(node) || node.getAttribute("aria-label") || node.name));
each("input, select, textarea", (node) => "field: " + (node.name || node.id) + " " + node.type +
    (node.options ? ": " + [...node.options].map(text).join(", ") : ""));
const nameOf = (node) => node.getAttribute("aria-label") || text(node.querySelector("title") || node);
each("[role=img], svg[aria-label], canvas[aria-label]", (node) => "chart: " + nameOf(node));
each("svg title", (node) => "chart: " + text(node));
each("svg[aria-label] text", (node) => /\\p{L}/u.test(text(node)) ?
    "drawn: " + nameOf(node.closest("svg")) + ": " + text(node) : "drawn: ");
each("svg[aria-label] [stroke^='var(--line-']", (node) => "drawn: " + nameOf(node.closest("svg")) +
    ": curve " + "ABCDEFGHIJ"[/\\d+/.exec(node.getAttribute("stroke"))[0]]);
each(".key li, .key button, .legend li", (node) => "series: " + text(node));
each("p, li, dt, dd, td, label, output, .message", (node) => {
    const own = [...node.childNodes].filter((child) => child.nodeType === Node.TEXT_NODE ||
        ["B", "EM", "STRONG", "CODE", "SPAN", "TIME", "KBD", "I", "SUB"].includes(child.nodeName));
    return "text: " + own.map((child) => (child.textContent || "").trim()).join(" ");
});
return lines;
})();
"""
"""Returns the lines of a page; null as long as it loads anything."""


def read_page(browser: WebDriver, address: str, mask: Mask) -> list[str]:
    """Return the lines of a page after its scripts ran: when it loads nothing and reads the same twice."""
    browser.get(address)
    before: list[str] | None = None

    def is_still() -> bool:
        nonlocal before
        lines = browser.execute_script(READ_PAGE)
        now = None if lines is None else mask.lines(lines)
        is_same, before = now is not None and now == before, now
        return is_same

    try:
        wait(browser, is_still)
    except TimeoutException as error:
        raise AssertionError(f"{address} does not come to rest: {before}") from error
    return before


# --- JSON -----------------------------------------------------------------------------------------------


def key_paths(value: Any, path: str = "") -> Iterator[str]:
    """Yield the path of each key in a JSON value: `runs[].name`."""
    if isinstance(value, Mapping):
        for key, inner in value.items():
            yield f"{path}.{key}".lstrip(".")
            yield from key_paths(inner, f"{path}.{key}".lstrip("."))
    elif isinstance(value, list):
        for inner in value:
            yield from key_paths(inner, f"{path}[]")


# --- commands -------------------------------------------------------------------------------------------


def read_help() -> Lines:
    """Return the help of every command."""
    names = ["", *(" ".join(path) for path, _ in walk())]
    return {
        " ".join(("dualtaxi", *name.split(), "--help")): CliRunner()
        .invoke(cli, [*name.split(), "--help"], terminal_width=1000)
        .stdout.splitlines()
        for name in names
    }


def read_command(words: list[str], masking: Callable[[], Mask]) -> list[str]:
    """Return what a command prints, and its exit code; of JSON the keys.

    `masking` is called after the command, which may have recorded a run.
    """
    done = CliRunner().invoke(cli, words, terminal_width=200)
    mask = masking()
    lines = [f"exit code {done.exit_code:d}"]
    if "--json" in words:
        objects = [json.loads(line) for line in _json_texts(done.stdout)]
        objects += [json.loads(line) for line in done.stderr.splitlines() if line.startswith("{")]
        return [*lines, *mask.lines(f"key: {path}" for each in objects for path in key_paths(each))]
    printed = [*done.stdout.splitlines(), *(f"stderr: {line}" for line in done.stderr.splitlines() if line)]
    return [*lines, *mask.lines(printed)]


def _json_texts(output: str) -> list[str]:
    """Return the JSON objects that a command printed: one, or one a line."""
    try:
        json.loads(output)
    except ValueError:
        return output.splitlines()
    return [output]


# --- Python ---------------------------------------------------------------------------------------------


def read_names() -> Lines:
    """Return the public names of `runner`: signatures of functions, members of classes and modules."""
    lines: Lines = {}
    for name in sorted(runner.__all__):
        value = getattr(runner, name)
        if isinstance(value, type):
            members = [member for member in dir(value) if not member.startswith("_")]
            lines[f"runner.{name}"] = sorted(_signature(member, getattr(value, member)) for member in members)
        elif inspect.ismodule(value):
            public = getattr(value, "__all__", None) or [
                member
                for member, inner in vars(value).items()
                if not member.startswith("_") and getattr(inner, "__module__", "") == value.__name__
            ]
            lines[f"runner.{name}"] = sorted(_signature(member, getattr(value, member)) for member in public)
        else:
            lines[f"runner.{name}"] = [_signature(name, value)]
    return lines


def _signature(name: str, value: object) -> str:
    if inspect.isroutine(value) and not inspect.isbuiltin(value) and hasattr(value, "__code__"):
        parameters = inspect.signature(value).parameters.values()
        return f"{name}({', '.join(f'{each.kind.description[:3]} {each.name}' for each in parameters)})"
    return name
