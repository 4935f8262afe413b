from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from robcal.errors import InvalidInput
from robcal.files.yaml_io import FlowMapping, read_yaml, yaml_text


def written(folder: Path, text: str) -> Path:
    path = folder / "file.yaml"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


def test_numbers_and_words_follow_yaml_1_2(tmp_path: Path) -> None:
    data = read_yaml(written(tmp_path, "a: 1e-6\nb: 017\nc: on\nd: 2020-01-01\ne: .5\nf: -3\ng: ~\nh: 1.5e+3\n")).data
    assert data == {"a": 1e-6, "b": 17, "c": "on", "d": "2020-01-01", "e": 0.5, "f": -3, "g": None, "h": 1500.0}


def test_lines_are_known_for_messages(tmp_path: Path) -> None:
    document = read_yaml(written(tmp_path, "a: 1\nb:\n  c: 2\n  d: [1,\n      2]\n"))
    assert document.line(("b", "c")) == 3
    assert document.line(("b", "d", 1)) == 5
    assert document.line(("b", "missing")) == 2


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("a: 1\na: 2\n", "line 2: key 'a' stands twice"),
        ("a: [1, 2\n", "not valid YAML"),
        ("- 1\n- 2\n", "must be a YAML mapping"),
        ("a: !!python/object/apply:os.system ['true']\n", "not valid YAML"),
        ("a: &x [1]\nb: {<<: *x}\n", "merge key"),
        ("a: &a [*a]\n", "levels deep"),
        ("? [1, 2]\n: 3\n", "key must be a word"),
        ("", "must be a YAML mapping"),
        ("a: " + "[" * 60 + "]" * 60, "levels"),
    ],
)
def test_hostile_or_broken_files_are_refused_in_one_sentence(tmp_path: Path, text: str, word: str) -> None:
    with pytest.raises(InvalidInput, match=r"file\.yaml") as error:
        read_yaml(written(tmp_path, text))
    assert word in str(error.value)
    assert "\n" not in str(error.value)


def test_alias_bomb_is_refused_quickly(tmp_path: Path) -> None:
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 12)]
    with pytest.raises(InvalidInput, match="aliases"):
        read_yaml(written(tmp_path, "\n".join(lines)))


def test_other_encodings_missing_files_and_folders(tmp_path: Path) -> None:
    path = tmp_path / "latin.yaml"
    path.write_bytes("a: 1\nname: Zelle \xe4\n".encode("latin-1"))
    with pytest.raises(InvalidInput, match="line 2: not UTF-8"):
        read_yaml(path)
    with pytest.raises(InvalidInput, match="no such file"):
        read_yaml(tmp_path / "none.yaml")
    with pytest.raises(InvalidInput, match="folder"):
        read_yaml(tmp_path)


@given(st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=1, max_size=5))
def test_floats_written_read_back_exactly_also_by_other_readers(values: list[float]) -> None:
    text = yaml_text({"row": FlowMapping(values=values)})
    assert yaml.safe_load(text)["row"]["values"] == values
