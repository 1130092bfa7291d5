"""Write the sections of the HTML report on training time: the seconds to reach PSNR targets, and PSNR over time."""

import math
from statistics import fmean

from gsbench.report import frontier as f
from gsbench.report.configurations import Group
from gsbench.report.page import charts, events, messages
from gsbench.report.page.content import Canvas, Column, DataTable, PageFigure, PageSection, Tab, Value, shown_runs

LONGEST_NAME = 14  # characters of a model's name beside its row of events
LENGTHS = "Do not read shorter trainings off these curves: schedules depend on length."


def quality_section(group: Group, canvas: Canvas) -> PageSection:
    """Make the section on how long each model trains to reach PSNR targets, with the models' performance profiles."""
    targets = f.targets(group)
    if not targets:
        text = "There is no target: no finished run has PSNR on val and seconds of training, or all have the same PSNR."
        return PageSection("quality", "Time to quality", [text])
    ratios = f.profile(targets)
    drawings = []
    if problems := len(next(iter(ratios.values()))):
        panel = charts.profile({m: (canvas.look[m], list(values)) for m, values in ratios.items()}, problems)
        alt = f"Performance profile of {messages.listing(list(ratios))} over {problems} targets"
        drawings = [PageFigure("Targets reached within a factor of the fastest", panel, f"{canvas.name}q", alt)]
    models = [m for m in canvas.look if any(m in t.seconds for t in targets)]
    columns = [Column("scene"), Column("target"), Column("PSNR dB", 2), *(Column(f"{m} s", 1, "never") for m in models)]
    rows: list[list[Value]] = [[t.scene, t.rule, t.psnr, *(t.seconds.get(m) for m in models)] for t in targets]
    return PageSection(
        "quality",
        "Time to quality",
        _quality_words(targets, models),
        [Tab("", drawings)],
        DataTable("time_to_quality.csv", columns, rows),
        beside=True,
        legend=bool(drawings),
        notes=[
            "Targets are round values of PSNR on val between the lowest and the highest run of a scene. Their step is "
            "the largest of 2, 1, 0.5, 0.2 and 0.1 dB that gives three. On the paper's images, the paper's PSNR of "
            "7DGS (best on test) is a target too. Seconds are those after which the mean curve on val of a model's "
            "runs, of any length, first has the target; the runs go on after that. Nothing is interpolated."
        ],
    )


def _quality_words(targets: list[f.Target], models: list[str]) -> list[str]:
    """Say which models reach most PSNR targets, and which are most often the fastest.

    The text also says how many targets only one model reaches.
    """
    reached = {m: sum(math.isfinite(t.seconds.get(m, math.inf)) for t in targets) for m in models}
    if not any(reached.values()):
        return [f"No finished run reached {'the target' if len(targets) == 1 else 'a target'}."]
    fastest = {m: sum(t.seconds.get(m, math.inf) == min(t.seconds.values()) for t in targets) for m in models}
    most = [m for m in models if reached[m] == max(reached.values())]
    quick = [m for m in models if fastest[m] == max(fastest.values())]
    alone = sum(sum(map(math.isfinite, t.seconds.values())) == 1 < len(t.seconds) for t in targets)
    several = f"{messages.listing(most)} {'reaches' if len(most) == 1 else 'reach'} the most targets: "
    text = several + f"{reached[most[0]]} of {len(targets)}{' each' if len(most) > 1 else ''}. "
    text += f"{messages.listing(quick)} {'is' if len(quick) == 1 else 'are'} most often the fastest: for "
    text += f"{messages.count(fastest[quick[0]], 'target')}{' each' if len(quick) > 1 else ''}."
    if alone:
        text += f" Only one model reaches {messages.count(alone, 'target')}."
    return [text]


def anytime_section(group: Group, canvas: Canvas) -> PageSection:
    """Make the section that draws PSNR on the validation views during training, one figure for each scene.

    It shows the runs with the settings that most runs share.
    """
    drawings: list[PageFigure] = []
    rows: list[list[Value]] = []
    tails: dict[str, list[float]] = {}
    seen: set[str] = set()
    for i, scene in enumerate(group.scenes):
        curves = []
        for configuration in group.main_configurations:
            if curve := f.mean_curve(group, configuration, scene):
                steps, seconds, psnr = curve
                marks = events.of(configuration.runs[scene][0])
                seen |= {letter for _, letters in marks for letter in letters}
                at = [(_when(step, steps, seconds), letters) for step, letters in marks]
                run = canvas.runs.of_configuration(group, configuration, [scene])
                name = messages.shorten_middle(configuration.series, LONGEST_NAME, LONGEST_NAME // 2)
                curves.append(charts.Anytime(name, canvas.look[configuration.series], seconds, psnr, run, at))
                rows += [[scene, configuration.model, *point] for point in zip(steps, seconds, psnr, strict=True)]
                tails.setdefault(configuration.model, []).append(max(psnr) - psnr[-1])
        if curves and i < max(1, canvas.scenes):
            alt = f"PSNR on val against training seconds on {scene}, one curve for each of {len(curves)} models"
            drawings.append(PageFigure(scene, charts.anytime(curves), f"{canvas.name}a{i}", alt))
    if not rows:
        return PageSection("anytime", "While training", ["No finished run has PSNR on val during training."])
    columns = [Column("scene"), Column("model"), Column("iteration"), Column("seconds", 2), Column("PSNR val dB", 2)]
    letters = [f"{letter}: {events.MEANING[letter]}" for letter in events.MEANING if letter in seen]
    notes = [*shown_runs(group, group.main_configurations), LENGTHS]
    notes += [f"Events in the row of each model: {'; '.join(letters)}."] if letters else []
    table = DataTable("anytime.csv", columns, rows)
    return PageSection(
        "anytime", "While training", _anytime_words(tails), [Tab("", drawings)], table, legend=True, notes=notes
    )


def _when(step: int, steps: list[int], seconds: list[float]) -> float:
    """Return the training seconds at a step, interpolated between the measured points around it."""
    steps, seconds = [0, *steps], [0.0, *seconds]
    after = next((i for i, s in enumerate(steps) if s >= step), len(steps) - 1)
    span = steps[after] - steps[after - 1] if after else 0
    share = (step - steps[after - 1]) / span if span else 0.0
    return seconds[after] if not after else seconds[after - 1] + min(1.0, share) * (seconds[after] - seconds[after - 1])


def _anytime_words(tails: dict[str, list[float]]) -> list[str]:
    """Say which models end with a lower PSNR on the validation views than they had earlier in training."""
    lost = {m: fmean(losses) for m, losses in tails.items() if fmean(losses) >= 0.05}
    if not lost:
        return ["PSNR on val of every model ends within 0.05 dB of its highest value: no model overfits visibly."]
    worst = sorted(lost, key=lambda m: -lost[m])
    parts = [f"{m} by {messages.plain(lost[m])} dB" for m in worst]
    text = f"PSNR on val ends below its highest value, in the mean over scenes: {messages.listing(parts)}."
    return [f"{text} The other models end within 0.05 dB of theirs." if len(lost) < len(tails) else text]
