"""Scores of other programs' renders: those of gsbench's own runs give its own numbers, and wrong files are refused."""

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from tiny_run import overrides, run_here

from gsbench.measure import record as files
from gsbench.measure.exact_views import MOST_PSNR
from gsbench.measure.quality import psnr
from gsbench.measure.record import Record
from gsbench.models.render import render
from gsbench.run.load import load_run, scene_of
from gsbench.scenes import Camera, View
from gsbench.score import _color_corrected, _matching, main, of_other_papers, other_metrics

VIEWS = ("r_0", "r_1")  # of the split test
SIZE = 16
Images = dict[str, np.ndarray]  # [16, 16, 3] floats by view


@pytest.fixture(scope="module")
def trained(square: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Record, Images]:
    """A run of 30 steps, and its test renders as floats."""
    record, folder = run_here(*overrides(square, tmp_path_factory.mktemp("run"), "model=3dgs"))
    assert record.status == "ok", record.reason
    run = load_run(folder)
    views = scene_of(run).test
    images = [render(run.model, view.camera, view.time, torch.zeros(3), False).numpy() for view in views]
    return record, dict(zip(VIEWS, images, strict=True))


def words_of(data: Path, results: Path) -> list[str]:
    """The overrides of the scene."""
    kept = ("+exp", "data.root", "data.scenes", "scene", "scene.name", "scene.downscale", "results")
    return [word for word in overrides(data, results) if word.partition("=")[0] in kept]


def write(folder: Path, images: Images) -> Path:
    """Write images as PNG or, from floats, as .npy."""
    folder.mkdir(exist_ok=True)
    for name, image in images.items():
        if image.dtype.kind == "f":
            np.save(folder / f"{name}.npy", image)
        else:
            swapped = image if image.ndim == 2 else np.concatenate([image[..., 2::-1], image[..., 3:]], axis=-1)
            assert cv2.imwrite(str(folder / f"{name}.png"), swapped)
    return folder


def score(renders: Path, data: Path, results: Path, *more: str) -> Record:
    """Score renders, and return the record."""
    assert main([str(renders), *words_of(data, results), "--name", "other", *more]) == 0
    return files.read(results / "dnerf/square/other/seed0" / files.FILE_NAME)


def in_8_bits(images: Images) -> Images:
    return {name: (image.clip(0, 1) * 255).round().astype(np.uint8) for name, image in images.items()}


def test_floats_of_an_own_run_have_its_numbers(trained, square, tmp_path, capsys):
    """Catches a score by another protocol than that of runs: another background, clamp, mean, view or region."""
    ours, images = trained
    record = score(write(tmp_path / "npy", images), square, tmp_path / "results", "--gaussians", "7", "--fps", "50")
    assert "2 images (floats), matched to the views by names: r_0.npy is test/r_0, r_1.npy is test/r_1" in (
        capsys.readouterr().out
    )
    for name in ("psnr", "ssim", "psnr_channel_mean", "psnr_object", "psnr_background_only"):
        assert record.metrics[name] == pytest.approx(ours.metrics[name], abs=1e-6), name
    assert [view.name for view in record.per_view] == ["test/r_0", "test/r_1"]
    assert [view.psnr for view in record.per_view] == pytest.approx([view.psnr for view in ours.per_view], abs=1e-6)
    assert record.regions == ours.regions
    assert (record.experiment, record.dataset, record.seed) == (ours.experiment, ours.dataset, ours.seed)
    assert {key: record.protocol[key] for key in ours.protocol if key != "backend"} == {
        key: value for key, value in ours.protocol.items() if key != "backend"
    }
    assert (record.cost.num_gaussians, record.cost.fps, record.cost.train_s, record.cost.bytes) == (7, 50.0, None, None)
    assert (tmp_path / "results/dnerf/square/other/seed0/pictures.png").is_file()
    assert main([str(tmp_path / "npy"), *words_of(square, tmp_path / "npy/r_0.npy"), "--name", "other"]) == 2
    assert "results: expected a folder that can be written" in capsys.readouterr().err


