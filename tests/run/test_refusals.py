"""Settings that a run refuses before its first step, in one table: what they are, and the words of the error."""

import re
from dataclasses import replace

import pytest
from tiny_training import compose, moving_square

from gsbench.errors import InputError
from gsbench.run.selection import check_candidates
from gsbench.run.settings import check_settings, is_auto, with_candidate
from gsbench.run.setup import build, check_scene

COMPARE = "effects.compare=true"
PAIRS = "train.coarse: expected pairs (factor above 1"


@pytest.mark.parametrize(
    ("model", "words", "message"),
    [
        # a choice on val: of an iteration, of a length, of a model
        ("7dgs", "train.patience=0.2 scene.name=no_val", "train.patience: expected views of val"),
        ("7dgs", "train.patience=0.2 scene.eval_split=val", "train.patience: expected results on test"),
        ("7dgs", "train.patience=0.2 train.average_from=9", "train.patience: expected train.average_from=null"),
        ("7dgs", "train.patience=0.2 train.lengths=2", "train.patience: expected train.lengths=null"),
        ("auto", f"train.patience=0.2 {COMPARE}", "train.patience: expected effects.compare=false"),
        ("7dgs", "train.patience=0.2", None),
        ("auto", f"train.lengths=2 {COMPARE}", "train.lengths: expected effects.compare=false"),
        ("3dgs", "train.lengths=2 scene.eval_split=val", "train.lengths: expected results on test"),
        ("3dgs", "train.lengths=2 scene.name=no_val", "train.lengths: expected views of val to choose the length"),
        ("3dgs", "train.lengths=5", "train.lengths=5: expected at least 16 iterations to halve 4 times, got"),
        ("3dgs", "train.lengths=1", "train.lengths: expected 2 to 8, got 1"),
        ("3dgs", "train.lengths=4", None),  # of 15 iterations
        ("7dgs", COMPARE, "expected model=auto"),
        ("7dgs", "+model.candidates.moving={}", "model.candidates: expected model=auto"),
        ("7dgs", "+model.compared.x.name=3dgs", "model.compared: expected model=auto"),
        ("auto", "+model.candidates.movin={}", "model.candidates.movin: Did you mean 'moving'"),
        ("auto", f"{COMPARE} scene.eval_split=val", "got scene.eval_split=val"),
        ("auto", f"{COMPARE} scene.name=no_val", "scene.val_every=8 takes"),
        ("auto", f"{COMPARE} model.compared.moving_4dgs.lr.means.start=-1", "4dgs: model.lr.means.start: expected"),
        ("auto", f"{COMPARE} ~model.compared.moving_4dgs.lr.scales", "candidate 4dgs: model.lr: "),
        ("auto", COMPARE, None),
        ("7dgs", "scene.eval_split=val", None),
        # a schedule or a penalty
        ("3dgs", "train.average_from=30000", "train.average_from: expected a step below train.recipe_iterations=30000"),
        (
            "3dgs",
            "train.cooldown_from=30000",
            "train.cooldown_from: expected a step below train.recipe_iterations=30000",
        ),
        ("7dgs", "model.lr.means.start=-1", "model.lr.means.start: expected at least 0, got -1"),
        ("7dgs", "model.lr.means.start=0", "model.lr.means: expected start >= 0, and start > 0 with end > 0"),
        ("7dgs", "model.lr.means.end=0", "model.lr.means: expected start >= 0, and start > 0 with end > 0"),
        ("7dgs", "model.lr.opacities.until=20000", "model.lr.opacities: expected an end with until=20000"),
        ("3dgs", "train.densify.kind=gradiant", "train.densify.kind 'gradiant' is not known. Did you mean 'gradient'"),
        ("3dgs", "train.penalties.opacity.stop=0", "train.penalties.opacity: expected stop above start"),
        ("3dgs", "train.penalties.size.weight=-1", "train.penalties.size.weight: expected"),
        ("3dgs", "train.coarse=[[2,3000],[4,15000]]", PAIRS),
        *(
            ("3dgs", f"train.coarse={pairs}", PAIRS)
            for pairs in ("[[1,3000]]", "[[]]", "[[4,3000,1]]", "[[4,3000],[2,3000]]")
        ),
        ("3dgs", "train.coarse=[[2,3000]]", "train.coarse, after the factor 2: expected images of at least 11 pixels"),
    ],
)
def test_settings_are_refused_before_the_first_step(model, words, message):
    """Catches a key that does nothing, a typo that trains otherwise, no step, and results on views that chose."""
    square, config = moving_square(), compose(model, 15, *words.split())
    scene = replace(square, val=[] if config.scene.name == "no_val" else square.train[:2])

    def check() -> None:
        check_settings(config)
        if config.effects.compare:
            check_candidates(config, scene)
        trained = with_candidate(config, "moving") if is_auto(config) else config
        check_scene(build(trained), scene, trained)

    if message is None:
        check()
    else:
        with pytest.raises(InputError, match=re.escape(message)):
            check()
