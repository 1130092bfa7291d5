"""The columns of the tables of runs, each with its unit and meaning, and its place in record.json.

`gsbench.report.frame` reads records into these tables, and `gsbench.report.study` writes them to files.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class RunColumn:
    """A column of a table: its name with its unit, its place in record.json, its type and its meaning."""

    name: str
    place: str  # "" if the column is computed from others
    kind: type
    meaning: str
    unit: float = 1.0  # the number in a record is divided by it


RUNS = (
    RunColumn("experiment", "experiment", str, "the runs that are compared with each other: conf/exp"),
    RunColumn("dataset", "dataset", str, "the data set"),
    RunColumn("scene", "scene", str, "the scene"),
    RunColumn("model", "model", str, "the model, with _agr or _noagr if this differs from its publication"),
    RunColumn("variant", "variant", str, 'settings that differ from the experiment\'s, such as "iterations=10"'),
    RunColumn("seed", "seed", int, "the seed of the run"),
    RunColumn("status", "status", str, "ok, failed or diverged"),
    RunColumn("reason", "reason", object, "why the status is not ok"),
    RunColumn("psnr_db", "metrics.psnr", float, "mean over the evaluated views, all pixels and channels"),
    RunColumn("psnr_train_db", "metrics.psnr_train", float, "the same on as many training views"),
    RunColumn("psnr_val_db", "", float, "on val at the end of the run: `psnr_val`"),
    RunColumn("psnr_channel_mean_db", "metrics.psnr_channel_mean", float, "the mean of the three channels' PSNR"),
    RunColumn("psnr_best_on_val_db", "metrics.psnr_best_on_val", float, "at the iteration that was best on val"),
    RunColumn("psnr_best_on_test_db", "metrics.psnr_best_on_test", float, "the best on test in training, which LEAKS"),
    RunColumn("psnr_moving_db", "metrics.psnr_moving", float, "over the pixels that move"),
    RunColumn("psnr_object_db", "metrics.psnr_object", float, "over the pixels of objects"),
    RunColumn("flicker", "metrics.flicker", float, "steps of 8 bits by which errors of static pixels change a frame"),
    RunColumn("static_drift", "metrics.static_drift", float, "the same from the first third of a film to the last"),
    RunColumn("flicker_truth", "metrics.flicker_truth", float, "of the ground truth itself"),
    RunColumn(
        "drift_3d", "metrics.drift_3d", float, "path over a film of Gaussians seen in static pixels, user's unit"
    ),
    RunColumn("drift_3d_px", "metrics.drift_3d_px", float, "the same in pixels"),
    RunColumn("psnr_float32_db", "metrics.psnr_float32", float, "the most by which float32 changes the PSNR of a view"),
    RunColumn("psnr_background_only_db", "metrics.psnr_background_only", float, "of the background alone"),
    RunColumn("ssim", "metrics.ssim", float, "scikit-image, Gaussian window"),
    RunColumn("lpips_alex", "metrics.lpips_alex", float, "LPIPS with AlexNet"),
    RunColumn("lpips_vgg", "metrics.lpips_vgg", float, "LPIPS with VGG"),
    RunColumn("train_s", "cost.train_s", float, "seconds of all training steps, without evaluation"),
    RunColumn("train_min", "", float, "the same in minutes"),
    RunColumn("train_cpu_s", "cost.train_cpu_s", float, "CPU-seconds of all threads in these seconds"),
    RunColumn("load", "cost.load", float, "mean load average of the machine in training, with this run"),
    RunColumn("frame_ms", "cost.render_ms.p50", float, "median milliseconds of a frame, with slicing and AGR"),
    RunColumn("frame_p10_ms", "cost.render_ms.p10", float, "the 10th percentile"),
    RunColumn("frame_p90_ms", "cost.render_ms.p90", float, "the 90th percentile"),
    RunColumn("fps", "cost.fps", float, "frames per second: 1000 / frame_ms"),
    RunColumn("gaussians", "cost.num_gaussians", float, "number of Gaussians"),
    RunColumn("model_mb", "cost.bytes", float, "MB of the parameters", 1e6),
    RunColumn("peak_mb", "cost.peak_memory", float, "MB of memory at the peak of training", 1e6),
    RunColumn("iterations", "", float, "iterations of the training that was kept: `iterations`"),
    RunColumn("averaged", "averaged", int, "last iterations over which parameters were averaged; 0: none"),
    RunColumn("effect_time", "effects.time", bool, "Gaussians depend on time"),
    RunColumn("effect_direction", "effects.direction", bool, "Gaussians depend on the view direction"),
    RunColumn("effect_refinement", "effects.refinement", bool, "Gaussians depend on AGR, a neural network"),
    RunColumn("rendered_elsewhere", "", bool, "another program rendered the images (`gsbench.score`)"),
    RunColumn("ssim_padded", "parts.score.ssim_padded", float, "of gsbench.score: SSIM of 3DGS, zero-padded Gaussian"),
    RunColumn("ssim_uniform", "parts.score.ssim_uniform", float, "SSIM with a uniform window of 7, scikit-image's"),
    RunColumn("ssim_uniform_range2", "parts.score.ssim_uniform_range2", float, "the same with data_range 2"),
    RunColumn("ms_ssim", "parts.score.ms_ssim", float, "MS-SSIM over five scales, as pytorch-msssim"),
    RunColumn("tof_farneback", "parts.score.tof_farneback", float, "tOF (Farneback), pixels: `gsbench.score`"),
    RunColumn("dssim1", "parts.score.dssim1", float, "(1 - ssim_padded) / 2"),
    RunColumn("dssim2", "parts.score.dssim2", float, "(1 - ssim_uniform_range2) / 2"),
    RunColumn(
        "psnr_color_corrected_db", "parts.score.psnr_color_corrected", float, "PSNR after an affine map of colours"
    ),
    RunColumn("on_demand", "", bool, "the time screen or a gate ran (`effects.gate`, `model=auto`)"),
    RunColumn("gate", "", str, 'when that was, such as "gate=end"; "" where it is the model\'s default'),
    RunColumn("config", "provenance.config", dict, "all settings, a nested dict"),
    RunColumn("missing", "missing", dict, "why metrics are missing, a dict"),
    RunColumn("versions", "", str, 'Python and packages, such as "numpy 2.1, python 3.11"'),
    RunColumn("machine", "", str, "processor, memory and threads; times are comparable only within one"),
    RunColumn("device", "provenance.device", str, "the processor or GPU of the training"),
    RunColumn("threads", "provenance.threads", int, "threads of torch and of the kernels"),
    RunColumn("git_commit", "provenance.git_commit", object, 'the commit, with "-dirty" if code was changed or added'),
    RunColumn("config_hash", "provenance.config_hash", str, "SHA-256 of all settings"),
    RunColumn("data_hash", "provenance.data_hash", str, "SHA-256 of the images and cameras"),
    RunColumn("time", "provenance.time", str, "when the run ended, UTC"),
)
PARTS = (  # of a record that differ between runs have a column for each key, such as protocol_eval_split
    ("protocol.", "protocol_"),  # how the run was evaluated
    ("cost.stage_s.", "stage_"),  # the seconds of train_s by stage: stage_raster ..
    ("provenance.config.", "config."),  # all settings; only in runs.csv
)
VIEWS = {  # by column, the score in record.json
    "psnr_db": "psnr",
    "psnr_channel_mean_db": "psnr_channel_mean",
    "ssim": "ssim",
    "lpips_alex": "lpips_alex",
    "lpips_vgg": "lpips_vgg",
    "psnr_moving_db": "psnr_moving",
    "psnr_object_db": "psnr_object",
}
CURVES = {"iteration": "iteration", "train_s": "seconds", "psnr_val_db": "psnr_val"}
