"""What a user can see or read by a program, as lines of text in which times, ids and sizes are masked."""

from __future__ import annotations

import inspect
import json
import re
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import click
from click.testing import CliRunner
from selenium.common.exceptions import TimeoutException
from selenium.webdriver.remote.webdriver import WebDriver

import runner
from runner.cli import cli
from tests.runner.service.served import wait

Lines = dict[str, list[str]]
"""What is inventoried -> its lines, sorted, each once."""

_MASKS = (
    (r"\b[0-9a-f]{8,}\b", "HEX"),
    (r"[+-]?\d[\d,.]*(e[+-]?\d+)?", "#"),
    (r"# (k|M|G)?B\b", "SIZE"),
    (r"# (ns|us|µs|ms|s|min|h|d|days?|hours?|minutes?|seconds?)\b", "TIME"),
    (r"(TIME ?)+( ago)?", "TIME"),
    (r"\bjust now\b|\bnow\b", "TIME"),
)
"""Patterns of what differs from run to run or machine to machine, and what stands for them."""


_MACHINE = re.compile(r"(^|[ .])(env\.[A-Z]|container|gpu|git\.|processor|memory|packages|code\.script)")
"""Lines about the machine, which are left out: another machine has others."""
STILL_SECONDS = 0.4


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
        return sorted({line for line in map(self, texts) if line and not _MACHINE.search(line)})


# --- pages ----------------------------------------------------------------------------------------------

READ_PAGE = """
const lines = [];
const text = (node) => (node.innerText || node.textContent || "").trim().replace(/\\s+/g, " ");
for (const node of document.querySelectorAll("details")) node.open = true;
const seen = (node) => node.checkVisibility();
const each = (selector, describe) => {
    for (const node of document.querySelectorAll(selector)) if (seen(node)) lines.push(describe(node));
};
lines.push("title: " + document.title);
each("h1, h2, h3, h4", (node) => "heading: " + text(node));
each("th", (node) => "column: " + text(node));
each("caption, figcaption, legend, summary", (node) => "caption: " + text(node));
each("a[href]", (node) => "link: " + text(node) + " -> " + decodeURIComponent(node.getAttribute("href")));
each("button", (node) => "button: " + (text(node) || node.getAttribute("aria-label") || node.name));
each("input, select, textarea", (node) => "field: " + (node.name || node.id) + " " + node.type +
    (node.options ? ": " + [...node.options].map(text).join(", ") : ""));
each("svg[aria-label], svg[role=img], canvas[aria-label]", (node) => "chart: " +
    (node.getAttribute("aria-label") || text(node.querySelector("title") || node)));
each("svg title", (node) => "chart: " + text(node));
each(".key li, .key button, .legend li", (node) => "series: " + text(node));
const isOfMachine = (node) => node.closest("tr")?.querySelector("th[scope=row], th") &&
    /\\/(config|system)$/.test(location.pathname);
each("p, li, dt, dd, td, label, output, .message, [data-message]", (node) => {
    const own = [...node.childNodes].filter((child) => child.nodeType === Node.TEXT_NODE ||
        ["B", "EM", "STRONG", "CODE", "SPAN", "TIME", "KBD", "I", "SUB"].includes(child.nodeName));
    if (node.nodeName === "TD" && isOfMachine(node)) return "";
    return "text: " + own.map((child) => (child.textContent || "").trim()).join(" ");
});
return lines;
"""


def read_page(browser: WebDriver, address: str, mask: Mask) -> list[str]:
    """Return the lines of a page after its scripts ran: when nothing changed for a moment."""
    browser.get(address)
    before: list[str] = []
    changed = time.monotonic()
    pending = (
        "return document.readyState !== 'complete' || !!document.querySelector('[aria-busy]') || "
        "/Computing|being made/.test(document.body.innerText)"
    )

    def is_still() -> bool:
        nonlocal before, changed
        is_pending = browser.execute_script(pending)  # first, as reading takes a while
        now = mask.lines(browser.execute_script(READ_PAGE))
        if is_pending or now != before:
            before, changed = now, time.monotonic()
        return time.monotonic() - changed > STILL_SECONDS

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


def walk(group: Any = cli, path: tuple[str, ...] = ()) -> Iterator[tuple[str, click.Command]]:
    """Yield the words of every command, and the command."""
    context = click.Context(group)
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        if isinstance(command, click.Group):
            yield from walk(command, (*path, name))
        else:
            yield " ".join((*path, name)), command


def read_help() -> Lines:
    """Return the help of every command."""
    names = ["", *(name for name, _ in walk())]
    return {
        f"dualtaxi {name} --help".replace("  ", " "): CliRunner()
        .invoke(cli, [*name.split(), "--help"], terminal_width=100)
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
        return [*lines, *mask.lines(f"key: {path}" for each in objects for path in key_paths(each))]
    printed = [*done.stdout.splitlines(), *(f"stderr: {line}" for line in done.stderr.splitlines())]
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


# --- files ----------------------------------------------------------------------------------------------


def write(file: Path, inventory: Lines) -> None:
    """Write an inventory as text: a heading, then its lines, indented."""
    parts = [f"{name}\n" + "".join(f"    {line}\n" for line in lines) for name, lines in inventory.items()]
    file.write_text("".join(parts), encoding="utf-8")


def read(file: Path) -> Lines:
    """Return an inventory from its text."""
    inventory: Lines = {}
    name = ""
    for line in file.read_text(encoding="utf-8").splitlines():
        if line.startswith("    "):
            inventory[name].append(line[4:])
        elif line:
            name = line
            inventory[name] = []
    return inventory


def differences(kept: Lines, found: Lines, is_gone: Callable[[str, str], bool]) -> list[str]:
    """Return what is missing and what is new, a line each; what may be gone is left out."""
    result = []
    for name in dict.fromkeys([*kept, *found]):
        before, now = kept.get(name, []), found.get(name, [])
        result += [
            f"missing: {name}: {line}" for line in before if line not in now and not is_gone(name, line)
        ]
        result += [f"new: {name}: {line}" for line in now if line not in before]
    return result
