"""Write the blocks of docs/results.md: tables and sentences that follow from the reference records."""

from pathlib import Path
from statistics import fmean

from published import (
    CASES,
    LONG,
    MODELS,
    NAMES,
    ON_GPU,
    PAPERS,
    QUICK,
    SMALLER,
    SUCCESSORS,
    TREX100,
    Experiment,
    best_on_test,
    by_scene,
    change,
    cost,
    costs,
    experiment,
    gated,
    machine,
    metric,
    number,
    overfitted,
    plus_minus,
    prices,
    signed,
    span,
    successors,
    table,
)

from gsbench.measure.curve import FALL
from gsbench.report import frontier
from gsbench.report.configurations import psnr_val
from gsbench.report.messages import count, listing
from gsbench.report.paper import paper_row

ABLATIONS = {
    "no_agr": "no AGR",
    "time_only": "no direction: 4DGS with AGR",
    "direction_only": "no time: 6DGS with AGR",
    "no_effects": "neither time nor direction: 3DGS with AGR",
    "paper_order": "Cholesky factor over (position, time, direction), as in the paper",
    "row_scaled": "off-diagonals of the factor as parts of their row's diagonal",
    "raw_off_diagonal": "off-diagonals of the factor as raw entries",
    "schur": "slices by a Schur complement",
    "cholesky": "slices by a Cholesky factor",
    "no_time_split": "Gaussians split in space only",
    "fixed_lambda": "constant λ, the coefficients in the exponents of the opacity",
}


def table1(published: Path) -> str:
    """Return the table of `make table1`, and how model=auto and newer methods compare."""
    found = experiment(published, "mini")
    rows = []
    for model in (m for m in MODELS if found.has(m)):
        runs = found.runs(model)
        metrics = [number(metric(runs, key), digits) for key, digits in (("psnr", 2), ("ssim", 3), ("lpips_alex", 3))]
        seconds, fps, many = (cost(runs, key) for key in ("train_s", "fps", "num_gaussians"))
        rows.append([model, *by_scene(found.of(model)), *metrics, f"{seconds:.1f}", f"{fps:,.0f}", f"{many:,.0f}"])
    kept, faster = (cost(found.runs("auto"), key) / cost(found.runs("7dgs"), key) for key in ("num_gaussians", "fps"))
    tested = found.tested("auto", "7dgs")
    said = (
        f"The result of `model=auto` has {100 * kept:.0f} % of the Gaussians of 7DGS and {faster:.1f} times its frame "
        f"rate. The difference in PSNR to 7DGS, {change(tested.difference, told=tested.told)} dB, is "
        f"{'' if tested.told else 'not '}significant. Newer methods have "
        f"{listing([f'{psnr:.2f} dB (`{m}`)' for psnr, m in successors(found)])}."
    )
    head = ["model", *found.group.scenes, "PSNR", "SSIM", "LPIPS-Alex", "training, s", "FPS", "Gaussians"]
    return f"Measured on {machine(found)}.\n\n{table(head, rows)}\n\n{said}"


def lengths(published: Path) -> str:
    """Return the table of `make frontier`, which model is best within each budget, and which ones overfit."""
    found = experiment(published, "frontier")
    rows = [costs(found, case, MODELS, "{psnr}, {seconds}") for case in CASES]
    newer = [m for m in SUCCESSORS if found.has(m, CASES["2,000"])]
    points = frontier.points(found.group, found.group.basis)
    chosen = [frontier.choose(points, unit, budget, found.family) for unit, budget in frontier.BUDGETS]
    answers = []
    for (unit, budget), choice in zip(frontier.BUDGETS, chosen, strict=True):
        limit = f"{budget:g} s of training" if unit == "seconds" else f"{1000 / budget:.0f} frames a second"
        best = [f"`{choice.point.configuration.name}`", number(choice.point.psnr.mean)] if choice else ["none", "–"]
        answers.append([limit, *best])
    longer = overfitted(found)
    said = "The model with the best PSNR on val within a budget, and its PSNR on test:"
    parts = [table(["iterations", *MODELS], rows, left=0)]
    if newer:
        own = [costs(found, case, newer, "{psnr}, {seconds}") for case in CASES if found.has(newer[0], CASES[case])]
        parts += ["Newer methods:", table(["iterations", *newer], own, left=0)]
    parts += [said, table(["budget", "best", "PSNR"], answers, left=2)]
    if not any(choice.ahead for choice in chosen if choice):
        parts.append(
            "None of them is significantly better than another model within its budget: the intervals are over "
            f"{count(len(found.group.scenes), 'scene')}."
        )
    if longer:
        parts.append(
            f"From 2,000 to 4,000 iterations, PSNR on test falls by more than {FALL} dB for {len(longer)} of "
            f"{len(MODELS)} models. That of 7DGS changes by {_by_length(found, '7dgs')} dB."
        )
    return f"Measured on {machine(found)}.\n\n" + "\n\n".join(parts)


