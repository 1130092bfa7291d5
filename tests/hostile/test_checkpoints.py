"""Hostile checkpoints: any flipped bit and any misshapen tensor is one line, never a crash or a wrong continuation."""

import hashlib
import io
import os
import random
import sys
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from tiny_run import overrides, run_here

from gsbench.errors import InputError
from gsbench.gates.finished import gate_finished
from gsbench.measure import record
from gsbench.run.load import load_run, scene_of
from gsbench.run.setup import build, load_scene
from gsbench.scenes.points import random_points
from gsbench.train import checkpoint
from gsbench.train.batches import generator
from gsbench.train.checkpoint import Checkpoint
from gsbench.train.loop import Trainer

SAMPLE, ALL = 40, 500


@pytest.fixture(scope="module")
def folder(square: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run of 7DGS with AGR, with everything that a checkpoint can hold."""
    words = ("model=7dgs", "train.iterations=20", "train.densify.every=5", "train.densify.start=1")
    record, folder = run_here(*overrides(square, tmp_path_factory.mktemp("run"), *words))
    assert record.status == "ok", record.reason
    return folder


def trainer(folder: Path) -> Trainer:
    """A trainer of the run's config, before step 0."""
    config = load_run(folder).config
    scene = load_scene(config)
    model = build(config)
    model.initialise(random_points(40, 1.3, generator(0)), scene.extent, generator(0))
    return Trainer(model, scene, scene.test, config)


def leaves(state: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The paths to everything in a nested state, the branches too."""
    members = state.items() if isinstance(state, dict) else enumerate(state) if isinstance(state, list | tuple) else ()
    return [path, *(leaf for key, value in members for leaf in leaves(value, (*path, key)))]


def replaced(state: Any, path: tuple[Any, ...], change: Callable[[Any], Any]) -> Any:
    """A copy of a nested state with `change` applied to what lies at `path`."""
    if not path:
        return change(state)
    if isinstance(state, dict):
        return {key: replaced(value, path[1:], change) if key == path[0] else value for key, value in state.items()}
    return type(state)(replaced(value, path[1:], change) if i == path[0] else value for i, value in enumerate(state))


HARMS: list[Callable[[torch.Tensor], Any]] = [
    lambda x: x[:-1] if x.dim() else x[None],
    *(lambda x: x.to(torch.float16), lambda x: x.double(), lambda x: x[None], lambda x: x.new_zeros(0)),
    *(lambda x: x.to_sparse(), lambda x: x.to("meta"), lambda x: x.flatten()[: x.numel() // 2]),
    lambda x: torch.zeros(1).expand((*x.shape[:1], 7) if x.dim() else (3,)),
    *(lambda _: "text", lambda _: None),
]


def harm(draw: random.Random, value: Any) -> Any:
    """A tensor, number or container of the wrong shape, type or value."""
    if isinstance(value, torch.Tensor):
        return draw.choice(HARMS)(value)
    return draw.choice((None, "text", -1, 10**30, [], {}, torch.zeros(3)))


@pytest.mark.parametrize("seeds", [range(SAMPLE), pytest.param(range(SAMPLE, ALL), marks=pytest.mark.slow)])
def test_misshapen_states_are_refused(seeds, folder):
    """Catches Adam moments of another shape (a segmentation fault in the kernel), and states of other types."""
    whole = checkpoint.read(folder / checkpoint.FILE_NAME)
    paths, fitted, refused = leaves(whole.state), trainer(folder), 0
    for seed in seeds:
        draw = random.Random(seed)
        path = draw.choice(paths)
        state = replaced(whole.state, path, lambda value, draw=draw: harm(draw, value))
        try:
            fitted.load_state_dict(state)
            fitted.model.set_active(fitted.schedule.active(5))
            fitted.train_step()  # a tensor of the wrong shape that was accepted would crash here
        except InputError as error:
            refused += "\n" not in str(error)
        except Exception as error:
            raise AssertionError(f"case {seed}: {path}: {type(error).__name__}: {error}") from error
    assert refused > 0.8 * len(seeds)


def test_every_flipped_bit_is_noticed(folder, tmp_path):
    """Catches a training that goes on from numbers that a disk has damaged, as no bit of the file may change; and a
    process that hangs at a pipe or reads /dev/zero without end."""
    content = (folder / checkpoint.FILE_NAME).read_bytes()
    path = tmp_path / checkpoint.FILE_NAME
    draw = random.Random(0)
    for place in [0, 30, 90, len(content) - 1, *(draw.randrange(len(content)) for _ in range(SAMPLE))]:
        damaged = bytearray(content)
        damaged[place] ^= 1 << draw.randrange(8)
        path.write_bytes(damaged)
        with pytest.raises(InputError, match=r"expected a checkpoint, got"):
            checkpoint.read(path)
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", Path("/dev/zero"), tmp_path):
        with pytest.raises(InputError, match="something that is not a file"):
            checkpoint.read(path)


def rewritten(folder: Path, to: Path, **changed: Any) -> Path:
    """Write the checkpoint of a run into another folder, with some of its parts changed and the right SHA-256."""
    checkpoint.save(to / checkpoint.FILE_NAME, replace(checkpoint.read(folder / checkpoint.FILE_NAME), **changed))
    return to


HOSTILE_STATES: dict[str, Callable[[dict[str, Any]], dict[str, Any]]] = {
    "a tensor without memory": lambda state: replaced(state, ("model", "splats.means"), lambda x: x.to("meta")),
    "a moment without memory": lambda state: replaced(state, ("density", "unseen"), lambda x: x.to("meta")),
    "a tensor that claims 4 TB": lambda state: replaced(
        state, ("model", "splats.means"), lambda _: torch.zeros(1).expand(10**12, 3)
    ),
    "gates as a tensor": lambda state: {**state, "hooks": state["hooks"] | {"gates": torch.zeros(3)}},
    "gates as a list": lambda state: {**state, "hooks": state["hooks"] | {"gates": [1]}},
    "a container in itself": lambda state: endless(state),
    "text for a state": lambda state: {**state, "model": "splats.means"},
    "a key that is a tensor": lambda state: {**state, "density": {torch.zeros(1): 1}},
}


def endless(state: dict[str, Any]) -> dict[str, Any]:
    """A state with a list that holds itself."""
    endless_list: list[Any] = []
    endless_list.append(endless_list)
    return {**state, "hooks": endless_list}


@pytest.mark.parametrize("name", HOSTILE_STATES)
def test_hostile_states_with_the_right_hash_are_one_line(name, folder, tmp_path):
    """Catches what a hash does not: someone else has written the file, hash and all."""
    fitted, whole = trainer(folder), checkpoint.read(folder / checkpoint.FILE_NAME)
    path = rewritten(folder, tmp_path, state=HOSTILE_STATES[name](whole.state)) / checkpoint.FILE_NAME
    with pytest.raises(InputError) as caught:
        fitted.load_state_dict(checkpoint.read(path).state)
    assert str(caught.value).isprintable()


def is_refused(folder: Path, what: str) -> bool:
    """Whether a run is refused in one line; any other error is a failure that says what was tried."""
    try:
        load_run(folder)
    except InputError as error:
        if "\n" in str(error):
            raise AssertionError(f"{what}: {error}") from error
        return True
    except Exception as error:
        raise AssertionError(f"{what}: {type(error).__name__}: {error}") from error
    return False


def test_any_byte_of_a_pickle_is_one_line(folder, tmp_path):
    """Catches an opcode that makes the reader of pickles raise an error of its own."""
    payload = (folder / checkpoint.FILE_NAME).read_bytes()[len(checkpoint.MAGIC) + checkpoint.DIGEST + 1 :]
    path, draw = tmp_path / checkpoint.FILE_NAME, random.Random(1)
    with zipfile.ZipFile(io.BytesIO(payload)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    (pickled,) = (name for name in members if name.endswith("data.pkl"))
    for case in range(SAMPLE):
        damaged = bytearray(members[pickled])
        for _ in range(draw.choice((1, 1, 3))):
            damaged[draw.randrange(len(damaged))] = draw.randrange(256)
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
            for name, content in members.items():
                archive.writestr(name, bytes(damaged) if name == pickled else content)
        digest = hashlib.sha256(buffer.getbuffer()).hexdigest().encode()
        path.write_bytes(b"".join((checkpoint.MAGIC, digest, b"\n", buffer.getvalue())))
        is_refused(tmp_path, f"case {case}")


def test_a_packed_checkpoint_is_not_unpacked(tmp_path):
    """Catches a file that fills a thousand times its size of memory before its tensors are checked."""
    buffer, packed = io.BytesIO(), io.BytesIO()
    torch.save({"training": "", "data": "", "state": {"x": torch.zeros(10**6)}}, buffer)
    with zipfile.ZipFile(buffer) as archive, zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as other:
        for name in archive.namelist():
            other.writestr(name, archive.read(name))
    digest = hashlib.sha256(packed.getbuffer()).hexdigest().encode()
    (tmp_path / "x.pt").write_bytes(b"".join((checkpoint.MAGIC, digest, b"\n", packed.getvalue())))
    with pytest.raises(InputError, match="got one that is packed, of 4000"):
        checkpoint.read(tmp_path / "x.pt")


def test_a_checkpoint_names_no_package_to_import(folder, tmp_path, monkeypatch):
    """Catches data.root=pkg://MODULE of a checkpoint, which imported that module, and names that leave the data."""
    (tmp_path / "evil").mkdir()
    (tmp_path / "evil" / "__init__.py").write_text("raise SystemExit('imported')")
    monkeypatch.syspath_prepend(str(tmp_path))
    config = checkpoint.read(folder / checkpoint.FILE_NAME).config
    hostile = {**config, "data": {**config["data"], "root": "pkg://evil"}}
    run = load_run(rewritten(folder, tmp_path, config=hostile))
    with pytest.raises(InputError, match=r"names 'pkg://evil', which would be imported.*--data-root"):
        scene_of(run)
    (tmp_path / record.FILE_NAME).write_bytes((folder / record.FILE_NAME).read_bytes())
    with pytest.raises(InputError, match="names 'pkg://evil'"):
        gate_finished(tmp_path, 0.05)
    assert "evil" not in sys.modules
    assert scene_of(run, config["data"]["root"]).name == "square"  # what the user names is taken
    for names in ({"name": "../square"}, {"released_as": "/etc"}, {"released_as": "a/../.."}):
        hostile = {**config, "scene": {**config["scene"], **names}}
        with pytest.raises(InputError, match="scene: expected a name"):
            load_run(rewritten(folder, tmp_path, config=hostile))


VALUES = (None, -1, 0, 10**30, 1e300, "", "text", "../..", "${oc.env:HOME}", "${seed}", "\0", "???", [], {}, [1], True)


WRONG: list[tuple[str, tuple[Any, ...], Any]] = [  # part of a checkpoint, where in it, a value that is refused
    ("config", ("train", "recipe_iterations"), 0),
    ("config", (), {}),
    ("config", ("seed",), "x"),
    ("config", ("train",), 3),
    ("config", ("data", "scenes"), ["${oc.env:HOME}"]),
    ("config", ("model", "name"), "nosuch"),
    ("scene", (), {}),
    ("scene", ("extent",), "x"),
    ("scene", ("up",), [0.0, 0.0, 0.0]),
]


def test_any_value_in_a_config_or_a_scene_is_one_line(folder):
    """Catches a division by recipe_iterations=0, and every other value that no run of gsbench has written."""
    whole, draw = checkpoint.read(folder / checkpoint.FILE_NAME), random.Random(2)
    paths = [(part, path) for part in ("config", "scene") for path in leaves(getattr(whole, part)) if path]
    cases = [(*each, draw.choice(VALUES)) for each in paths]
    refused = {}
    for part, path, value in [*WRONG, *draw.sample(cases, SAMPLE)]:
        state = replaced(getattr(whole, part), path, lambda _, value=value: value)
        with monkeyread(Checkpoint(**{**vars(whole), part: state})):
            refused[part, path, str(value)] = is_refused(folder, f"{part} {path} = {value!r}")
    assert all([*refused.values()][: len(WRONG)]), refused
    assert sum(refused.values()) > 0.4 * len(refused)


@contextmanager
def monkeyread(content: Checkpoint) -> Iterator[None]:
    """Let the reader find `content`, without writing a file for each case."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(checkpoint, "read", lambda *_: content)
        yield
