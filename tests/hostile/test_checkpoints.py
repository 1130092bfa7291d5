"""Hostile checkpoints: any flipped bit and any misshapen tensor is one line, never a crash or a wrong continuation."""

import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from tiny_run import gsbench, overrides, write_moving_square

from gsbench.errors import InputError
from gsbench.measure import record
from gsbench.run.load import load_run
from gsbench.run.setup import build, load_scene
from gsbench.scenes.points import random_points
from gsbench.train import checkpoint
from gsbench.train.checkpoint import Checkpoint
from gsbench.train.draws import generator
from gsbench.train.loop import Trainer

SAMPLE, ALL = 40, 500


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run of 7DGS with AGR, with everything that a checkpoint can hold."""
    root = tmp_path_factory.mktemp("run")
    more = ("model=7dgs", "train.iterations=20", "train.densify.every=5", "train.densify.start=1")
    done = gsbench(*overrides(write_moving_square(root / "data"), root / "r", *more))
    assert done.returncode == 0, done.stderr
    (path,) = record.find(root)
    return path.parent


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
    return [path, *(found for key, value in members for found in leaves(value, (*path, key)))]


def replaced(state: Any, path: tuple[Any, ...], change: Callable[[Any], Any]) -> Any:
    """A copy of a nested state with `change` applied to what lies at `path`."""
    if not path:
        return change(state)
    if isinstance(state, dict):
        return {key: replaced(value, path[1:], change) if key == path[0] else value for key, value in state.items()}
    return type(state)(replaced(value, path[1:], change) if i == path[0] else value for i, value in enumerate(state))


def harm(draw: random.Random) -> Callable[[Any], Any]:
    """A change that leaves a tensor, number or container of the wrong shape, type or value."""

    def change(value: Any) -> Any:
        if isinstance(value, torch.Tensor):
            wrong: list[Callable[[], Any]] = [
                lambda: value[:-1] if value.dim() else value[None], lambda: value.to(torch.float16),
                lambda: value.double(), lambda: value[None], lambda: value.new_zeros(0), lambda: value.to_sparse(),
                lambda: torch.zeros(1).expand((*value.shape[:1], 7) if value.dim() else (3,)), lambda: "text",
                lambda: None, lambda: value.flatten()[: value.numel() // 2],
            ]  # fmt: skip
            return draw.choice(wrong)()
        return draw.choice((None, "text", -1, 10**30, [], {}, torch.zeros(3)))

    return change


def check(seeds: range, folder: Path) -> int:
    """Load harmed checkpoints; how many were refused."""
    found = checkpoint.read(folder / checkpoint.FILE_NAME)
    paths, fitted, refused = leaves(found.state), trainer(folder), 0
    for seed in seeds:
        draw = random.Random(seed)
        path = draw.choice(paths)
        state = replaced(found.state, path, harm(draw))
        try:
            fitted.load_state_dict(state)
            fitted.model.set_phase(fitted.schedule.phase(5))
            fitted._descend()  # a tensor of the wrong shape that was accepted would crash here
        except InputError as error:
            refused += "\n" not in str(error)
        except Exception as error:
            raise AssertionError(f"case {seed}: {path}: {type(error).__name__}: {error}") from error
    return refused


def test_a_sample_of_misshapen_states_is_refused(folder: Path) -> None:
    """Catches Adam moments of another shape (a segmentation fault in the kernel), and states of other types."""
    assert check(range(SAMPLE), folder) > 0.8 * SAMPLE


@pytest.mark.slow
def test_all_misshapen_states_are_refused(folder: Path) -> None:
    """The same for many more."""
    assert check(range(SAMPLE, ALL), folder) > 0.8 * (ALL - SAMPLE)


def test_every_flipped_bit_is_noticed(folder: Path, tmp_path: Path) -> None:
    """Catches a training that goes on from numbers that a disk has damaged: no bit of the file may change."""
    content = (folder / checkpoint.FILE_NAME).read_bytes()
    path = tmp_path / checkpoint.FILE_NAME
    draw = random.Random(0)
    for place in [0, 30, 90, len(content) - 1, *(draw.randrange(len(content)) for _ in range(SAMPLE))]:
        damaged = bytearray(content)
        damaged[place] ^= 1 << draw.randrange(8)
        path.write_bytes(damaged)
        with pytest.raises(InputError, match=r"expected a checkpoint, got"):
            checkpoint.read(path)


def test_what_is_no_file_is_refused(tmp_path: Path) -> None:
    """Catches a process that hangs at a pipe or reads /dev/zero without end."""
    import os

    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", Path("/dev/zero"), tmp_path):
        with pytest.raises(InputError, match="something that is not a file"):
            checkpoint.read(path)


def test_a_config_and_a_scene_of_the_wrong_type_are_refused(folder: Path, tmp_path: Path) -> None:
    """Catches a stack trace for a checkpoint that someone else has written."""
    found = checkpoint.read(folder / checkpoint.FILE_NAME)
    for config, scene in (({}, found.scene), (found.config, {}), ({**found.config, "seed": "x"}, found.scene),
                          ({**found.config, "train": 3}, found.scene), (found.config, {**found.scene, "extent": "x"}),
                          ({**found.config, "model": {"name": "nosuch"}}, found.scene)):  # fmt: skip
        checkpoint.save(tmp_path / checkpoint.FILE_NAME, Checkpoint("t", "d", found.state, config, scene))
        with pytest.raises(InputError):
            load_run(tmp_path)