def _by_length(found: Experiment, model: str) -> str:
    """List by scene how PSNR of a model changes between 2,000 and 4,000 iterations."""
    shorter, longer = (found.of(model, CASES[length]).each for length in ("2,000", "4,000"))
    changes = zip(found.group.scenes, shorter, longer, strict=True)
    return listing([f"{signed(after - before)} ({scene})" for scene, before, after in changes])


def effects(published: Path) -> str:
    """Return the table of what time, direction and AGR gain and cost, given the other effects."""
    found = experiment(published, "frontier")
    priced = prices(found)
    rows = []
    for name, price in priced.items():
        gain = price.costs["psnr"]
        told = change(gain, told=price.told["psnr"])
        numbers = [signed(price.costs[unit].mean, digits) for unit, digits in (("seconds", 1), ("ms", 2), ("mb", 2))]
        title = name.replace(" alone", "").replace(", with", " given")
        rows.append([title, told, *by_scene(gain, signed), *numbers])
    head = ["effect", "PSNR, dB", *found.group.scenes, "training, s", "frame, ms", "model, MB"]
    text = table(head, rows, left=2)
    direction = priced["direction, with time"]
    if direction.told["psnr"] and direction.costs["psnr"].mean < 0:
        text += "\n\nDirection lowers PSNR of a model with time and without AGR."
    other = experiment(published, "dnerf_trex100")
    if "7dgs_nodir_agr" in other.group.models:
        views, agr = (other.difference("7dgs", less, TREX100) for less in ("7dgs_nodir_agr", "7dgs_noagr"))
        text += (
            "\n\nOn D-NeRF trex at 100 × 100 ([records](../results/published/dnerf_trex100/), 3,000 iterations) "
            f"direction changes PSNR by {change(views)} in a model with time and AGR, and AGR by "
            f"{change(agr)} in a model with time and direction."
        )
    return text


def ablation(published: Path) -> str:
    """Return the table of what each part of 7DGS is worth."""
    found = experiment(published, "ablation")
    full = found.of("7dgs", "ablation=none")
    rows = [["nothing", "`none`", number(full.mean), *by_scene(full)]]
    by_variant = {c.variant: c for c in found.group.configurations}
    for name, words in ABLATIONS.items():
        tested = found.family.of([(1.0, by_variant[f"ablation={name}"]), (-1.0, by_variant["ablation=none"])])
        of = tested.difference
        rows.append([words, f"`{name}`", change(of, told=tested.told), *by_scene(of, signed)])
    return table(["changed", "`+ablation=`", "PSNR, dB", *found.group.scenes], rows, left=3)


