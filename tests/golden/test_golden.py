"""Numbers of the published records, bits of trainings and names of runs are those that are in the folder kept/.

A change that is meant is written by `tests/golden/write.py NAME`, and its difference is read before a commit.
"""

import json
from collections import Counter
from typing import Any

import pytest
import today
import write
from interrupted import run_through_kills


def kept(name: str) -> Any:
    return json.loads((write.KEPT / f"{name}.json").read_text())


@pytest.mark.parametrize("name", write.NUMBERS)
def test_the_numbers_of_published_records_are_kept(name):
    """Catches a number of a table, a comparison or the page that changes, or that is lost, as code moves."""
    differing = write.differing(write.kept_numbers(name), write.NUMBERS[name]())
    assert not differing, "\n".join([f"{len(differing)} numbers", *differing[:20]])


def test_the_numbers_in_readme_and_docs_are_kept():
    """Catches a number that the tables of README and docs lose; words, order and more numbers are free."""
    present = today.blocks()
    for name, numbers in kept("blocks").items():
        lost = Counter(numbers) - Counter(present[name])
        assert not lost, f"{name}: {sorted(lost)[:20]}"


@pytest.mark.parametrize("command", write.COMMANDS)
def test_the_name_and_hash_of_a_run_are_kept(command):
    """Catches a run that is trained again, or written elsewhere, because its settings are called otherwise."""
    assert today.identity(command.split()) == kept("names")[command]


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    return write.trainings(tmp_path_factory.mktemp("trainings"))


@pytest.mark.parametrize("name", write.TRAININGS)
def test_a_training_keeps_its_bits(name, trained):
    """Catches an operation of a training, its order or its random numbers that change; one bit is enough."""
    assert trained[name] == kept("trainings")[name]


def test_a_training_that_is_killed_ends_with_the_same_bits(trained, tmp_path, monkeypatch):
    """Catches something that the next step depends on and a checkpoint lacks."""
    name, saves = write.RESUMED
    data = write.write_moving_square(tmp_path / "data")
    words = write.words_of(name, data, tmp_path / "results")
    ended = run_through_kills(saves, monkeypatch, lambda: today.train(words))
    assert today.bits(*ended) == trained[name]
