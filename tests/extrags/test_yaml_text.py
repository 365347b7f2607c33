"""YAML of others: small files that stand for far more than they hold."""

from __future__ import annotations

import pytest
import yaml

from extrags.yaml_text import read_yaml

LOADERS = [yaml.SafeLoader, getattr(yaml, "CSafeLoader", yaml.SafeLoader)]


def aliases_of_aliases(levels: int, entry: str) -> str:
    """Ten of the level below in each; `entry` takes the ten names."""
    lines = ["a0: &a0 {x: 1}"]
    for level in range(1, levels):
        lines += [f"a{level}: &a{level} {entry.format(', '.join([f'*a{level - 1}'] * 10))}"]
    return "\n".join(lines)


@pytest.mark.parametrize("loader", LOADERS)
class TestReadYaml:
    def test_what_it_holds(self, loader: type) -> None:
        assert read_yaml("a: [1, 2.5, word]\nb: {c: null}", loader) == {
            "a": [1, 2.5, "word"],
            "b": {"c": None},
        }

    def test_aliases_and_merges_of_a_settings_file(self, loader: type) -> None:
        text = "base: &base {x: 1, y: 2}\nown: {<<: *base, y: 3}\nlist: [*base]"
        found = read_yaml(text, loader)
        assert found["own"] == {"x": 1, "y": 3}
        assert found["list"] == [{"x": 1, "y": 2}]

    @pytest.mark.parametrize("entry", ["[{}]", "{{<<: [{}]}}"])
    def test_aliases_of_aliases(self, loader: type, entry: str) -> None:
        with pytest.raises(ValueError, match=r"stand for more than 1000000 values \(line 7\)"):
            read_yaml(aliases_of_aliases(20, entry), loader)

    def test_a_value_that_holds_itself(self, loader: type) -> None:
        with pytest.raises(ValueError, match=r"\*a stands for what it is a part of \(line 1\)"):
            read_yaml("&a [1, *a]", loader)

    def test_nested_too_deeply(self, loader: type) -> None:
        # The parser in C would end the process.
        with pytest.raises(ValueError, match="nested too deeply"):
            read_yaml("[" * 200_000, loader)

    def test_an_alias_of_nothing(self, loader: type) -> None:
        with pytest.raises(ValueError, match="undefined alias"):
            read_yaml("a: *b", loader)

    def test_no_yaml(self, loader: type) -> None:
        with pytest.raises(ValueError, match="flow node"):
            read_yaml("a: [", loader)


def test_no_objects_of_python() -> None:
    with pytest.raises(ValueError, match="could not determine a constructor"):
        read_yaml("!!python/object/apply:os.getcwd []")
    with pytest.raises(TypeError, match="UnsafeLoader"):
        read_yaml("1", yaml.UnsafeLoader)