def recipe(published: Path) -> str:
    """Return PSNR by scene, length and recipe: of dynamic scenes, of newer methods, and of two static scenes."""
    models = ("7dgs", "7dgs_noagr", "4dgs")
    old, trex100 = experiment(published, "old_suzanne"), experiment(published, "dnerf_trex100")
    lego100 = experiment(published, "dnerf_lego100")
    of_4000 = CASES["4,000"]
    long_4000, chosen_4000 = f"{LONG},{of_4000}", f"{of_4000},lengths=4"
    rows = [
        [name, *(plus_minus(found.of(model, variant)) for model in models)]
        for name, found, variant in (
            ("trex 100 × 100, 3,000 iterations, test", trex100, TREX100),
            ("the same with `+recipe=long`", trex100, f"{LONG},{TREX100}"),
            ("the earlier suzanne, 1,000 iterations, test", old, ""),
            ("4,000 iterations", old, of_4000),
            ("4,000 iterations, `+recipe=long`", old, long_4000),
            ("500 to 4,000 iterations, chosen on val (`train.lengths=4`)", old, chosen_4000),
            ("lego 100 × 100, 1,000 iterations, val ([why](protocol.md#how-it-is-measured))", lego100, None),
        )
    ]
    default, long, chosen = (
        listing([f"{gap(old, m, of):.1f} dB ({m})" for m in models]) for of in (of_4000, long_4000, chosen_4000)
    )
    said = "On the earlier suzanne, PSNR of training views after 4,000 iterations is higher than that of test views by "
    said += f"{default}, with `+recipe=long` by {long}, and with `train.lengths=4` by {chosen}.\n\n"
    newer = [m for m in SUCCESSORS if m in trex100.group.models]
    said += "Newer methods, trex 100: " + ", ".join(f"`{m}` {plus_minus(trex100.of(m, TREX100))}" for m in newer) + "."
    still = experiment(published, "static")
    gains = {scene: float(values.mean()) for scene, values in still.contrast("6dgs", "3dgs").items()}
    said += "\n\nOn static scenes, 6DGS differs in PSNR on test from 3DGS by "
    said += listing([f"{signed(gain)} dB ({scene})" for scene, gain in gains.items()])
    for model in ("3dgs", "6dgs"):
        said += f". `+recipe=long` changes that of {NAMES[model]} by "
        said += listing([f"{signed(gain)} dB ({scene})" for scene, gain in gains_of_long(still, model)])
    return f"{table(['', *models], rows)}\n\n{said} ([records](../results/published/static/))."


def gap(found: Experiment, model: str, variant: str) -> float:
    """Return the PSNR of training views minus that of test views, dB."""
    runs = found.runs(model, variant)
    return metric(runs, "psnr_train") - metric(runs, "psnr")


def gains_of_long(found: Experiment, model: str) -> list[tuple[str, float]]:
    """Return by how much `+recipe=long` changes the PSNR of a model on each scene, dB."""
    long, default = (found.configuration(model, variant).runs for variant in (LONG, ""))
    return [(scene, metric(long[scene], "psnr") - metric(default[scene], "psnr")) for scene in sorted(long)]


def trex200(published: Path) -> str:
    """Return the table of trex at 200 x 200 pixels, three seeds."""
    found = experiment(published, "dnerf")
    models = [c.model for c in found.group.configurations if c.variant == SMALLER]
    models.sort(key=lambda model: -found.of(model, SMALLER).mean)
    rows = []
    for model in models:
        runs = found.runs(model, SMALLER)
        psnr = plus_minus(found.of(model, SMALLER))
        train, ssim, lpips = (metric(runs, key) for key in ("psnr_train", "ssim", "lpips_alex"))
        many = cost(runs, "num_gaussians")
        shown = f"**{psnr}**" if model == models[0] else psnr
        rows.append([model, shown, number(train), number(ssim, 3), number(lpips, 3), f"{many:,.0f}"])
    said = [
        f"by {change(found.difference('7dgs', other, SMALLER))} dB from {NAMES[other]}"
        for other in ("4dgs", "7dgs_noagr")
    ]
    head = ["model", "PSNR", "PSNR train", "SSIM", "LPIPS-Alex", "Gaussians"]
    return f"{table(head, rows)}\n\n7DGS differs {listing(said)}."


def trex400(published: Path) -> str:
    """Return the table of trex as the paper trains it, beside the paper's rows, and whether they agree."""
    found = experiment(published, "dnerf")
    rows: list[list[str]] = []
    for model in ("7dgs", "7dgs_noagr", "4dgs"):
        for variant in (ON_GPU, PAPERS):
            if found.has(model, variant):
                device = found.runs(model, variant)[0].provenance.device
                place = device.removeprefix("NVIDIA ") if variant == ON_GPU else "CPU"
                rows.append([f"{model}, {place}", *_whole(found, model, variant)])
        own = paper_row("D-NeRF", "trex", model)
        minutes = "–" if own.train_min is None else f"{own.train_min:.1f} GPU"
        rows.append(["paper", "–", "–", f"{own.psnr:.2f}", "–", "–", number(own.ssim, 3), number(own.lpips, 3), minutes,
                     f"{own.num_gaussians:,}"])  # fmt: skip
    for name, words in (("paper", "the numbers that the paper prints"), ("authors", "its authors' later code")):
        variant = f"recipe={name},{PAPERS}"
        row = _whole(found, "7dgs_noagr", variant)
        rows.append([f"7dgs_noagr with {words}, `+recipe={name}`, CPU", *row])
    head = ["trex, 400 x 400", "seeds", "PSNR, last iteration", "best on test (leaks)", "val", "training views", "SSIM",
            "LPIPS-Alex", "minutes of CPU or GPU", "Gaussians"]  # fmt: skip
    with_agr, without = (best_on_test(found.runs(model, ON_GPU)).mean for model in ("7dgs", "7dgs_noagr"))
    theirs = paper_row("D-NeRF", "trex", "7dgs").psnr - paper_row("D-NeRF", "trex", "7dgs_noagr").psnr
    said = f"{reproduced(found)} AGR adds {signed(with_agr - without)} dB, in the paper {signed(theirs)}."
    return f"{table(head, rows)}\n\n{said}"