def test_pngs_differ_by_no_more_than_rounding(trained, square, tmp_path):
    """Catches channels in another order, a gamma, views of another split, and rows that are shifted: the root mean
    squared error of a view changes by at most half a step of 8 bits."""
    ours, images = trained
    record = score(write(tmp_path / "png", in_8_bits(images)), square, tmp_path / "results")
    for view, own_view in zip(record.per_view, ours.per_view, strict=True):
        errors = [10 ** (-each.psnr / 20) for each in (view, own_view)]
        assert abs(errors[0] - errors[1]) <= 0.5 / 255
    assert record.protocol["images"] == "8-bit PNG"
    costs = ("--train-seconds", "90", "--megabytes", "1.5")
    on_val = score(tmp_path / "png", square, tmp_path / "val", "scene.eval_split=val", *costs)
    assert (on_val.cost.train_s, on_val.cost.bytes) == (90.0, 1_500_000)
    assert [view.name for view in on_val.per_view] == ["val/r_0", "val/r_1"]


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["train.iterations=5"], "as nothing is trained"),
        (["--name", "7dgs_noagr"], "expected a name that no model of gsbench has"),
        (["--name", "a/b"], "model: expected a name of letters"),
        (["--fps", "0"], "--fps: expected a number above 0"),
        (["scene=all"], "scene: expected one"),
        (["data.rot=x"], "config key 'data.rot' is not known. Did you mean 'root'?"),
    ],
)
def test_wrong_words_are_refused_in_a_line(more, words, square, tmp_path, capsys):
    """Catches a setting of a training that is dropped, and renders that stand in tables as a model of gsbench."""
    assert main([str(tmp_path), *words_of(square, tmp_path / "results"), "--name", "other", *more]) == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1
    assert not list(tmp_path.rglob("*.json"))


@pytest.mark.parametrize(("count", "more"), [(5, ""), (6, ", ..")])
def test_a_long_list_of_views_is_shortened(count, more):
    """Catches a line of 200 names, and one that leaves out the last view or counts wrong."""
    renders = SimpleNamespace(
        files=[*map(str, range(count))], facts=SimpleNamespace(kind="floats", matched="order"), others=[*"abcdefg"]
    )
    line = _matching(renders, [SimpleNamespace(name=f"a{i}") for i in range(count)])
    assert line.startswith(f"{count} images (floats), matched to the views by order: 0 is a0, 1 is a1, ")
    assert line.endswith(f", 3 is a3{more}, {count - 1} is a{count - 1}; not read: a, b, c, d, e")


def test_memory_that_runs_out_is_told(square, tmp_path, monkeypatch, capsys):
    """Catches an empty line for a MemoryError, and an error of the program that is told as one of the user."""
    for error, words in (
        (MemoryError("full"), "gsbench.score: out of memory: full\n"),
        (OSError("bad"), "gsbench.score: bad\n"),
    ):
        monkeypatch.setattr("gsbench.score.load_scene", lambda _, error=error: (_ for _ in ()).throw(error))
        assert main([str(tmp_path), *words_of(square, tmp_path / "results"), "--name", "other"]) == 2
        assert capsys.readouterr().err == words
    monkeypatch.setattr("gsbench.score.load_scene", lambda _: (_ for _ in ()).throw(RuntimeError("shape")))
    with pytest.raises(RuntimeError, match="shape"):
        main([str(tmp_path), *words_of(square, tmp_path / "results"), "--name", "other"])


def test_the_ssim_of_other_papers():
    """Catches another window, padding or data_range (RIVALS.md, section 9; computed there by numpy alone)."""
    y, x = (grid / 24 for grid in np.mgrid[:24, :24])
    a = 0.5 + 0.3 * np.sin(7 * x + 2 * y) * np.cos(5 * y)
    b = (a + 0.05 * np.sin(31 * x * y + 0.5)).clip(0, 1)
    values = of_other_papers(*(torch.from_numpy(image)[..., None].expand(-1, -1, 3) for image in (a, b)))
    expected = {
        "ssim_padded": 0.94812566,
        "ssim_uniform": 0.93998970,
        "ssim_uniform_range2": 0.94841174,
        "dssim1": 0.02593717,
        "dssim2": 0.02579413,
    }
    assert {name: values[name] for name in expected} == pytest.approx(expected, abs=1e-8)


