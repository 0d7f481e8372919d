"""Secrets, removed from what is recorded of command lines, addresses and sources.

A secret is known by the name it has (`--api-key`, `HF_TOKEN = "..."`), by its shape (`ghp_...`, an address
with a password), or because it is the value of an environment variable with such a name.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any, Final

REDACTED: Final = "[redacted]"
SECRET_NAMES: Final = (
    "token",
    "secret",
    "password",
    "passwd",
    "passphrase",
    "key",
    "credential",
    "cookie",
    "authorization",
)
"""A name that contains one of these, in any case, names a secret; `tokenizer` does not."""
_MIN_VARIABLE: Final = 12
"""The shortest value of an environment variable that is looked for; shorter ones are words."""
_NAME: Final = re.compile("|".join(SECRET_NAMES).replace("token", "token(?!i[sz])"), re.IGNORECASE)
_FILE: Final = re.compile(
    r"""
    \.env | .*\.env$ | [._](?:netrc|pypirc|npmrc|pgpass|htpasswd|boto|s3cfg|dockercfg)$ | \.(?:ssh|aws|gnupg)$
    | .*\.(?:pem|key|p12|pfx|p8|ppk|jks|keystore|kdbx|gpg|asc)$
    | id_(?:(?:rsa|dsa|ecdsa|ed25519).*|[^.]*)$
    | .*(?:credential | secret(?!ar) | passw(?:or)?d | service[_-]?account)
    """,
    re.IGNORECASE | re.VERBOSE,
)
"""Names of files and folders that hold secrets; a `secretary` has none."""
SETTINGS_FILES: Final = (".toml", ".yaml", ".yml", ".json", ".cfg", ".ini", ".xml")
"""Ends of the names of settings files, which hold secrets if they have the name of one: `api-key.json`."""
_HARMLESS: Final = re.compile(r"\d{1,5}|\d?\.\d{1,5}|true|false|none|null", re.IGNORECASE)
"""Values that stay, such as 512 in `--max-tokens 512`, unless the name has `pass`."""
_BUT_TOKEN: Final = (
    "secret|passw(?:or)?d|passphrase|credential|authorization|cookie|"
    "(?:api|access|private|auth|account|signing|encryption)[_-]?key"
)
"""In sources a mere `key` is seldom a secret: `sort(key="length")`."""
_IN_SOURCES: Final = rf"(?:token(?!i[sz])|{_BUT_TOKEN})"
_OF_MODELS: Final = (
    "embed(?:ding)?s?|dims?|types?|size|len(?:gth)?|level|counts?|num|per|budget|limit|schedule|ids?|index|"
    "positions?|masks?|mix(?:er|ing)?|drop(?:out)?|shift|merging|pruning|padding|vocab|weights?|loss|rate"
)
"""Words after `token` that speak of a model's tokens."""
_SECRET_SETTING: Final = re.compile(
    rf"{_BUT_TOKEN}|token(?!i[sz]|s?[_-]?(?:{_OF_MODELS})(?![a-z]))", re.IGNORECASE
)
"""A path of keys: `hf_token` is a secret, but not `token_embedding`."""
_PLACEHOLDERS: Final = "{$<%["
_PLACEHOLDER: Final = re.compile(r"(?:\$?\{.*\}|<.*>|\[.*\]|\$[A-Z_][A-Z0-9_]*|%\w+%)?")
"""A whole setting that stands for a value: a password may begin as one does."""
_AFTER_NAME: Final = (
    r"[\w-]{0,40}[\"']?\]?(?:(?:\s{0,3}:\s{0,3}[\w.\[\]| ]{1,30})?\s{0,3}[:=]\s{0,3}|"
    r"(?<=[\"'])\s{0,3},\s{0,3}|"
    r"[^\"'\n]{0,60}default\s?=\s?)"
)
SHAPES: Final = (
    (
        "private keys",
        r"-----BEGIN [A-Z ]{0,30}PRIVATE KEY-----(?:[^-]|-(?!----)|-(?=-----END)){0,20000}"
        r"-----END [A-Z ]{0,30}PRIVATE KEY-----",
    ),
    ("AWS", r"\b(?:AKIA|ASIA)[0-9A-Z]{16}\b"),
    ("GitHub", r"\b(?:gh[pousr]_[A-Za-z0-9]{30,255}|github_pat_[A-Za-z0-9_]{22,255})"),
    ("GitLab", r"\bglpat-[\w-]{20,100}"),
    ("Slack", r"\bxox[abeoprs]-[\w-]{10,250}"),
    ("OpenAI, Anthropic", r"\bsk-[A-Za-z0-9][\w-]{19,250}"),
    ("Hugging Face", r"\bhf_[A-Za-z0-9]{30,100}"),
    ("Google", r"\bAIza[\w-]{35}|\bya29\.[\w-]{20,500}"),
    ("npm, PyPI", r"\bnpm_[A-Za-z0-9]{36}\b|\bpypi-[\w-]{50,300}"),
    ("Stripe", r"\b[rs]k_(?:live|test)_[A-Za-z0-9]{16,100}"),
    ("SendGrid", r"\bSG\.[\w-]{16,40}\.[\w-]{16,60}"),
    ("Replicate", r"\br8_[A-Za-z0-9]{37}\b"),
    ("this project's servers", r"\bdualtaxi_[\w-]{40,60}"),
    ("JSON web tokens", r"\beyJ[\w-]{8,2000}\.eyJ[\w-]{8,4000}\.[\w-]{8,2000}"),
    ("bearer tokens", r"(?<=Bearer )[\w.~+/-]{16,500}=*"),
)
"""Tokens known by their shape: what they are for, and a regular expression."""
_HINTS: Final = (
    "token",
    "secret",
    "pass",
    "key",
    "credential",
    "cookie",
    "auth",
    "bearer ",
    "://",
    "akia",
    "asia",
    "gho_",
    "ghp_",
    "ghu_",
    "ghs_",
    "ghr_",
    "github_pat_",
    "glpat-",
    "xox",
    "sk-",
    "hf_",
    "aiza",
    "ya29.",
    "npm_",
    "pypi-",
    "k_live_",
    "k_test_",
    "sg.",
    "r8_",
    "dualtaxi_",
    "eyj",
)
"""Each secret that is known by its name or shape has one of these around it, in any case."""
_SHAPES: Final = re.compile("|".join(shape for _, shape in SHAPES))
_KEY_BEGIN: Final = re.compile(r"-----BEGIN [A-Z ]{0,30}PRIVATE KEY-----")
_KEY_END: Final = re.compile(r"-----END [A-Z ]{0,30}PRIVATE KEY-----")
_MAX_KEY_LINES: Final = 200
_ADDRESS: Final = re.compile(r"(?<=://)(?!git@)[^\s/@\"'<>]{1,500}(?=@)")
_PARAMETER: Final = re.compile(
    rf"([?&][\w-]{{0,40}}{_IN_SOURCES}[\w-]{{0,40}}=)[^&\s\"'\[]{{1,500}}", re.IGNORECASE
)
_QUOTED: Final = re.compile(
    rf"({_IN_SOURCES}{_AFTER_NAME}[rbfuRBFU]?)(\"[^\"\n]{{4,2000}}\"|'[^'\n]{{4,2000}}')", re.IGNORECASE
)
_LONG_KEY: Final = re.compile(
    r"(key[\"']?\]?\s{0,3}[:=]\s{0,3})([\"'])(?=[\w+/=.-]{0,200}\d)[\w+/=.-]{20,200}\2", re.IGNORECASE
)
_BARE: Final = re.compile(
    rf"({_IN_SOURCES}[\w-]{{0,40}}[ \t]{{0,3}}[:=][ \t]{{0,3}})"
    r"(?=[\w+/=~-]{0,200}\d)[\w+/=~-]{16,500}(?=[\s;&|]|$)",
    re.IGNORECASE,
)
"""Without quotes, as in shell scripts and YAML: only what is long and has a digit."""


