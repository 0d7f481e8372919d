"""Secrets do not get into recordings: by name, by shape, by the values of environment variables."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest

from runner.runs.provenance import VARIABLES
from runner.runs.redaction import (
    REDACTED,
    SECRET_NAMES,
    LineRedactor,
    is_secret_name,
    redacted_arguments,
    redacted_line,
    redacted_settings,
    redacted_text,
)


@pytest.mark.parametrize(
    ("arguments", "shown"),
    [
        (["--api-key", "abc", "--lr", "3"], ["--api-key", REDACTED, "--lr", "3"]),
        (["--api-key=abc", "x"], [f"--api-key={REDACTED}", "x"]),
        (["-token", "abc"], ["-token", REDACTED]),
        (["env.PASSWORD=1234"], [f"env.PASSWORD={REDACTED}"]),
        (["+secrets.hf=abc"], [f"+secrets.hf={REDACTED}"]),
        (["--password", "1234"], ["--password", REDACTED]),
        (["--max-tokens", "512", "--tokens=0.5"], ["--max-tokens", "512", "--tokens=0.5"]),
        (["--use-token", "--lr", "3"], ["--use-token", "--lr", "3"]),
        (["--tokenizer", "gpt2"], ["--tokenizer", "gpt2"]),
        (["https://me:pw@example.org/x"], [f"https://{REDACTED}@example.org/x"]),
        (["https://example.org/x?token=abc&n=1"], [f"https://example.org/x?token={REDACTED}&n=1"]),
        (['{"api_key": "abcdef"}'], [f'{{"api_key": "{REDACTED}"}}']),
        (["train.py", "--name", "monday"], ["train.py", "--name", "monday"]),
    ],
)
def test_arguments(arguments, shown):
    assert redacted_arguments(arguments, {}) == shown


@pytest.mark.parametrize("name", SECRET_NAMES)
def test_names(name):
    assert is_secret_name(f"MY_{name.upper()}_2")
    assert redacted_arguments([f"--my-{name}=hello"], {}) == [f"--my-{name}={REDACTED}"]


@pytest.mark.parametrize(
    "secret",
    [
        "AKIA" + "A1B2" * 4,
        "ghp_" + "a1B2" * 9,
        "github_pat_" + "a1B2" * 10,
        "glpat-" + "a1B2" * 5,
        "xoxb-1234567890-abc",
        "sk-proj-" + "a1B2" * 8,
        "sk-ant-api03-" + "a1B2" * 8,
        "hf_" + "aBcD" * 8,
        "AIza" + "a1B2c" * 7,
        "npm_" + "a1B2" * 9,
        "sk_live_" + "a1B2" * 6,
        "dualtaxi_" + "a1B2" * 10 + "xyz",
        "eyJhbGciOiJIUzI1NiJ9.eyJzdWIiOiIxMjM0NTY3ODkwIn0.dozjgNryP4J3jVmNHl0w5N_XgL0n3I9P",
        "-----BEGIN RSA PRIVATE KEY-----\nMIIEowIBAAKCAQEA\nabc=\n-----END RSA PRIVATE KEY-----",
    ],
)
def test_shapes(secret):
    text = redacted_text(f"x = '{secret}'  # mine\n+call({secret})\n", {})
    assert text == f"x = '{REDACTED}'  # mine\n+call({REDACTED})\n"
    if "\n" not in secret:
        assert redacted_line(f"using {secret}") == f"using {REDACTED}"


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ('WANDB_API_KEY = "0123abcd"', f'WANDB_API_KEY = "{REDACTED}"'),
        ("os.environ['HF_TOKEN'] = 'abcd1'", f"os.environ['HF_TOKEN'] = '{REDACTED}'"),
        ('password: str = "hunter22"', f'password: str = "{REDACTED}"'),
        (
            'parser.add_argument("--api-key", default="abcd")',
            f'parser.add_argument("--api-key", default="{REDACTED}")',
        ),
        ('wandb.login(key="' + "0a" * 20 + '")', f'wandb.login(key="{REDACTED}")'),
        ("export MY_TOKEN=abcdefgh12345678", f"export MY_TOKEN={REDACTED}"),
        ("  api_key: abcdefgh12345678", f"  api_key: {REDACTED}"),
        ("Authorization: Bearer abcdefgh12345678", f"Authorization: Bearer {REDACTED}"),
        ("git clone https://me:pw@example.org/a.git", f"git clone https://{REDACTED}@example.org/a.git"),
    ],
)
def test_sources(text, shown):
    assert redacted_text(text, {}) == shown
    assert redacted_line(text) == shown


@pytest.mark.parametrize(
    "text",
    [
        'runs.sort(key="mean_length")',
        'tokenizer_name = "gpt2-medium"',
        "token = get_token()",
        'TOKEN = "${MY_TOKEN}"',
        'TOKEN = os.environ["HF_TOKEN"]',
        '{"max_tokens": "512"}',
        "key, subkey = jax.random.split(key)",
        'commit = "047c836d80e0fb2bf26b1ab961230fa137523b25"',
        "git@example.org:team/project.git",
        "ssh://git@example.org/team/project.git",
        'for key in "wasd": pass',
    ],
)
def test_code_without_secrets_stays(text):
    assert redacted_text(text, {}) == text


@pytest.mark.parametrize(
    "name",
    [
        *("api_key", "API-KEY", "apiKey", "access_token", "accessTokenValue", "hf_token", "token", "tokens"),
        *("TOKEN_2", "AWS_SECRET_ACCESS_KEY", "password", "db_passwd", "client_secret", "secret_of_client"),
        *("private_key", "credentials", "authorization", "session_cookie", "passphrase"),
    ],
)
def test_settings_with_the_name_of_a_secret(name):
    inside = {"of": ["hello", {"a": "b"}]}
    found = redacted_settings({name: "hello", "more": {name: inside, "x": "hello"}})
    redacted = {"of": [REDACTED, {"a": REDACTED}]}
    assert found == {name: REDACTED, "more": {name: redacted, "x": "hello"}}


def test_settings_that_only_begin_like_a_secret_stay():
    settings = {
        "token_embedding": {"type": "learned", "size": 512, "path": "tokens/v2.json"},
        "token_level": "word",
        "tokenizer": {"name": "gpt2-medium"},
        "special_tokens": {"pad": "<pad>"},
        "max_tokens": "512",
        "a: b": "c: d",
    }
    assert redacted_settings(settings) == settings
    random = "0a1b2c3d4e5f6a7b8c9d"
    names = ("hf_token_v2", "token_postgres", "bot_token_prod", "telegramTokenProd", "vault_token_ci")
    for name, value in itertools.product(names, ("hunter2secret", "123456789:AAFx9k2L", "hvs.CAESIJ0a1b")):
        assert redacted_settings({name: value}) == {name: REDACTED}
    assert redacted_settings({"auth_tokenizer": "gpt2"}) == {"auth_tokenizer": "gpt2"}
    assert redacted_settings({"token_prod": random, "token_of": {"lab": random}}) == {
        "token_prod": REDACTED,
        "token_of": {"lab": REDACTED},
    }


def test_values_of_environment_variables():
    variables = {"DB_PASSWORD": "correct horse battery", "MY_KEY": "short", "HOME": "/home/a-long-name"}
    text = redacted_text("connect('correct horse battery', 'short', '/home/a-long-name')", variables)
    assert text == f"connect('{REDACTED}', 'short', '/home/a-long-name')"
    assert redacted_arguments(["correct horse battery"], variables) == [REDACTED]


def test_the_lists_are_documented():
    docs = Path(__file__).parents[3] / "docs"
    record, form = ((docs / name).read_text() for name in ("record-your-own.md", "recording-format.md"))
    for name in SECRET_NAMES:
        assert f"`{name}`" in record, name
    for pattern in VARIABLES:
        name = "SLURM_" if pattern.startswith("SLURM_") else pattern.rstrip("*")
        assert f"`{name}`" in form, pattern


@pytest.mark.parametrize(
    "text",
    [
        'os.environ.setdefault("WANDB_API_KEY", "a1b2c3d4e5")',
        'os.getenv("DB_PASSWORD", "a1b2c3d4e5")',
        "export WANDB_API_KEY=a1b2c3d4e5a1b2c3d4e5; python x.py",
        "------BEGIN PRIVATE KEY-----\n-a1b2c3d4e5\n------END PRIVATE KEY-----\n",
    ],
)
def test_secrets_in_calls_in_commands_and_in_removed_lines(text):
    assert "a1b2c3d4e5" not in redacted_text(text, {})


def test_a_variable_that_the_process_sets_itself_is_a_secret(monkeypatch):
    redacted_line("nothing")
    monkeypatch.setenv("SVC_TOKEN", "correcthorsebattery")
    assert redacted_line("it is correcthorsebattery") == f"it is {REDACTED}"


def test_a_private_key_that_is_printed_line_by_line():
    key = ["-----BEGIN RSA PRIVATE KEY-----", "MIIEowIBAAKCAQEA", "", "abc=", "-----END RSA PRIVATE KEY-----"]
    redact = LineRedactor()
    assert [redact(line) for line in ["before", "key: " + key[0], *key[1:], "after"]] == [
        "before",
        f"key: {REDACTED}",
        *[REDACTED] * 4,
        "after",
    ]
    redact(key[0])
    shown = [redact(f"line {k}") for k in range(300)]
    assert shown[0] == REDACTED
    assert shown[-1] == "line 299", "a key without an end hides a bounded number of lines"
