"""The views of the embedded scenes: enough of them, good poses, and held-out views between training views."""

from collections import Counter

import numpy as np
import pytest
from PIL import Image

from tools.generate_scenes import DISTANCE, RECIPES, _pack


@pytest.mark.parametrize("name", sorted(RECIPES))
def test_views_are_enough_upright_and_held_out_ones_lie_between_training_views(name):
    """Catches a scene whose views are learnt by heart because they are few, a mirrored or tilted camera, which Blender
    would accept, and a test view that training saw, or that is outside of what it saw."""
    shots = RECIPES[name].shots()
    counts = Counter(shot.split for shot in shots)
    assert 100 <= counts["train"] <= 150
    assert counts["val"] >= 10
    assert counts["test"] >= 15
    for shot in shots:
        turn, place = shot.pose[:3, :3], shot.pose[:3, 3]
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(turn) == pytest.approx(1)
        np.testing.assert_allclose(turn[:, 2] * DISTANCE, place, atol=1e-12)  # a camera looks along -z
        assert turn[2, 1] > 0  # upright
    train = [shot for shot in shots if shot.split == "train"]
    times = [shot.time for shot in train]
    for shot in (shot for shot in shots if shot.split == "test"):
        assert min(times) < shot.time < max(times)
        assert shot.time not in times
        angles = [np.degrees(np.arccos(np.clip(shot.pose[:3, 2] @ other.pose[:3, 2], -1, 1))) for other in train]
        assert 0.1 < min(angles) < 30


def test_a_rig_repeats_its_places_and_an_orbit_does_not():
    """Catches a rig whose cameras move, and a monocular scene that sees a moment twice."""
    for name, places, times in (("pendulum", 12, 11), ("suzanne", 120, 120)):
        train = [shot for shot in RECIPES[name].shots() if shot.split == "train"]
        assert len({shot.pose.tobytes() for shot in train}) == places
        assert len({shot.time for shot in train}) == times


def test_a_picture_is_packed_without_a_change_that_shows(tmp_path):
    """Catches a packed picture that lost colours or alpha, and hidden colours that would only take room."""
    before = np.random.default_rng(0).integers(1, 256, (8, 9, 4), dtype=np.uint8)
    before[:, :4, 3] = 0
    Image.fromarray(before).save(tmp_path / "a.png")
    _pack(tmp_path / "a.png")
    with Image.open(tmp_path / "a.png") as image:
        after = np.array(image)
    np.testing.assert_array_equal(after[:, 4:], before[:, 4:])
    assert (after[:, :4] == 0).all()
