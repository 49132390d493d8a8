"""The store of results: rows are found by all of their key, torn lines go, foreign files stay."""

import json
import resource
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from iga_drake.aligners.registry import make_aligner
from iga_drake.evaluation.results import (
    ResultsError,
    ResultsStore,
    aligner_key,
    code_key,
    folder_digest,
    text_digest,
)
from iga_drake.files import OutputError

KEY = {"kind": "tea", "options": {"a": 1, "b": [2]}, "seed": 3}


def test_a_row_is_found_by_all_of_its_key(tmp_path: Path) -> None:
    path = tmp_path / "new" / "results.jsonl"
    ResultsStore(path).add(KEY, {"success": True})
    store = ResultsStore(path)
    assert store.get({"seed": 3, "options": {"b": [2], "a": 1}, "kind": "tea"}) == {"success": True}
    assert store.get(KEY | {"seed": 4}) is None
    assert store.get(KEY | {"options": {"a": 1}}) is None
    assert store.get({"kind": "tea", "seed": 3}) is None
    assert list(store.rows()) == [(KEY, {"success": True})]


def test_a_torn_line_is_dropped_and_the_next_one_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "results.jsonl"
    ResultsStore(path).add(KEY, {"success": True})
    whole = path.read_text()
    for cut in (1, 5, len(whole) // 2, len(whole) - 1):  # power was cut here
        path.write_text(whole + whole[:cut])
        store = ResultsStore(path)
        assert path.read_text() == whole
        store.add(KEY | {"seed": 4}, {"success": False})
        lines = [json.loads(line) for line in path.read_text().splitlines()]
        assert [row["key"]["seed"] for row in lines] == [3, 4]
    assert [p.name for p in tmp_path.iterdir()] == ["results.jsonl"]


@pytest.mark.parametrize(
    ("content", "line"),
    [
        (b"name,price\n", 1),
        (b"a note without an end of line", 1),
        (b'{"key": {}, "result": {}}\n{"success": true}\n', 2),
        (b'{"key": {}, "result": {}}\nname', 2),
        (b'{"key": {}, "result": 3}\n', 1),
        (b"[1]\n", 1),
        (b"\xff\xfe\n", 1),
    ],
)
def test_a_foreign_file_is_refused_and_left_alone(content: bytes, line: int, tmp_path: Path):
    path = tmp_path / "results.jsonl"
    path.write_bytes(content)
    with pytest.raises(ResultsError, match=rf"results\.jsonl, line {line}: not a result"):
        ResultsStore(path)
    assert path.read_bytes() == content


def test_a_full_disk_leaves_whole_rows(tmp_path: Path) -> None:
    store = ResultsStore(tmp_path / "results.jsonl")
    store.add(KEY, {"success": True})
    whole = store.path.read_bytes()
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(whole) + 20, before[1]))
    try:
        with pytest.raises(ResultsError, match=r"results\.jsonl: can't be written"):
            store.add(KEY | {"seed": 4}, {"success": True})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert store.path.read_bytes() == whole
    store.add(KEY | {"seed": 4}, {"success": False})
    assert len(list(ResultsStore(store.path).rows())) == 2


@pytest.mark.parametrize("place", ["", "/dev/full", "file/results.jsonl"])
def test_places_where_no_results_can_be_written(tmp_path: Path, place: str) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OutputError):
        ResultsStore(tmp_path / place)


def test_threads_may_share_a_store(tmp_path: Path) -> None:
    store = ResultsStore(tmp_path / "results.jsonl")
    with ThreadPoolExecutor(8) as executor:
        list(executor.map(lambda seed: store.add({"seed": seed}, {"seed": seed}), range(200)))
    again = ResultsStore(store.path)
    assert sorted(key["seed"] for key, _ in again.rows()) == list(range(200))


def test_digests_tell_contents_apart(tmp_path: Path) -> None:
    assert text_digest("a") == "ca978112ca1bbdca"  # of SHA-256 as published
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "a").write_text("tea")
    assert folder_digest(tmp_path / "one") == folder_digest(tmp_path / "two") != ""
    (tmp_path / "two" / "a").write_text("Tea")
    assert folder_digest(tmp_path / "one") != folder_digest(tmp_path / "two")
    assert folder_digest(tmp_path / "none") == ""


def test_the_code_of_other_packages_counts(tmp_path: Path, monkeypatch) -> None:
    class Mine:
        pass

    assert code_key() == code_key(None) == code_key(ResultsStore(tmp_path / "none"))
    assert code_key(Mine()).startswith(code_key() + "+")


def test_weights_are_part_of_the_key(tmp_path: Path) -> None:
    icp = aligner_key(make_aligner("icp", starts=8), "icp", {"starts": 8})
    assert icp == {"aligner": "icp", "options": {"starts": 8}, "weights": ""}
    keys = [
        aligner_key(make_aligner("iga", **options), "iga", {})["weights"]
        for options in ({}, {"familiarity": None})
    ]
    assert keys[0].startswith(keys[1] + "+")