def is_secret_file(path: str) -> bool:
    """Return whether a file, or a folder that it is in, has a name under which secrets are kept.

    Args:
        path: with `/` between its parts.
    """
    name = path.rpartition("/")[2]
    return any(map(_FILE.match, path.split("/"))) or (name.endswith(SETTINGS_FILES) and is_secret_name(name))


@lru_cache(1024)
def is_secret_name(name: str) -> bool:
    """Return whether a value of this name is taken for a secret."""
    return _NAME.search(name) is not None


def redacted_arguments(arguments: Sequence[str], variables: Mapping[str, str] = os.environ) -> list[str]:
    """Return the arguments of a command with secrets replaced by `[redacted]`."""
    safe: list[str] = []
    is_value_secret = False
    for argument in arguments:
        name, equals, value = argument.partition("=")
        if is_value_secret and not argument.startswith("--") and not _stays(safe[-1], argument):
            safe.append(REDACTED)
        elif equals and is_secret_name(name) and not _stays(name, value) and "://" not in name:
            safe.append(f"{name}={REDACTED}")
        else:
            safe.append(redacted_text(argument, variables))
        is_value_secret = argument.startswith("-") and not equals and is_secret_name(argument)
    return safe


def _stays(name: str, value: str) -> bool:
    return "pass" not in name.lower() and _HARMLESS.fullmatch(value) is not None


