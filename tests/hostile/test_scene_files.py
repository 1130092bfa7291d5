"""Hostile scenes: one that is finite and of one size, or an InputError of one line."""

import functools
import json
import math
import random
import struct
import zlib
from pathlib import Path
from typing import Any

import torch
from mutations import damage_bytes, damage_json, double_a_key, replace_file
from tiny_scene import write_tiny
from workers import Case, Pool, generator, sample

from gsbench import scenes

JSONS = ("transforms_train.json", "transforms_val.json", "transforms_test.json")
IMAGES = ("train/r_0.png", "train/r_1.png", "val/r_0.png", "test/r_0.png")
SIDES = (0, 1, 6, 8, 4096, 8192, 8193, 65_536, 2**31 - 1, 2**32 - 1)
BOMB = 3 * 10**8  # zeros, of which a megabyte is left when they are compressed
SIGNATURE = b"\x89PNG\r\n\x1a\n"


def draw(seed: int, folder: Path) -> Case:
    """Draw the tiny scene with one or two kinds of damage, or loaded with hostile arguments."""
    r = generator("scene files", seed)
    root = write_tiny(folder / "tiny")
    arguments: dict[str, Any] = {}
    done: list[str] = []
    if r.random() < 0.35:
        done.append(_in_json(r, root))
    if r.random() < 0.35:
        done.append(r.choice((_in_png, _in_png, _in_bytes, _in_files, _twice))(r, root))
    if not done:
        name, value = _argument(r)
        arguments[name] = value
        done.append(f"{name}={value!r:.60}")
    path = arguments.pop("path", root)
    return Case("; ".join(done), lambda: check_scene(scenes.load(path, **arguments)))


def check_scene(scene: scenes.Scene) -> None:
    """Assert that every number is finite and every image as large as its camera says."""
    assert math.isfinite(scene.extent)
    assert len(scene.fingerprint) == 64
    assert scene.train
    assert scene.test
    for view in (*scene.train, *scene.val, *scene.test):
        camera = view.camera
        assert view.image.shape == (camera.height, camera.width, 3)
        assert view.image.dtype == torch.float32
        assert ((view.image >= 0) & (view.image <= 1)).all()
        assert camera.K.isfinite().all()
        assert (camera.K[[0, 1], [0, 1]] > 0).all()
        assert camera.viewmat.isfinite().all()
        assert camera.center.isfinite().all()
        assert view.time is None or 0 <= view.time <= 1


def _in_json(r: random.Random, root: Path) -> str:
    """Change a value of a JSON."""
    path = root / r.choice(JSONS)
    content = json.loads(path.read_bytes())
    what = damage_json(r, content)
    path.write_text(json.dumps(content))
    return f"{path.name}: {what}"


def _in_bytes(r: random.Random, root: Path) -> str:
    """Change the bytes of a JSON or an image."""
    path = root / r.choice((*JSONS, *IMAGES))
    data, what = damage_bytes(r, path.read_bytes())
    path.write_bytes(data)
    return f"{path.name}: {what}"


def _twice(r: random.Random, root: Path) -> str:
    """Write a key of a JSON twice."""
    path = root / r.choice(JSONS)
    data, what = double_a_key(r, path.read_bytes())
    path.write_bytes(data)
    return f"{path.name}: {what}"


def _in_files(r: random.Random, root: Path) -> str:
    """Put something else in the place of a file."""
    return replace_file(r, root / r.choice((*JSONS, *IMAGES)))


def _in_png(r: random.Random, root: Path) -> str:
    """Write one image or all of them as a PNG of any header and any data, with the right checksums."""
    width, height = r.choice(((8, 6), (8, 6), (8, 6), (r.choice(SIDES), r.choice(SIDES))))
    depth, color = r.choice((8, 8, 8, 16, r.randrange(256))), r.choice((6, 6, 2, 2, r.randrange(8)))
    header = struct.pack(">IIBBBBB", width, height, depth, color, *r.choice(((0, 0, 0), (0, 0, 0), (1, 9, 9))))
    rows = height * (1 + -(-width * {0: 1, 2: 3, 3: 1, 4: 2}.get(color, 4) * depth // 8))
    zeros = r.choice((rows, rows, rows, 0, rows - 1, BOMB)) if rows < 2**22 else r.choice((0, BOMB))
    chunks = [(b"IHDR", header), *_extra_chunks(r), (b"IDAT", _compressed_zeros(zeros)), (b"IEND", b"")]
    data = SIGNATURE + b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body)) for kind, body in chunks
    )
    chosen = r.choice((IMAGES, [r.choice(IMAGES)]))
    for name in chosen:
        (root / name).write_bytes(data)
    extra = [kind.decode() for kind, _ in chunks[1:-2]]
    return f"{len(chosen)} PNGs of {width}x{height}, depth {depth}, colour {color}, {zeros} zeros, {extra}"


def _extra_chunks(r: random.Random) -> list[tuple[bytes, bytes]]:
    """Choose chunks that a decoder may trip over: palettes, profiles, texts that are bombs, frames of an animation."""
    bomb = _compressed_zeros(BOMB)
    known = [
        (b"PLTE", bytes(768)), (b"PLTE", b"\0"), (b"tRNS", bytes(6)), (b"gAMA", bytes(4)), (b"iCCP", b"a\0\0" + bomb),
        (b"zTXt", b"a\0\0" + bomb), (b"iTXt", b"a\0\1\0\0\0" + bomb), (b"eXIf", b"MM\0*" + bytes(20)),
        (b"acTL", struct.pack(">II", 2**31 - 1, 0)), (b"fcTL", struct.pack(">IIIIIHHBB", 0, 8, 6, 0, 0, 1, 1, 0, 0)),
        (b"ABCD", bytes(8)), (b"abCd", bytes(8)), (b"IDAT", b"\xff" * 20),
    ]  # fmt: skip
    return r.sample(known, r.choice((0, 0, 0, 1, 2)))


@functools.cache
def _compressed_zeros(count: int) -> bytes:
    """Compress `count` zeros without holding them all."""
    compressor, part = zlib.compressobj(1), bytes(1 << 20)
    pieces = [compressor.compress(part[: min(len(part), count - at)]) for at in range(0, count, len(part))]
    return b"".join([*pieces, compressor.flush()])


def _argument(r: random.Random) -> tuple[str, Any]:
    """Choose one argument of `scenes.load`."""
    values: dict[str, tuple[Any, ...]] = {
        "downscale": (1, 2, 2, 3, 0, -1, True, 1.0, 10**30, None, "2", float("nan")),
        "background": ((1, 1, 1), [0, 0.5, 1], (0.2, 1, 0), (0, 0), (0, 0, 2), None, "abc", (0, 0, "x"),
                       (0, 0, float("nan")), 1, torch.zeros(3)),
        "path": ("", "\0", "a\0b", "a\nb", "x" * 5000, None, 7, b"x", "/dev/zero", "/dev/null/x", "/", "\ud800"),
    }  # fmt: skip
    name = r.choice(list(values))
    return name, r.choice(values[name])


@sample(40, 500)
def test_any_scene_is_loaded_or_an_input_error(count: int, pool: Pool) -> None:
    """Catches a stack trace, a hang, an image of gigabytes, and a camera that is not finite, whatever the files are."""
    pool.check(__name__, count)
