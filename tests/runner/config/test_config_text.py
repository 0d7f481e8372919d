"""Texts and files that are not configurations: each is refused quickly and in one line."""

import pytest

from runner.config import load
from runner.errors import ConfigError


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("", "x.yaml:1:1: the file is empty, expected at least `episodes`"),
        ("# nothing\n", "x.yaml:1:1: the file is empty, expected at least `episodes`"),
        ("- 1\n", "x.yaml:1:1: found a list of 1, expected keys and values, such as episodes: 1000"),
        ("hello", "x.yaml:1:1: found 'hello', expected keys and values, such as episodes: 1000"),
        ("a: [1, 2\nb: 3", "x.yaml:2:2: cannot be read as YAML: expected ',' or ']', but got ':'"),
        ("a: b: c", "x.yaml:1:5: cannot be read as YAML: mapping values are not allowed here"),
        (
            "a: 1\n\tb: 2",
            "x.yaml:2:1: cannot be read as YAML: found character '\\t' that cannot start any token",
        ),
        ("a: 1\n---\nb: 2", "x.yaml:2:1: cannot be read as YAML: found another document"),
        ("a: *b", "x.yaml:1:4: cannot be read as YAML: found undefined alias 'b'"),
        (b"episodes: 1\n\xff\xfe\x00", "x.yaml:2:1: found the byte 0xff, expected text in UTF-8"),
        ("episodes: 1\na: \x00", "x.yaml:2:4: cannot be read as YAML: the character U+0000"),
        ("a: " + "[" * 5000, "x.yaml:1:53: cannot be read as YAML: nested deeper than 50 levels"),
        ("a: &a [*a]", "x.yaml:1:4: cannot be read as YAML: aliases make it too large: more than 50 levels"),
        ("a: [" + "1," * 100_001 + "]", "cannot be read as YAML: more than 100000 values"),
        ("a: " + "x" * (1 << 20), "x.yaml: larger than 1.0 MB, expected a configuration of a few kilobytes"),
    ],
)
def test_text_that_is_not_a_configuration_is_refused(errors_of, text, line):
    (found,) = errors_of(text)
    assert found.endswith(line)


def test_expanded_aliases_are_bounded(errors_of):
    levels = "".join(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]\n" for n in range(1, 10))
    (line,) = errors_of(f"a0: &a0 [1, 1]\n{levels}")
    assert line.endswith("cannot be read as YAML: aliases make it too large: more than 100000 values")


def test_a_number_of_too_many_digits_is_refused(errors_of):
    (line,) = errors_of("episodes: " + "9" * 10_000)
    assert line.startswith("x.yaml:1:1: episodes: found 9999")
    assert line.endswith("which is no whole number of a usable size")
    assert len(line) < 200


def test_a_missing_file_is_reported(tmp_path):
    (tmp_path / "quick.yaml").write_text("episodes: 1")
    with pytest.raises(ConfigError, match=r"quik\.yaml: no such file\. Did you mean 'quick\.yaml'\?"):
        load(tmp_path / "quik.yaml")
    with pytest.raises(ConfigError, match=r"no such file\. `dualtaxi config ls`"):
        load(tmp_path / "nowhere" / "x.yaml")
    with pytest.raises(ConfigError, match=r"no such file\. `dualtaxi config ls`"):
        load(tmp_path / "other")
    with pytest.raises(ConfigError, match="found a directory, expected a YAML file"):
        load(tmp_path)
    (tmp_path / "loop.py").write_text("import runner\nwith runner.record(env) as rec: ...\n")
    with pytest.raises(ConfigError, match="found a Python file, expected a YAML file"):
        load(tmp_path / "loop.py")
    with pytest.raises(ConfigError, match="cannot be read"):
        load(tmp_path / "quick.yaml" / "x.yaml")
    with pytest.raises(ConfigError, match="cannot be read"):
        load("\0")


def test_a_file_name_that_is_not_a_valid_name_is_refused(tmp_path):
    path = tmp_path / "my file.yaml"
    path.write_text("episodes: 1")
    with pytest.raises(
        ConfigError, match=r"name: missing, and the file's name, 'my file', cannot be it: expected 1 to"
    ):
        load(path)