def test_multiscale_ssim():
    """Catches another window, weight, luminance or halving of MS-SSIM: values of pytorch-msssim 1.0.0 with a float64
    window, for even and odd sides and for a channel whose contrast is negative."""
    expected = {(176, 200): (0.9915429809093, 0.6638476603031), (161, 213): (0.9917184990649, 0.6639061663550)}
    for (height, width), values in expected.items():
        y, x = (grid / 24 for grid in np.mgrid[:height, :width])
        a = 0.5 + 0.3 * np.sin(7 * x + 2 * y) * np.cos(5 * y)
        b = (a + 0.05 * np.sin(31 * x * y + 0.5)).clip(0, 1)
        for channels, value in zip(((b, b, b), (b, a, 1 - a)), values, strict=True):
            images = (torch.from_numpy(np.stack(image, -1)) for image in (channels, (a, a, a)))
            assert of_other_papers(*images)["ms_ssim"] == pytest.approx(value, abs=1e-12)
    sizes = [(161, 170), (160, 300)]
    pictures = [torch.rand(height, width, 3) for width, height in sizes]
    cameras = [Camera(torch.eye(4), torch.eye(3), *size) for size in sizes]
    views = [View(str(i), cameras[i], 0, picture) for i, picture in enumerate(pictures)]
    assert of_other_papers(pictures[0], pictures[0])["ms_ssim"] == pytest.approx(1, abs=1e-12)
    metrics = other_metrics(views, SimpleNamespace(images=lambda: pictures))
    assert "ssim_padded" in metrics
    assert "ms_ssim" not in metrics


def test_flow_is_that_of_whole_films():
    """Catches frames that a film loses, views of no film, and a sum of films: one stands still, one is too short."""
    texture = torch.rand(1, 1, 96, 160, generator=torch.Generator().manual_seed(0)).mul(255).int().float()
    wide = (torch.nn.functional.avg_pool2d(texture, 9, 1, 4)[0, 0] * 3 - 256).clamp(0, 255) / 255
    cameras = [Camera(torch.eye(4) * (1 + x), torch.eye(3), 128, 96) for x in range(4)]
    places = [(camera, t) for camera, frames in enumerate((6, 6, 3, 1)) for t in range(frames)]
    frames = [wide[:, t : t + 128, None].expand(-1, -1, 3) for _, t in places]
    views = [View(f"{c}/{t}", cameras[c], t / 5, image) for (c, t), image in zip(places, frames, strict=True)]
    shown = [frames[0] if camera else image for (camera, _), image in zip(places, frames, strict=True)]
    means = other_metrics(views, SimpleNamespace(images=lambda: shown))
    padded = [of_other_papers(*pair)["ssim_padded"] for pair in zip(shown, frames, strict=True)]
    assert means["tof_farneback"] == pytest.approx(0.5, abs=0.1)
    assert means["ssim_padded"] == pytest.approx(np.mean(padded))


def test_colours_are_corrected_by_the_best_affine_map():
    """Catches a gain without offset or mixed channels, which are undone, and an infinite PSNR of exact images."""
    truth = torch.rand(12, 12, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 0.4 + 0.3
    mixed = truth @ torch.tensor([[0.8, 0.1, 0.0], [0.0, 0.7, 0.1], [0.1, 0.0, 0.9]], dtype=torch.float64) + 0.05
    assert psnr(_color_corrected(mixed, truth), truth) > 200
    assert of_other_papers(mixed, truth)["psnr_color_corrected"] == MOST_PSNR
    assert of_other_papers(torch.zeros_like(truth), truth)["psnr_color_corrected"] < 30