def redacted_text(text: str, variables: Mapping[str, str] = os.environ) -> str:
    """Return a source, a patch or an address with secrets replaced by `[redacted]`."""
    for value in _secrets_among(frozenset(variables.items())):
        text = text.replace(value, REDACTED)
    text = _SHAPES.sub(REDACTED, text)
    text = _ADDRESS.sub(REDACTED, text)
    text = _PARAMETER.sub(rf"\g<1>{REDACTED}", text)
    text = _QUOTED.sub(_without_value, text)
    text = _LONG_KEY.sub(rf"\g<1>\g<2>{REDACTED}\g<2>", text)
    return _BARE.sub(rf"\g<1>{REDACTED}", text)


def redacted_line(text: str) -> str:
    """Return a line of output as `redacted_text` does, quickly where nothing in it hints at a secret."""
    lowered = text.lower()
    secrets = _secrets_among(frozenset(os.environ.items()))
    if any(hint in lowered for hint in _HINTS) or any(value in text for value in secrets):
        return redacted_text(text)
    return text


def redacted_settings(value: Any, name: str = "") -> Any:
    """Return settings, as JSON has them, with secrets replaced by `[redacted]`.

    As in sources, a mere `key` in a name does not count, nor `token` before a word of models, unless the
    value is long and has a digit. Placeholders such as `${TOKEN}` and `<pad>` stay. All parts of a mapping
    with the name of a secret are secrets. Of numbers, only whole ones are, and not under `token`:
    `max_tokens` is a setting.
    """
    if isinstance(value, dict):
        return {key: redacted_settings(part, f"{name}.{key}" if name else key) for key, part in value.items()}
    if isinstance(value, list):
        return [redacted_settings(part, name) for part in value]
    if isinstance(value, int) and not isinstance(value, bool):
        is_secret = _SECRET_SETTING.search(name.lower().replace("token", "")) and not _stays(name, str(value))
        return REDACTED if is_secret else value
    if not isinstance(value, str):
        return value
    if _SECRET_SETTING.search(name) and not _stays(name, value) and not _PLACEHOLDER.fullmatch(value):
        return REDACTED
    word = re.sub(r"\W", "_", name)
    return redacted_line(f"{word}: {value}").partition(": ")[2]


class LineRedactor:
    """Redacts the lines of an output one after the other, and every line of a private key."""

    def __init__(self) -> None:
        self._key_lines = 0
        """The most lines that the private key which has begun still has."""

    def __call__(self, text: str) -> str:
        """Return the next line without secrets."""
        if self._key_lines:
            self._key_lines = 0 if _KEY_END.search(text) else self._key_lines - 1
            return REDACTED
        if (begin := _KEY_BEGIN.search(text)) and not _KEY_END.search(text):
            self._key_lines = _MAX_KEY_LINES
            return redacted_line(text[: begin.start()]) + REDACTED
        return redacted_line(text)


@lru_cache(1)
def _secrets_among(variables: frozenset[tuple[str, str]]) -> tuple[str, ...]:
    """Return the values of the environment variables with the names of secrets, the longest first."""
    values = {
        value
        for name, value in variables
        if len(value) >= _MIN_VARIABLE and is_secret_name(name) and "\n" not in value
    }
    return tuple(sorted(values, key=len, reverse=True))


def _without_value(match: re.Match[str]) -> str:
    """Return an assignment without its value; a placeholder such as `"${TOKEN}"` stays."""
    name, quoted = match[1], match[2]
    if quoted[1] in _PLACEHOLDERS or _stays(name, quoted[1:-1]):
        return match[0]
    return f"{name}{quoted[0]}{REDACTED}{quoted[0]}"