def reproduced(found: Experiment) -> str:
    """Say for 7DGS with and without AGR whether PSNR agrees with the paper's, which reports the best on test."""
    said = []
    for model in ("7dgs", "7dgs_noagr"):
        ours, paper = best_on_test(found.runs(model, ON_GPU)), paper_row("D-NeRF", "trex", model).psnr
        assert ours.over, f"{model}: expected several seeds, as one has no interval"
        if ours.low <= paper <= ours.high:
            verdict = "agrees with"
        else:
            verdict = "is higher than" if ours.mean > paper else "is lower than"
        said.append(f"{NAMES[model]} has {plus_minus(ours)} dB, which {verdict} the paper's {paper:.2f} dB")
    return f"At the best iteration on test, which the paper reports: {'; '.join(said)}."


def _whole(found: Experiment, model: str, variant: str) -> list[str]:
    """Return the number of seeds and the other numbers of a row at 400 x 400 pixels, means over seeds."""
    runs = found.runs(model, variant)
    train, ssim, lpips = (metric(runs, key) for key in ("psnr_train", "ssim", "lpips_alex"))
    on_gpu = runs[0].protocol["backend"] == "cuda"
    seconds, many = cost(runs, "train_s" if on_gpu else "train_cpu_s"), cost(runs, "num_gaussians")
    val = fmean(psnr_val(run) for run in runs)
    minutes = f"{seconds / 60:.1f} {'GPU' if on_gpu else 'CPU'}"
    return [str(len(runs)), plus_minus(found.of(model, variant)), plus_minus(best_on_test(runs)), number(val),
            number(train, 1), number(ssim, 3), number(lpips, 3), minutes, f"{many:,.0f}"]  # fmt: skip


def quick(published: Path) -> str:
    """Return the tables of trex with `+recipe=quick`, and with other lengths and a limit of Gaussians."""
    found = experiment(published, "dnerf")
    rows = []
    for variant, words in QUICK.items():
        for model in (m for m in ("7dgs", "4dgs", "7dgs_noagr") if found.has(m, variant)):
            seeds, psnr, _, val, _, *others = _whole(found, model, variant)
            rows.append([f"{model}{words}", seeds, psnr, val, *others])
    head = ["trex, 400 x 400", "seeds", "PSNR", "val", "SSIM", "LPIPS-Alex", "minutes of CPU or GPU", "Gaussians"]
    return table(head, rows)


def on_demand(published: Path) -> str:
    """Return the table of what the removal of effects from Gaussians changes, as a range over scenes."""
    changed = {model: gated(published, model) for model in ("7dgs", "7dgs_noagr", "4dgs")}
    head = ["", *(f"{model}, {count(len(found['psnr']), 'scene')}" for model, found in changed.items())]
    rows = [["PSNR on test, dB", *(span(found["psnr"], 2) for found in changed.values())]]
    for title, unit in (("frame time, %", "ms"), ("size of the model, %", "mb")):
        rows.append([title, *(span(found[unit], 0) for found in changed.values())])
    return table(head, rows, left=4)


BLOCKS = {
    "table1": table1,
    "frontier": lengths,
    "effects": effects,
    "ablation": ablation,
    "recipe": recipe,
    "trex200": trex200,
    "trex400": trex400,
    "quick": quick,
    "on_demand": on_demand,
}
